"""Point clouds as ROS sends them, without ROS: anything with the attributes of sensor_msgs/PointCloud2 will do.

rclpy messages, messages decoded by mcap-ros2-support and those of rosbags differ only in the type of ``data``.
"""

from __future__ import annotations

import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mdf_core.errors import CloudFormatError
from mdf_core.geometry import PointSet
from mdf_core.mesh_io import has_return, unit_normals
from mdf_core.units import metres_to_millimetres, millimetres_to_metres

Column = NDArray[Any]

# sensor_msgs/PointField: datatype constant and numpy type.
_TYPES = {
    datatype: np.dtype(name)
    for datatype, name in enumerate(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), 1)
}
_DATATYPES = {dtype: datatype for datatype, dtype in _TYPES.items()}
_POSITION = ("x", "y", "z")
_NORMAL = ("normal_x", "normal_y", "normal_z")


class PointFieldLike(Protocol):
    """The attributes of sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2Like(Protocol):
    """The attributes of sensor_msgs/PointCloud2 that matter here; ``data`` is any buffer of bytes."""

    height: int
    width: int
    fields: Sequence[PointFieldLike]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Any
    is_dense: bool


@dataclass(frozen=True, eq=False)
class PackedCloud:
    """Content of an unorganised, little-endian PointCloud2 (height 1, row_step = width * point_step).

    Attributes
    ----------
    fields : list of (name, offset, datatype, count)
    point_step : int
    width : int
    data : array.array of 'B'
        What an rclpy message takes without copying element by element.
    """

    fields: list[tuple[str, int, int, int]]
    point_step: int
    width: int
    data: array.array[int]


def pack_cloud(columns: Mapping[str, Column]) -> PackedCloud:
    """Columns (n,) of equal length, one field each in the given order, packed without gaps.

    Raises
    ------
    CloudFormatError
        A column whose dtype has no PointField datatype, or of another length.
    """
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    width = len(next(iter(arrays.values())))
    fields, offset = [], 0
    for name, column in arrays.items():
        if column.shape != (width,):
            raise CloudFormatError(f"shape {column.shape} instead of {(width,)}", f"field {name}")
        datatype = _DATATYPES.get(column.dtype.newbyteorder("="))
        if datatype is None:
            raise CloudFormatError(f"data type {column.dtype} does not exist in PointField", f"field {name}")
        fields.append((name, offset, datatype, 1))
        offset += column.dtype.itemsize
    data = array.array("B", bytes(1)) * (width * offset)
    layout = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in arrays.items()])
    records = np.frombuffer(data, dtype=layout)
    for name, column in arrays.items():
        records[name] = column
    return PackedCloud(fields, offset, width, data)


def unpack_cloud(message: PointCloud2Like) -> dict[str, Column]:
    """All scalar fields (count 1) of a cloud, flattened row by row, each (height * width,).

    The columns are views of the message's data, with its byte order, except where rows are padded. Fields may overlap.

    Raises
    ------
    CloudFormatError
        Unknown data types, a name that occurs twice, fields beyond point_step, rows shorter than their points, or less
        data than announced.
    """
    names = Counter(field.name for field in message.fields)
    types: dict[str, np.dtype[Any]] = {}
    for field in message.fields:
        where = f"field {field.name}"
        if names[field.name] > 1:
            raise CloudFormatError("occurs more than once", where, "send every field once")
        if field.datatype not in _TYPES:
            raise CloudFormatError(f"unknown datatype {field.datatype}", where, "use the constants of PointField")
        dtype = _TYPES[field.datatype]
        if field.offset + dtype.itemsize * max(field.count, 1) > message.point_step:
            raise CloudFormatError(
                f"ends at byte {field.offset + dtype.itemsize * max(field.count, 1)} of a point of "
                f"{message.point_step} bytes",
                where,
                "set point_step to the size of a point",
            )
        if field.count == 1:
            types[field.name] = dtype.newbyteorder(">" if message.is_bigendian else "<")
    if message.height * message.width == 0:
        return {name: np.empty(0, dtype) for name, dtype in types.items()}
    data = _bytes_of(message.data)
    if message.row_step < message.width * message.point_step:
        raise CloudFormatError(
            f"row_step {message.row_step} is less than width {message.width} x point_step {message.point_step}",
            "point cloud",
            "set row_step to the size of a row",
        )
    if len(data) < message.height * message.row_step:
        raise CloudFormatError(
            f"{len(data)} bytes of data instead of height {message.height} x row_step {message.row_step}",
            "point cloud",
            "send all points",
        )
    shape, strides = (message.height, message.width), (message.row_step, message.point_step)
    offsets = {field.name: field.offset for field in message.fields}
    return {
        name: np.ndarray(shape, dtype, data.data, offsets[name], strides).reshape(-1) for name, dtype in types.items()
    }


def scan_from_cloud(message: PointCloud2Like) -> PointSet:
    """A scan from a cloud in metres.

    Takes x y z (float32 or float64), normals from normal_x normal_y normal_z and areas (m²) from area where present,
    and ignores other fields. In clouds that are not dense, points that are NaN in all of x, y, z mean "no return" and
    are left out.

    Returns
    -------
    PointSet
        In mm.

    Raises
    ------
    CloudFormatError
        Decoded by a definition of another message, x, y or z missing, not scalar or not floating point, or what
        `unpack_cloud` raises.
    EmptyScanError
        No points.
    NonFiniteScanError
        No point was measured, or other NaN or infinite values.
    """
    missing = [name for name in PointCloud2Like.__annotations__ if not hasattr(message, name)]
    if missing:
        raise CloudFormatError(
            f"no {', '.join(missing)}", "point cloud", "record it with the definition of sensor_msgs/msg/PointCloud2"
        )
    if message.height * message.width == 0:
        return PointSet(np.empty((0, 3)))  # raises
    by_name = {field.name: field for field in message.fields}
    for name in _POSITION:
        if name not in by_name:
            raise CloudFormatError(
                f"missing among {', '.join(by_name) or 'no fields'}", f"field {name}", "send x, y and z in metres"
            )
        field = by_name[name]
        if field.count != 1:
            raise CloudFormatError(f"count {field.count} instead of 1", f"field {name}", "send one number per point")
        dtype = _TYPES.get(field.datatype)
        if dtype is not None and dtype.kind != "f":
            raise CloudFormatError(f"data type {dtype}", f"field {name}", "send float32 or float64 in metres")
    columns = unpack_cloud(message)
    if not message.is_dense:
        measured = has_return(np.column_stack([columns[name] for name in _POSITION]))
        columns = {name: column[measured] for name, column in columns.items()}
    return _scan_from_columns(columns)


def _scan_from_columns(columns: Mapping[str, Column]) -> PointSet:
    normals = np.column_stack([columns[name] for name in _NORMAL]) if columns.keys() >= set(_NORMAL) else None
    areas = columns.get("area")
    return PointSet(
        metres_to_millimetres(np.column_stack([columns[name] for name in _POSITION])),
        None if normals is None else unit_normals(normals),
        None if areas is None else metres_to_millimetres(areas, power=2),
    )


def columns_of_scan(scan: PointSet) -> dict[str, NDArray[np.float32]]:
    """A scan as float32 columns for `pack_cloud`: x y z, and normal_x normal_y normal_z, area where the scan has them.

    Metres and m².
    """
    columns = dict(zip(_POSITION, millimetres_to_metres(scan.points).T, strict=True))
    if scan.normals is not None:
        columns |= dict(zip(_NORMAL, scan.normals.T, strict=True))
    if scan.areas is not None:
        columns["area"] = millimetres_to_metres(scan.areas, power=2)
    return {name: column.astype(np.float32) for name, column in columns.items()}


def as_published(scan: PointSet) -> PointSet:
    """The scan as subscribers get it, with the digits that `columns_of_scan` keeps."""
    return _scan_from_columns(columns_of_scan(scan))


def _bytes_of(data: Any) -> NDArray[np.uint8]:
    """Any buffer as bytes, without a copy."""
    return np.frombuffer(data if not isinstance(data, list | tuple) else bytes(data), dtype=np.uint8)
