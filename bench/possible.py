"""How much of a distortion could be found at best: the yardstick for what is found."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve

from bench.cases import Case, print_and_scan
from mdf_core.deformation import motion_features
from mdf_core.design_surface import spread_samples
from mdf_core.distortion import fraction_unrecovered
from mdf_core.geometry import Array
from mdf_core.kernel import low_rank_basis
from mdf_core.normal_equations import normal_matrix

MOST_POINTS = 50_000
"""Of a scan for which this is worked out."""

_POOL, _RANK, _REMAINDER = 5_000, 400, 1e-8
_LEAST_NOISE_MM = 1e-4  # a scan without noise has no variance to weigh the prior with
_FREE = 1e-9  # weight of the affine part


def possible_unrecovered(case: Case) -> float:
    """Share of the distortion that the best linear estimate misses, which knows all but the distortion itself.

    It knows from which place of the design each point came, which points are outliers, the noise, and of the distortion
    its correlation length and size; it gets the distances along the normals, as a scan of a surface tells no more. A
    registration has to find all of that as well.

    Source: Rasmussen & Williams 2006, equation 2.11, the mean of a Gaussian process.
    """
    warp, virtual = print_and_scan(case)
    design = warp.design
    true = ~virtual.is_outlier
    faces = virtual.source_faces[true]
    places = np.einsum("nc,ncd->nd", virtual.barycentric[true], design.triangles[faces])
    normals = design.face_normals[faces]
    noise = np.random.default_rng(0).normal(scale=case.noise_mm, size=len(places))
    distances = np.einsum("ni,ni->n", warp(places), normals) + noise
    basis = low_rank_basis(spread_samples(design, _POOL)[0], warp.correlation_length_mm, _RANK, _REMAINDER)

    def features(points: Array) -> Array:
        return motion_features(basis, points, design.centre, design.scale)

    known, rank = features(places), len(basis.centres)
    matrix = normal_matrix(known, normals, np.ones(len(places)))
    pull = (known.T @ (distances[:, None] * normals)).T.ravel()  # unknowns axis by axis
    weights = np.full(known.shape[1], _FREE)
    weights[:rank] = max(case.noise_mm, _LEAST_NOISE_MM) ** 2 / (warp.rms_mm**2 / 3.0)
    matrix[np.diag_indices_from(matrix)] += np.tile(weights, 3)
    solution = solve(matrix, pull, assume_a="pos").reshape(3, -1).T
    return fraction_unrecovered(design, warp(design.vertices), features(design.vertices) @ solution)
