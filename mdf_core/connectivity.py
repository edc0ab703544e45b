"""What hangs together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def connected_groups(edges: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    """The group of each of `count` things, numbered from 0, (count,): those that `edges` (e, 2) join share one.

    Cost O(e + count).
    """
    joined = coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    groups: NDArray[np.int32] = connected_components(joined, directed=False)[1]
    return groups
