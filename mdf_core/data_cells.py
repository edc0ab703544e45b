"""The data of a mixture: in a tree of blocks and, while the mixture is wide, in cells of points treated as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mdf_core.geometry import Array

_BLOCK = 256  # cells at most; larger blocks outgrow the reach of a narrow mixture, smaller ones cost more calls


@dataclass(frozen=True, eq=False)
class Block:
    """Cells that are neighbours, and their halves.

    Attributes
    ----------
    begin, end : int
        The cells, of those in `DataCells`.
    centre : (D,) float64
    radius : float
        No mean of a cell is farther from `centre`.
    halves : tuple of Block
        Two, or none where the cells are few.
    """

    begin: int
    end: int
    centre: Array
    radius: float
    halves: tuple[Block, ...]


@dataclass(frozen=True, eq=False)
class DataCells:
    """Data points in cells, and the cells in blocks.

    Attributes
    ----------
    origin : (D,) float64
        Mean of all points; all coordinates are relative to it, which keeps the rounding small.
    means : (n, D) float64
        Of the points in every cell.
    squares : (n,) float64
        Mean |x|² of the points in every cell.
    counts : (n,) float64
        Number of points in every cell.
    blocks : Block
        All cells.
    width : float
        Of the cells; 0 if every point is a cell of its own.
    """

    origin: Array
    means: Array
    squares: Array
    counts: Array
    blocks: Block
    width: float


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
    order = np.arange(len(means))
    blocks = _block(means, order, 0, len(order))
    return DataCells(origin, means[order], squares[order], counts[order], blocks, width)


def _block(means: Array, order: NDArray[np.intp], begin: int, end: int) -> Block:
    """The block of the cells `order[begin:end]`, which are put in order: halved across the longest side."""
    inside = means[order[begin:end]]
    centre = 0.5 * (inside.min(axis=0) + inside.max(axis=0))
    radius = float(np.linalg.norm(inside - centre, axis=1).max())
    if end - begin <= _BLOCK:
        return Block(begin, end, centre, radius, ())
    middle = (begin + end) // 2
    across = inside[:, np.ptp(inside, axis=0).argmax()]
    order[begin:end] = order[begin:end][np.argpartition(across, middle - begin)]
    return Block(begin, end, centre, radius, (_block(means, order, begin, middle), _block(means, order, middle, end)))
