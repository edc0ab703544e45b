"""The data of a mixture: in blocks of neighbours and, while the mixture is wide, in cells of points treated as one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mdf_core.geometry import Array

_BLOCK = 256  # cells at most; larger blocks outgrow the reach of a narrow mixture, smaller ones cost more calls


@dataclass(frozen=True, eq=False)
class Block:
    """Neighbouring cells.

    Attributes
    ----------
    means : (n, D) float64
        Of the points in every cell.
    squares : (n,) float64
        Mean |x|² of the points in every cell.
    counts : (n,) float64
        Number of points in every cell.
    centre : (D,) float64
    radius : float
        No mean is farther from `centre`.
    """

    means: Array
    squares: Array
    counts: Array
    centre: Array
    radius: float


@dataclass(frozen=True, eq=False)
class DataCells:
    """Data points in cells, and the cells in blocks.

    Attributes
    ----------
    origin : (D,) float64
        Mean of all points; the coordinates in the blocks are relative to it, which keeps the rounding small.
    blocks : tuple of Block
    points : int
        Data points in all cells together.
    width : float
        Of the cells; 0 if every point is a cell of its own.
    """

    origin: Array
    blocks: tuple[Block, ...]
    points: int
    width: float

    def __len__(self) -> int:
        return sum(len(block.counts) for block in self.blocks)


def gather(points: Array, width: float) -> DataCells:
    """Put `points` (N, D) into the cells of a grid of that width; with width 0 each is a cell of its own.

    Notes
    -----
    Cost O(N log N).
    """
    origin = points.mean(axis=0)
    means = points - origin
    squares, counts = (means**2).sum(axis=1), np.ones(len(points))
    if width > 0:
        boxes = np.floor((means - means.min(axis=0)) / width)
        _, cell, numbers = np.unique(boxes, axis=0, return_inverse=True, return_counts=True)
        cell, counts = cell.reshape(-1), numbers.astype(np.float64)
        means = np.stack([np.bincount(cell, coordinates) for coordinates in means.T], axis=1) / counts[:, None]
        squares = np.bincount(cell, squares) / counts
    blocks = []
    for index in _neighbours(means, np.arange(len(means))):
        inside = means[index]
        centre = 0.5 * (inside.min(axis=0) + inside.max(axis=0))
        radius = float(np.linalg.norm(inside - centre, axis=1).max())
        blocks.append(Block(inside, squares[index], counts[index], centre, radius))
    return DataCells(origin, tuple(blocks), len(points), width)


def _neighbours(points: Array, index: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Parts of `index` of at most `_BLOCK` points, halved across the longest side of what they fill."""
    if len(index) <= _BLOCK:
        yield index
        return
    axis = int(np.ptp(points[index], axis=0).argmax())
    half = len(index) // 2
    order = index[np.argpartition(points[index, axis], half)]
    yield from _neighbours(points, order[:half])
    yield from _neighbours(points, order[half:])
