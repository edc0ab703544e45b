"""Tables of points as scanners export them: the right columns are taken, and what is unclear is refused."""

from __future__ import annotations

import numpy as np
import pytest

from mdf_core.point_table import point_columns, read_point_text

rng = np.random.default_rng(0)
POINTS = rng.uniform(-50.0, 50.0, (20, 3))
NORMALS = rng.normal(size=(20, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
COLOURS = rng.integers(0, 256, (20, 3)).astype(float)
INTENSITY = rng.uniform(-2000.0, 2000.0, (20, 1))
NUMBERS = np.arange(1.0, 21.0)[:, None]

LAYOUTS = {
    "x y z": ([POINTS], False),
    "x y z intensity": ([POINTS, INTENSITY], False),
    "x y z r g b": ([POINTS, COLOURS], False),
    "x y z intensity r g b": ([POINTS, INTENSITY, COLOURS], False),
    "x y z nx ny nz": ([POINTS, NORMALS], True),
    "x y z intensity nx ny nz": ([POINTS, INTENSITY, NORMALS], True),
    "x y z nx ny nz curvature": ([POINTS, NORMALS, INTENSITY], True),
    "x y z r g b nx ny nz": ([POINTS, COLOURS, NORMALS], True),
    "x y z nx ny nz r g b": ([POINTS, NORMALS, COLOURS], True),
    "x y z intensity r g b nx ny nz": ([POINTS, INTENSITY, COLOURS, NORMALS], True),
    "number x y z": ([NUMBERS, POINTS], False),
    "number x y z nx ny nz": ([NUMBERS - 1.0, POINTS, NORMALS], True),
}


def text(table: np.ndarray, separator: str = " ", head: str = "", comma: str = ".") -> bytes:
    rows = (separator.join(str(float(value)).replace(".", comma) for value in row) for row in table)
    return (head + "\n".join(rows) + "\n").encode()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_columns_without_names_are_told_apart(layout: str) -> None:
    columns, has_normals = LAYOUTS[layout]
    for points, normals in (point_columns(np.hstack(columns)), read_point_text(text(np.hstack(columns)))):
        np.testing.assert_array_equal(points, POINTS)
        if has_normals:
            np.testing.assert_array_equal(normals, NORMALS)
        else:
            assert normals is None


@pytest.mark.parametrize(
    "head",
    [
        "id;Z;Y;X;quality;nz;ny;nx\n",
        "//id Z Y X quality Nz Ny Nx\n",
        "# made by a scanner\n# id\tz\ty\tx\tquality\tnormal_z\tnormal_y\tnormal_x\n",
        'point,"Z [mm]","Y [mm]","X [mm]",quality (%),normal_z,normal_y,normal_x\n',
    ],
)
def test_named_columns_are_taken_by_their_names(head: str) -> None:
    rows = [
        f"P{i} {' '.join(map(str, [*point[::-1], 'good', *normal[::-1]]))}"
        for i, (point, normal) in enumerate(zip(POINTS, 3.0 * NORMALS, strict=True))
    ]
    points, normals = read_point_text((head + "\n".join(rows)).encode())
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(normals, 3.0 * NORMALS)


def test_names_of_other_columns_are_no_hindrance() -> None:
    points, normals = read_point_text(text(np.hstack([POINTS, NORMALS]), head="//X Y Z\n"))
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(normals, NORMALS)


@pytest.mark.parametrize("separator", [" ", "\t", ";", "; "])
def test_decimal_commas_are_read_where_they_cannot_separate_columns(separator: str) -> None:
    np.testing.assert_array_equal(read_point_text(text(POINTS, separator, comma=","))[0], POINTS)


@pytest.mark.parametrize("separator", [",", ", ", " , ", ",\t"])
def test_commas_separate_columns(separator: str) -> None:
    np.testing.assert_array_equal(read_point_text(text(POINTS, separator))[0], POINTS)
    whole = np.round(POINTS)
    rows = "\n".join(separator.join(str(int(value)) for value in row) for row in whole)
    np.testing.assert_array_equal(read_point_text(rows.encode())[0], whole)


@pytest.mark.parametrize("separator", [",", ";", ", "])
@pytest.mark.parametrize("comma", [".", ","])
def test_quotes_hold_a_number_together(separator: str, comma: str) -> None:
    table = text(POINTS, f'"{separator}"', comma=comma).decode()
    quoted = "\n".join(f'"{row}"' for row in table.splitlines())
    for head in ("", '"x","y","z"\n'):
        np.testing.assert_array_equal(read_point_text((head + quoted).encode())[0], POINTS)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_is_read_in_the_encodings_that_spreadsheets_write(encoding: str) -> None:
    content = text(np.hstack([POINTS, NORMALS]), head="# Prüfling 3 µm\n").decode().encode(encoding)
    np.testing.assert_array_equal(read_point_text(content)[0], POINTS)


def test_the_number_of_points_before_them_is_no_point() -> None:
    table = text(np.hstack([POINTS, INTENSITY, COLOURS]), head="20\n")
    np.testing.assert_array_equal(read_point_text(table)[0], POINTS)
    with pytest.raises(ValueError, match="cut short: 20 points announced, 19 found"):
        read_point_text(b"\n".join(table.splitlines()[:-1]))


@pytest.mark.parametrize(
    "table",
    [
        np.hstack([POINTS, 2.0 * NORMALS]),
        np.hstack([POINTS, INTENSITY, INTENSITY]),
        np.hstack([POINTS, COLOURS + 256.0]),
        np.hstack([POINTS, NORMALS, INTENSITY, INTENSITY]),
    ],
)
def test_columns_that_could_be_anything_are_refused_with_the_remedy(table: np.ndarray) -> None:
    with pytest.raises(ValueError, match="a first line of column names"):
        point_columns(table)


def test_points_without_a_normal_do_not_hide_the_normals_of_the_others() -> None:
    normals = NORMALS.copy()
    normals[3], normals[4] = np.nan, 0.0
    np.testing.assert_array_equal(point_columns(np.hstack([POINTS, normals]))[1], normals)


@pytest.mark.parametrize("names", ["", "x,y,z,nx,ny,nz\n"])
def test_what_stands_before_the_points_is_skipped(names: str) -> None:
    preamble = f"Scanner 3000\nDate: 2026-11-22\n\nPoints: 20\n{names}"
    points, normals = read_point_text(text(np.hstack([POINTS, NORMALS]), ",", preamble))
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(normals, NORMALS)


def test_a_line_that_is_no_point_is_named() -> None:
    with pytest.raises(ValueError, match="'END' is no line of 3 numbers as the first one is"):
        read_point_text(text(POINTS) + b"END\n")
