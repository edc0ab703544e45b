"""Rigid motions as homogeneous matrices ``T_target_source`` in any dimension."""

from __future__ import annotations

import numpy as np

from mdf_core.geometry import Array


def transform(motion: Array, points: Array) -> Array:
    """Points (n, D) moved by the homogeneous matrix `motion` (D+1, D+1), (n, D)."""
    dimension = points.shape[1]
    moved: Array = points @ motion[:dimension, :dimension].T + motion[:dimension, dimension]
    return moved


def rotate(motion: Array, vectors: Array) -> Array:
    """Vectors (n, D), such as normals or displacements, turned by `motion` (D+1, D+1) but not moved, (n, D)."""
    dimension = vectors.shape[1]
    turned: Array = vectors @ motion[:dimension, :dimension].T
    return turned


def inverse(motion: Array) -> Array:
    """``T_source_target`` of the rigid motion ``T_target_source`` (D+1, D+1)."""
    dimension = len(motion) - 1
    rotation = motion[:dimension, :dimension].T
    return homogeneous(rotation, -rotation @ motion[:dimension, dimension])


def homogeneous(rotation: Array, translation: Array) -> Array:
    """Rotation (D, D) and translation (D,) as one matrix (D+1, D+1)."""
    dimension = len(translation)
    motion = np.eye(dimension + 1)
    motion[:dimension, :dimension] = rotation
    motion[:dimension, dimension] = translation
    return motion


def best_rigid_fit(source: Array, target: Array, weights: Array | None = None) -> Array:
    """The rotation and translation that bring `source` closest to `target` in the weighted least squares sense.

    Parameters
    ----------
    source, target : (n, D) float64, mm
        Corresponding points.
    weights : (n,) float64, or None
        Non-negative, not all zero; None weighs all points alike.

    Returns
    -------
    (D+1, D+1) float64
        ``T_target_source``, never a reflection.

    Notes
    -----
    Source: Umeyama 1991, equations 40 to 42 without the scale.
    """
    if weights is None:
        weights = np.ones(len(source))
    source_centre = np.average(source, axis=0, weights=weights)
    target_centre = np.average(target, axis=0, weights=weights)
    covariance = (target - target_centre).T @ (weights[:, None] * (source - source_centre))
    left, _, right = np.linalg.svd(covariance)
    signs = np.ones(source.shape[1])
    signs[-1] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    rotation = (left * signs) @ right
    return homogeneous(rotation, target_centre - rotation @ source_centre)
