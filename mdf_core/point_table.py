"""Tables of points, as scanners and their programs export them: which columns are coordinates, and which normals."""

from __future__ import annotations

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

_COMMENTS = ("#", "//")
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)(e[-+]?\d+)?", re.IGNORECASE)
_QUOTED_DECIMAL = re.compile(r'"([-+]?\d+),(\d+[^",\s]*)"')
_POSITION = ("x", "y", "z")
_NORMALS = (("nx", "ny", "nz"), ("normalx", "normaly", "normalz"))

_LARGEST_NORMAL_ERROR = 0.05  # columns of unit normals may be rounded, colours must not pass for them
_BRIGHTEST = 255

PointColumns = tuple[NDArray[Any], NDArray[Any] | None]
"""Coordinates (n, 3), and normals (n, 3) of any length or None."""


def read_point_text(content: bytes) -> PointColumns:
    """Read points from text: a point a line, columns separated by white space, commas or semicolons.

    A line of column names, also as a comment, says which columns are x, y, z and nx, ny, nz; all others are ignored.
    Without one they are told apart as `point_columns` does. Empty lines, comments (# and //) and what stands before the
    first point are skipped; a line with a single number there announces how many points follow, as in PTS files.
    Commas within numbers are decimal commas where they cannot separate columns: beside semicolons, or within numbers
    with white space between them, or within quotes. The text is UTF-8, or UTF-16 with its byte order mark.

    Raises
    ------
    ValueError
        No such table, or fewer points than announced.
    """
    lines = [line for line in map(str.strip, _decoded(content).splitlines()) if line]
    rows = [line for line in lines if not line.startswith(_COMMENTS)]
    heads = [line.lstrip("#/") for line in takewhile(lambda line: line.startswith(_COMMENTS), lines)]
    begin = next((number for number, row in enumerate(rows) if _numbers_in(row) >= 3), 0)
    heads, rows = heads + rows[:begin], rows[begin:]
    if begin and heads[-1].isdecimal() and len(rows) < int(heads[-1]):
        raise ValueError(f"cut short: {heads[-1]} points announced, {len(rows)} found")
    if not rows or (len(rows) == 1 and not _numbers_in(rows[0])):  # nothing, or but the names of the columns
        return np.empty((0, 3)), None
    separators = str.maketrans({",": "." if _has_decimal_commas(rows) else " ", ";": " "})
    rows = [row.translate(separators) for row in rows]
    for names in map(_names, reversed(heads)):
        if set(_POSITION) <= set(names) and len(names) == len(rows[0].split()):
            return _named(rows, names)
    return point_columns(_loaded(rows))


def point_columns(table: NDArray[Any]) -> PointColumns:
    """Tell the columns of a `table` (n, m) without names apart.

    The first three are x, y, z; before them there may be the number of the point. Three columns of unit vectors, next
    to x, y, z or the last, are normals. An intensity, or colours from 0 to 255, or both may stand beside them.

    Raises
    ------
    ValueError
        No table of numbers, or columns that are none of these.
    """
    if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise ValueError(f"numbers in columns x y z or x y z nx ny nz expected, found {table.dtype} {table.shape}")
    if table.shape[1] > 3 and _counts(table[:, 0]):
        table = table[:, 1:]
    points, others = table[:, :3], table[:, 3:]
    if _are_normals(others[:, :3]):
        normals, others = others[:, :3], others[:, 3:]
    elif _are_normals(others[:, -3:]):
        normals, others = others[:, -3:], others[:, :-3]
    else:
        normals = None
    has_intensity, has_colours = others.shape[1] % 3 == 1, others.shape[1] >= 3
    if others.shape[1] not in (0, 1, 3, 4) or (has_colours and not _are_colours(others[:, int(has_intensity) :])):
        raise ValueError(
            f"of {table.shape[1]} columns those beside x y z are neither unit normals nor an intensity nor colours "
            "from 0 to 255; a first line of column names, such as x y z nx ny nz, would say which to take"
        )
    return points, normals


def _decoded(content: bytes) -> str:
    """The text, without the quotes that spreadsheets put around their cells."""
    text = content.decode("utf-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    return _QUOTED_DECIMAL.sub(r"\1.\2", text).replace('"', "") if '"' in text else text


def _numbers_in(row: str) -> int:
    return sum(map(_is_number, re.split(r"[,;\s]+", row)))


def _is_number(word: str) -> bool:
    return _NUMBER.fullmatch(word) is not None or word.lower() == "nan"


def _loaded(rows: list[str], columns: list[int] | None = None) -> NDArray[Any]:
    try:
        return np.loadtxt(rows, usecols=columns, ndmin=2)
    except ValueError as error:
        wanted = len(rows[0].split())
        for row in rows:
            words = row.split()
            if len(words) != wanted or (columns is None and not all(map(_is_number, words))):
                raise ValueError(f"{row[:60]!r} is no line of {wanted} numbers as the first one is") from error
        raise


def _has_decimal_commas(rows: list[str]) -> bool:
    example = next((row for row in rows if "," in row), "")
    words = example.split()
    return ";" in example or (len(words) > 1 and all(_NUMBER.fullmatch(word) for word in words))


def _names(head: str) -> list[str]:
    """Column names in small letters, without units in brackets, underscores and quotes."""
    words = re.split(r"[,;\t]", head) if re.search(r"[,;\t]", head) else head.split()
    return [re.sub(r"[\[(].*|[^a-z]", "", word.lower()) for word in words]


def _named(rows: list[str], names: list[str]) -> PointColumns:
    normals = next((wanted for wanted in _NORMALS if set(wanted) <= set(names)), ())
    table = _loaded(rows, [names.index(name) for name in _POSITION + normals])
    return table[:, :3], table[:, 3:] if normals else None


def _counts(column: NDArray[Any]) -> bool:
    """Whether a column numbers the points: no coordinate grows by just 1 from point to point."""
    return len(column) > 3 and column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def _are_normals(columns: NDArray[Any]) -> bool:
    """Whether the rows of three columns are unit vectors; some may be zero or NaN, which is no normal."""
    if columns.shape[1] != 3:
        return False
    lengths = np.linalg.norm(columns.astype(np.float64), axis=1)
    lengths = lengths[lengths > 0]
    return len(lengths) > 0 and bool((np.abs(lengths - 1.0) <= _LARGEST_NORMAL_ERROR).all())


def _are_colours(columns: NDArray[Any]) -> bool:
    return bool(((columns >= 0) & (columns <= _BRIGHTEST)).all())
