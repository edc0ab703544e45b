"""What the print looks like between the vertices of the design: its facets have stayed flat, or have bent.

The prints of a machine bend everywhere. A mesh whose vertices were moved, as simulations do, has flat facets: in
between it lies off the bent ones by what the curvature makes of the edges' length, a micrometre or two where the edges
are 2 mm. That is little, but it is the same everywhere, so no number of points averages it out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import points_to_barycentric

from mdf_core.deformation import motion_features
from mdf_core.design_surface import Closest
from mdf_core.geometry import Array, Design
from mdf_core.kernel import KernelBasis

MOST_FACETS = 200_000
"""Of a design that flat facets are tried on: finer ones lie on the bent ones."""


class Facets(Protocol):
    """Places on the design whose motion is asked for."""

    def __len__(self) -> int: ...

    def take(self, some: slice) -> Facets:
        """Some of them."""

    def places(self) -> Array:
        """Where they are, (n, 3) mm."""

    def features(self, basis: KernelBasis, origin: Array, scale: float) -> Array:
        """What their motion is linear in, (n, r + 4)."""


@dataclass(frozen=True, eq=False)
class BentFacets:
    """Every place has a motion of its own.

    Attributes
    ----------
    feet : (n, 3) float64, mm
    """

    feet: Array

    def __len__(self) -> int:
        return len(self.feet)

    def take(self, some: slice) -> BentFacets:
        """See `Facets`."""
        return BentFacets(self.feet[some])

    def places(self) -> Array:
        """See `Facets`."""
        return self.feet

    def features(self, basis: KernelBasis, origin: Array, scale: float) -> Array:
        """See `Facets`."""
        return motion_features(basis, self.feet, origin, scale)


@dataclass(frozen=True, eq=False)
class FlatFacets:
    """Every place moves with the corners of its triangle.

    Attributes
    ----------
    vertices : (v, 3) float64, mm
    corners : (n, 3) int64
        Of the triangle each place lies on.
    shares : (n, 3) float64
        Barycentric coordinates of the places.
    """

    vertices: Array
    corners: NDArray[np.int64]
    shares: Array

    def __len__(self) -> int:
        return len(self.corners)

    @classmethod
    def below(cls, closest: Closest, printed: Design, design: Design) -> FlatFacets:
        """Those of `design` that the `closest` points of `printed` lie on, a mesh with the same faces."""
        shares = points_to_barycentric(printed.triangles[closest.faces], closest.points)
        # Of a triangle without area any place would do.
        shares = np.where(np.isfinite(shares).all(axis=1, keepdims=True), shares, 1.0 / 3.0)
        return cls(design.vertices, design.faces[closest.faces], shares)

    def take(self, some: slice) -> FlatFacets:
        """See `Facets`."""
        return FlatFacets(self.vertices, self.corners[some], self.shares[some])

    def places(self) -> Array:
        """See `Facets`."""
        found: Array = np.einsum("nc,ncd->nd", self.shares, self.vertices[self.corners])
        return found

    def features(self, basis: KernelBasis, origin: Array, scale: float) -> Array:
        """See `Facets`."""
        used, of_used = np.unique(self.corners, return_inverse=True)
        at_corners = motion_features(basis, self.vertices[used], origin, scale)
        of_used = of_used.reshape(-1, 3)
        features: Array = self.shares[:, :1] * at_corners[of_used[:, 0]]
        for corner in (1, 2):
            features += self.shares[:, corner, None] * at_corners[of_used[:, corner]]
        return features
