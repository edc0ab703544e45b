"""Meshes of the unit square: the design's uniform one, and scans that are refined in places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

SizeFunction = Callable[[np.ndarray], np.ndarray]

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
_STEPS, _STEP, _PRESSURE = 200, 0.2, 1.2  # of the truss; the last two as Persson & Strang give them
_RETRIANGULATE = 0.1  # of the finest edge: points that moved farther get new triangles


@dataclass(frozen=True, eq=False)
class Mesh:
    """Nodes (n, 2), of which the first four are the corners of a refined one, and triangles (t, 3)."""

    nodes: np.ndarray
    triangles: np.ndarray

    def nodal_areas(self, places: np.ndarray) -> np.ndarray:
        """A third of the area of the triangles around every node, with the nodes at `places` (n, 2)."""
        a, b, c = places[self.triangles].transpose(1, 0, 2)
        areas = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        return np.bincount(self.triangles.ravel(), np.repeat(areas / 3.0, 3), minlength=len(places))

    @property
    def contrast(self) -> float:
        """95th over 5th percentile of the nodal areas."""
        high, low = np.percentile(self.nodal_areas(self.nodes), [95.0, 5.0])
        return float(high / low)


@dataclass(frozen=True)
class Refinement:
    """Edges as long as `finest` at the nearest of `spots`, growing from there up to `coarsest`."""

    name: str
    spots: tuple[tuple[float, float], ...]
    finest: float
    growth: float
    coarsest: float

    def size(self, points: np.ndarray) -> np.ndarray:
        distances = np.linalg.norm(points[:, None] - np.array(self.spots), axis=2).min(axis=1)
        return np.minimum(self.finest + self.growth * distances, self.coarsest)


def uniform_mesh(per_side: int) -> Mesh:
    axis = np.linspace(0.0, 1.0, per_side)
    nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    numbers = np.arange(len(nodes)).reshape(per_side, per_side)
    a, b, c, d = (part.ravel() for part in (numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]))
    return Mesh(nodes, np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


def refined_mesh(refinement: Refinement, seed: int) -> Mesh:
    """Mesh of the unit square whose edges are as long as the refinement says.

    Points are drawn in proportion to the wanted density; then the edges of their Delaunay triangles push like the
    rods of a truss until they have the wanted lengths. Source: Persson & Strang 2004, the mesh maker of the paper.
    """
    generator = np.random.default_rng(seed)
    nodes = uniform_mesh(round(1.0 / refinement.finest) + 1).nodes
    density = 1.0 / refinement.size(nodes) ** 2
    nodes = nodes[generator.random(len(nodes)) < density / density.max()]
    inner = (np.abs(nodes[:, None] - CORNERS).max(axis=2) > 0).all(axis=1)
    nodes = np.vstack([CORNERS, nodes[inner]])
    triangulated = np.full_like(nodes, np.inf)
    for _ in range(_STEPS):
        if np.abs(nodes - triangulated).max() > _RETRIANGULATE * refinement.finest:
            triangulated = nodes.copy()
            corners = Delaunay(nodes).simplices
            edges = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        rods = nodes[edges[:, 0]] - nodes[edges[:, 1]]
        lengths = np.linalg.norm(rods, axis=1)
        wanted = refinement.size(nodes[edges].mean(axis=1))
        wanted *= _PRESSURE * np.sqrt((lengths**2).sum() / (wanted**2).sum())
        push = (np.maximum(wanted / lengths - 1.0, 0.0))[:, None] * rods
        forces = np.zeros_like(nodes)
        np.add.at(forces, edges[:, 0], push)
        np.add.at(forces, edges[:, 1], -push)
        forces[: len(CORNERS)] = 0.0
        nodes = np.clip(nodes + _STEP * forces, 0.0, 1.0)
    return Mesh(nodes, Delaunay(nodes).simplices)
