"""Points of a scan that have no others around them on the design."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mdf_core.geometry import Array

_NEIGHBOURS = 3
_REACH = 8.0  # of the median distance of that neighbour: a scanner that sees a face at all sets points more densely
_JUDGES = 1_000  # points, at most, tell that median


class ShownPlaces:
    """The places of the design that points of a scan show, each with how the design faces there.

    What a face that is not seen did is not known; one outlier that happens to lie on it would tell, and nothing
    contradict it. So a place is shown by several points or not at all.

    Parameters
    ----------
    feet : (n, 3) float64, mm
        Of the points, on the design.
    normals : (n, 3) float64
        Of the design there.

    Notes
    -----
    Building costs O(n log n).
    """

    def __init__(self, feet: Array, normals: Array) -> None:
        distinct = np.unique(feet, axis=0)  # of points that occur several times the neighbours are as far as of others
        judges = np.linspace(0, len(distinct) - 1, min(len(distinct), _JUDGES)).astype(np.intp)
        # A motion that goes astray may bring all points to a few places, which are no more alone than each other.
        neighbour = min(_NEIGHBOURS, len(distinct) - 1) + 1
        query = KDTree(distinct, balanced_tree=False).query(distinct[judges], k=[neighbour])
        self._reach = _REACH * float(np.median(query[0])) or 1.0
        self._keys = self._keyed(feet, normals)
        self._tree = KDTree(self._keys, balanced_tree=False)

    def _keyed(self, feet: Array, normals: Array) -> Array:
        """So that places which face 60° apart are out of each other's reach."""
        return np.hstack([feet, self._reach * normals])

    def lone(self) -> NDArray[np.bool_]:
        """Which of the points have hardly others around them that face alike, (n,). Cost O(n log n)."""
        return self._are_alone(self._keys, _NEIGHBOURS + 1)  # itself is the first

    def leave_out(self, feet: Array, normals: Array) -> NDArray[np.bool_]:
        """Which of the places (m, 3) mm with these `normals` (m, 3) are not shown, (m,). Cost O(m log n)."""
        return self._are_alone(self._keyed(feet, normals), _NEIGHBOURS)

    def _are_alone(self, keys: Array, neighbours: int) -> NDArray[np.bool_]:
        query = self._tree.query(keys, k=[neighbours], distance_upper_bound=self._reach, workers=-1)
        alone: NDArray[np.bool_] = np.isinf(query[0])[:, 0]
        return alone
