from __future__ import annotations

import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mdf_core.errors import CloudFormatError, EmptyScanError, NonFiniteScanError
from mdf_core.geometry import PointSet
from mdf_core.point_cloud2 import columns_of_scan, pack_cloud, scan_from_cloud, unpack_cloud

FLOAT32, FLOAT64, UINT8, UINT16, INT32 = 7, 8, 2, 4, 5


def message(columns: dict[str, np.ndarray], **changes: Any) -> SimpleNamespace:
    """What a driver would send: the columns as one row of packed points."""
    packed = pack_cloud(columns)
    attributes = {
        "height": 1,
        "width": packed.width,
        "fields": [field(*entry) for entry in packed.fields],
        "is_bigendian": False,
        "point_step": packed.point_step,
        "row_step": packed.point_step * packed.width,
        "data": packed.data,
        "is_dense": True,
    }
    return SimpleNamespace(**(attributes | changes))


def field(name: str, offset: int, datatype: int = FLOAT32, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def xyz(count: int = 6, dtype: str = "f4") -> dict[str, np.ndarray]:
    values = np.arange(3.0 * count).reshape(3, count) / 1000.0
    return dict(zip("xyz", values.astype(dtype), strict=True))


def position(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.column_stack([columns[name] for name in "xyz"]).astype(np.float64) * 1000.0


# --- reading -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_metres_become_millimetres(dtype: str) -> None:
    columns = xyz(dtype=dtype)
    scan = scan_from_cloud(message(columns))
    np.testing.assert_array_equal(scan.points, position(columns))
    assert scan.normals is None
    assert scan.areas is None


@pytest.mark.parametrize(
    "convert",
    [bytes, bytearray, memoryview, list, lambda data: array.array("B", data), lambda data: np.frombuffer(data, "u1")],
    ids=["bytes", "bytearray", "memoryview", "list", "array", "ndarray"],
)
def test_data_may_be_any_kind_of_bytes(convert: Any) -> None:
    cloud = message(xyz())
    cloud.data = convert(bytes(cloud.data))
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(xyz()))


def test_normals_and_areas_are_taken_along() -> None:
    normals = np.array([[0.0, 0.0, 2.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.0]])
    columns = xyz(3) | {
        "normal_x": normals[:, 0].astype("f4"),
        "normal_y": normals[:, 1].astype("f4"),
        "normal_z": normals[:, 2],
        "area": np.array([1e-6, 2e-6, 0.5e-6]),
    }
    scan = scan_from_cloud(message(columns))
    np.testing.assert_allclose(scan.normals, [[0, 0, 1], [0.6, 0.8, 0], [0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(scan.areas, [1.0, 2.0, 0.5])


def test_normals_count_only_when_all_three_are_there_and_not_all_are_zero() -> None:
    ones, zeros = np.ones(6, "f4"), np.zeros(6, "f4")
    assert scan_from_cloud(message(xyz() | {"normal_x": ones, "normal_y": ones})).normals is None
    assert scan_from_cloud(message(xyz() | dict.fromkeys(("normal_x", "normal_y", "normal_z"), zeros))).normals is None


def test_other_fields_are_ignored_whatever_they_hold() -> None:
    columns = (
        {"intensity": np.full(6, np.nan, "f4")} | xyz() | {"rgb": np.arange(6, dtype="u4"), "ring": np.ones(6, "u2")}
    )
    np.testing.assert_array_equal(scan_from_cloud(message(columns)).points, position(xyz()))


def test_fields_with_several_numbers_are_skipped() -> None:
    cloud = message(xyz() | {"descriptor": np.ones(6)})
    cloud.fields[3] = field("descriptor", 12, UINT8, 8)
    assert unpack_cloud(cloud).keys() == {"x", "y", "z"}
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(xyz()))


def test_fields_may_be_apart_unordered_and_unaligned() -> None:
    layout = np.dtype(
        {"names": ["z", "x", "y"], "formats": ["<f4", "<f8", "<f4"], "offsets": [1, 6, 21], "itemsize": 31}
    )
    records = np.zeros(4, layout)
    records["x"], records["y"], records["z"] = [1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]
    cloud = message(
        xyz(4),
        fields=[field("z", 1), field("x", 6, FLOAT64), field("y", 21)],
        point_step=31,
        row_step=124,
        data=records.tobytes(),
    )
    np.testing.assert_array_equal(
        scan_from_cloud(cloud).points, np.array([[1, 5, 9], [2, 6, 10], [3, 7, 11], [4, 8, 12]]) * 1000.0
    )


def test_fields_may_overlap() -> None:
    cloud = message(xyz())
    cloud.fields.append(field("x_bits", 0, INT32))
    columns = unpack_cloud(cloud)
    np.testing.assert_array_equal(columns["x_bits"], xyz()["x"].view("i4"))
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(xyz()))


def test_organised_clouds_with_padded_rows_are_flattened_row_by_row() -> None:
    columns = xyz(6)
    flat = message(columns)
    rows = np.frombuffer(flat.data, "u1").reshape(2, 36)
    padded = np.full((2, 40), 0xFF, "u1")
    padded[:, :36] = rows
    cloud = message(columns, height=2, width=3, row_step=40, data=padded.tobytes())
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(columns))


def test_big_endian_data_are_read_as_what_they_mean() -> None:
    columns = xyz() | {"ring": np.arange(6, dtype="u2") + 300}
    layout = np.dtype([(name, column.dtype.newbyteorder(">")) for name, column in columns.items()])
    records = np.empty(6, layout)
    for name, column in columns.items():
        records[name] = column
    cloud = message(columns, is_bigendian=True, data=records.tobytes())
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(columns))
    np.testing.assert_array_equal(unpack_cloud(cloud)["ring"], columns["ring"])


