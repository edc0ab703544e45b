"""What holds for every cloud on the wire: tried on many, the same ones every time."""

import dataclasses
from types import SimpleNamespace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from property_samples import clouds, seeds, tried

from mdf_core.geometry import PointSet
from mdf_core.point_cloud2 import columns_of_scan, pack_cloud, scan_from_cloud, unpack_cloud

DTYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")


@st.composite
def columns(draw, count):
    """Columns of any names, types and bytes, NaN with a payload among them."""
    names = draw(st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=8, unique=True))
    rng = np.random.default_rng(draw(seeds))
    types = [np.dtype(draw(st.sampled_from(DTYPES))) for _ in names]
    return {
        name: np.frombuffer(rng.bytes(count * dtype.itemsize), dtype) for name, dtype in zip(names, types, strict=True)
    }


@tried(40)
@given(data=st.data(), height=st.integers(1, 5), width=st.integers(0, 9), big=st.booleans())
def test_a_cloud_is_read_as_it_was_written_however_it_is_laid_out(data, height, width, big):
    written = data.draw(columns(height * width))
    packed = pack_cloud(written)
    assert [name for name, *_ in packed.fields] == [*written]
    # As a driver may send it: fields in any order with gaps between them, padded rows, either byte order.
    order = data.draw(st.permutations(range(len(written))))
    gaps = data.draw(st.lists(st.integers(0, 5), min_size=len(written) + 1, max_size=len(written) + 1))
    padding = data.draw(st.integers(0, 7))
    fields, offset = [None] * len(written), gaps[-1]
    for place in order:
        name, _, datatype, count = packed.fields[place]
        fields[place] = SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)
        offset += written[name].dtype.itemsize + gaps[place]
    step = offset
    rows = np.full((height, width * step + padding), 0xA5, np.uint8)
    for field in fields:
        column = written[field.name]
        raw = column.astype(column.dtype.newbyteorder(">" if big else "<")).view(np.uint8)
        points = rows[:, : width * step].reshape(height, width, step)
        size = column.dtype.itemsize
        points[:, :, field.offset : field.offset + size] = raw.reshape(height, width, size)
        rows[:, : width * step] = points.reshape(height, -1)
    message = SimpleNamespace(
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=step,
        row_step=rows.shape[1],
        data=rows.tobytes(),
        is_dense=True,
    )
    plain = dataclasses.asdict(packed) | {
        "fields": [SimpleNamespace(name=n, offset=o, datatype=t, count=c) for n, o, t, c in packed.fields],
        "height": 1,
        "is_bigendian": False,
        "row_step": packed.point_step * packed.width,
    }
    for sent in (message, SimpleNamespace(**plain)):
        read = unpack_cloud(sent)
        assert [*read] == [*written]
        for name, column in read.items():
            native = column.astype(column.dtype.newbyteorder("="))
            assert native.dtype == written[name].dtype
            assert native.tobytes() == written[name].tobytes(), name


@tried(20)
@given(points=clouds(dimensions=(3,)), with_normals=st.booleans(), with_areas=st.booleans(), seed=seeds)
def test_a_scan_comes_out_of_its_cloud_as_float32_allows(points, with_normals, with_areas, seed):
    assume(np.abs(points).max() < 1e5)
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    areas = rng.uniform(0.0, 3.0, len(points))
    scan = PointSet(points, normals if with_normals else None, areas if with_areas else None)
    packed = pack_cloud(columns_of_scan(scan))
    message = SimpleNamespace(
        height=1,
        width=packed.width,
        fields=[SimpleNamespace(name=n, offset=o, datatype=t, count=c) for n, o, t, c in packed.fields],
        is_bigendian=False,
        point_step=packed.point_step,
        row_step=packed.point_step * packed.width,
        data=packed.data,
        is_dense=True,
    )
    read = scan_from_cloud(message)
    np.testing.assert_allclose(read.points, points, rtol=1e-7, atol=1e-30)
    assert (read.normals is None, read.areas is None) == (not with_normals, not with_areas)
    if with_normals:
        np.testing.assert_allclose(read.normals, normals, atol=2e-7)
    if with_areas:
        np.testing.assert_allclose(read.areas, areas, rtol=2e-7)
    # A second journey changes nothing: what fits into float32 stays.
    again = pack_cloud(columns_of_scan(PointSet(read.points)))
    np.testing.assert_array_equal(
        np.frombuffer(again.data, "<f4"), np.frombuffer(pack_cloud(columns_of_scan(PointSet(points))).data, "<f4")
    )