def test_columns_are_views_of_the_message() -> None:
    cloud = message(xyz())
    for column in unpack_cloud(cloud).values():
        assert np.shares_memory(column, np.frombuffer(cloud.data, "u1"))


def test_data_beyond_the_announced_rows_are_not_read() -> None:
    cloud = message(xyz())
    cloud.data = bytes(cloud.data) + b"\xff" * 100
    np.testing.assert_array_equal(scan_from_cloud(cloud).points, position(xyz()))


# --- no return, NaN, empty -----------------------------------------------------------------------------------------


def with_nan(**where: int) -> dict[str, np.ndarray]:
    columns = xyz()
    for name, index in where.items():
        columns[name][index] = np.nan
    return columns


def test_points_without_return_are_left_out_of_clouds_that_are_not_dense() -> None:
    columns = with_nan(x=2, y=2, z=2) | dict.fromkeys(("normal_x", "normal_y", "normal_z"), np.ones(6, "f4"))
    columns["area"] = np.arange(6.0) * 1e-6
    scan = scan_from_cloud(message(columns, is_dense=False))
    kept = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(scan.points, position(xyz())[kept])
    np.testing.assert_allclose(scan.areas, kept)
    assert scan.normals is not None
    assert scan.normals.shape == (5, 3)


def test_a_message_of_another_definition_is_an_error() -> None:
    cloud = message(xyz())
    del cloud.row_step, cloud.is_dense
    with pytest.raises(CloudFormatError, match="no row_step, is_dense"):
        scan_from_cloud(cloud)


@pytest.mark.parametrize("is_dense", [True, False])
def test_half_a_nan_is_an_error(is_dense: bool) -> None:
    with pytest.raises(NonFiniteScanError, match="1 of 6 points are NaN or infinite, the first at index 4"):
        scan_from_cloud(message(with_nan(y=4), is_dense=is_dense))


def test_nan_in_a_cloud_that_calls_itself_dense_is_an_error() -> None:
    with pytest.raises(NonFiniteScanError, match="1 of 6 points"):
        scan_from_cloud(message(with_nan(x=2, y=2, z=2)))


@pytest.mark.parametrize("is_dense", [True, False])
def test_infinity_is_an_error(is_dense: bool) -> None:
    columns = {name: np.full(6, np.inf, "f4") for name in "xyz"}
    with pytest.raises(NonFiniteScanError, match="6 of 6 points"):
        scan_from_cloud(message(columns, is_dense=is_dense))


def test_a_cloud_without_any_return_is_an_error_that_says_so() -> None:
    columns = {name: np.full(6, np.nan, "f4") for name in "xyz"}
    with pytest.raises(NonFiniteScanError, match="all 6 points are NaN"):
        scan_from_cloud(message(columns, is_dense=False))


@pytest.mark.parametrize(("height", "width"), [(0, 0), (1, 0), (0, 5)])
def test_an_empty_cloud_is_an_empty_scan(height: int, width: int) -> None:
    cloud = message(xyz(0), height=height, width=width, data=b"")
    with pytest.raises(EmptyScanError):
        scan_from_cloud(cloud)
    assert {name: column.shape for name, column in unpack_cloud(cloud).items()} == {"x": (0,), "y": (0,), "z": (0,)}


# --- clouds that cannot be read --------------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["x", "y", "z"])
def test_a_missing_coordinate_is_named(missing: str) -> None:
    columns = xyz()
    del columns[missing]
    with pytest.raises(
        CloudFormatError, match=f"^field {missing}: missing among {', '.join(columns)}; send x, y and z"
    ):
        scan_from_cloud(message(columns))


def test_a_cloud_without_fields_is_told() -> None:
    with pytest.raises(CloudFormatError, match="field x: missing among no fields"):
        scan_from_cloud(message(xyz(), fields=[]))


def test_integer_coordinates_are_refused_by_field_and_type() -> None:
    with pytest.raises(CloudFormatError, match=r"^field y: data type int16; send float32 or float64 in metres"):
        scan_from_cloud(message(xyz() | {"y": np.arange(6, dtype="i2")}))


@pytest.mark.parametrize("datatype", [0, 9, 255])
def test_unknown_data_types_are_refused(datatype: int) -> None:
    cloud = message(xyz())
    cloud.fields[2].datatype = datatype
    with pytest.raises(CloudFormatError, match=f"^field z: unknown datatype {datatype}"):
        scan_from_cloud(cloud)


@pytest.mark.parametrize("count", [0, 2])
def test_coordinates_are_single_numbers(count: int) -> None:
    cloud = message(xyz())
    cloud.fields[0].count = count
    with pytest.raises(CloudFormatError, match=f"^field x: count {count} instead of 1"):
        scan_from_cloud(cloud)


def test_a_field_that_occurs_twice_is_refused() -> None:
    cloud = message(xyz())
    cloud.fields.append(field("y", 8))
    with pytest.raises(CloudFormatError, match=r"^field y: occurs more than once"):
        scan_from_cloud(cloud)


@pytest.mark.parametrize("point_step", [0, 11])
def test_points_too_small_for_their_fields_are_refused(point_step: int) -> None:
    with pytest.raises(CloudFormatError, match=f"of a point of {point_step} bytes; set point_step"):
        scan_from_cloud(message(xyz(), point_step=point_step))


def test_an_ignored_field_beyond_the_point_is_refused_too() -> None:
    cloud = message(xyz())
    cloud.fields.append(field("rgb", 12))
    with pytest.raises(CloudFormatError, match=r"^field rgb: ends at byte 16 of a point of 12 bytes"):
        scan_from_cloud(cloud)


def test_rows_shorter_than_their_points_are_refused() -> None:
    with pytest.raises(CloudFormatError, match="row_step 71 is less than width 6 x point_step 12"):
        scan_from_cloud(message(xyz(), row_step=71))


@pytest.mark.parametrize(("height", "lost"), [(1, 1), (2, 0)])
def test_less_data_than_announced_are_refused(height: int, lost: int) -> None:
    cloud = message(xyz(), height=height)
    cloud.data = bytes(cloud.data)[: len(cloud.data) - lost]
    with pytest.raises(CloudFormatError, match=rf"{72 - lost} bytes of data instead of height {height} x row_step 72"):
        scan_from_cloud(cloud)


# --- writing -------------------------------------------------------------------------------------------------------


def test_every_point_field_type_survives_packing() -> None:
    names = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
    columns = {name: np.array([0, 1, 100], dtype=name) for name in names}
    packed = pack_cloud(columns)
    assert [entry[2] for entry in packed.fields] == list(range(1, 9))
    assert [entry[1] for entry in packed.fields] == [0, 1, 2, 4, 6, 10, 14, 18]
    assert (packed.point_step, packed.width, len(packed.data)) == (26, 3, 78)
    for name, column in unpack_cloud(message(columns)).items():
        assert column.dtype == np.dtype(name)
        np.testing.assert_array_equal(column, columns[name])


def test_packed_data_are_little_endian_bytes_in_an_array() -> None:
    packed = pack_cloud({"x": np.array([1.0], ">f4"), "supported": np.array([1], "u1")})
    assert isinstance(packed.data, array.array)
    assert packed.data.typecode == "B"
    assert packed.data.tobytes() == np.array([1.0], "<f4").tobytes() + b"\x01"


def test_packing_the_same_columns_gives_the_same_bytes() -> None:
    assert pack_cloud(xyz()).data == pack_cloud(xyz()).data


def test_packing_no_points_gives_an_empty_cloud_with_fields() -> None:
    packed = pack_cloud(xyz(0))
    assert (packed.width, packed.point_step, len(packed.data), len(packed.fields)) == (0, 12, 0, 3)


@pytest.mark.parametrize("dtype", ["int64", "bool", "U3"])
def test_columns_without_a_point_field_type_are_refused(dtype: str) -> None:
    with pytest.raises(CloudFormatError, match=r"^field label: data type .* does not exist in PointField"):
        pack_cloud(xyz() | {"label": np.zeros(6, dtype)})


@pytest.mark.parametrize("shape", [(5,), (6, 1)])
def test_columns_of_another_length_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudFormatError, match=r"^field label: shape"):
        pack_cloud(xyz() | {"label": np.zeros(shape, "f4")})


def test_a_scan_survives_the_way_through_a_cloud_to_a_hundredth_of_a_micrometre() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scan = PointSet(rng.uniform(-100.0, 100.0, (200_000, 3)), normals, rng.random(200_000))
    columns = columns_of_scan(scan)
    assert list(columns) == ["x", "y", "z", "normal_x", "normal_y", "normal_z", "area"]
    assert {column.dtype for column in columns.values()} == {np.dtype("f4")}
    received = scan_from_cloud(message(columns))
    np.testing.assert_allclose(received.points, scan.points, atol=1e-5)
    np.testing.assert_allclose(received.normals, scan.normals, atol=1e-6)
    np.testing.assert_allclose(received.areas, scan.areas, rtol=1e-6)
    # What came through once comes through unchanged: nodes along the way see one scan.
    again = scan_from_cloud(message(columns_of_scan(received)))
    np.testing.assert_array_equal(again.points, received.points)
    np.testing.assert_array_equal(again.areas, received.areas)


def test_a_scan_without_normals_and_areas_has_three_columns() -> None:
    assert list(columns_of_scan(PointSet(np.eye(3)))) == ["x", "y", "z"]
