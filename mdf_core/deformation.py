"""The result of a registration: a smooth map between the scan and the design, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mdf_core.geometry import Array
from mdf_core.kernel import KernelBasis, gaussian_kernel
from mdf_core.rigid import inverse, transform

_CHUNK = 16_384  # points per basis evaluation; bounds the memory to _CHUNK x rank
_FIXED_POINT_STEPS, _NEWTON_STEPS = 30, 30
_ROUGH_STEPS = 3


@dataclass(frozen=True, eq=False)
class Deformation:
    """The motion M(y) = y + Φ(y) C + [(y - origin) / scale, 1] A between the posed scan and the design.

    It maps the posed scan onto the design (as T of the paper), or, of what the surface stage measures, the design onto
    the posed scan: a distortion is smooth over the part, so its prior belongs there. `datum` moves `start`'s frame
    so that the displacement of the part has no rigid component: where the part lay on the scanner is no distortion.

    Attributes
    ----------
    start : (D+1, D+1) float64
        Rigid pose in which the motion is defined, scan to design frame.
    datum : (D+1, D+1) float64
        Best rigid fit of the deformed part to the design, applied after `start`.
    basis : KernelBasis
    coefficients : (r, D) float64, mm
        C; V of the paper for a dense kernel.
    affine : (D+1, D) float64, mm
        A.
    origin : (D,) float64, mm
    scale : float, mm
    covariance : (D (r+D+1), D (r+D+1)) float64 mm², or None
        Posterior covariance of (C, A), axis by axis; None where the method has none.
    maps_design : bool
        The motion maps the design onto the posed scan, not the posed scan onto the design.
    """

    start: Array
    datum: Array
    basis: KernelBasis
    coefficients: Array
    affine: Array
    origin: Array
    scale: float
    covariance: Array | None = None
    maps_design: bool = False

    @property
    def pose(self) -> Array:
        """T_design_scan, the rigid part of the registration, (D+1, D+1)."""
        return self.datum @ self.start

    def framed(self, start: Array, datum: Array) -> Deformation:
        """The same motion between a rigid pose `start` and a `datum`, both (D+1, D+1)."""
        return replace(self, start=start, datum=datum)

    def without_rigid_part(self, design_points: Array, weights: Array) -> Deformation:
        """The same motion, known as well as what is left of it after a rigid fit, see `without_rigid_part`."""
        return without_rigid_part([self], [design_points], [weights])[0]

    def apply(self, points: Array) -> Array:
        """Scan coordinates (n, D) mm to design coordinates (n, D) mm; NaN where the motion has no inverse."""
        return self._to_design(transform(self.start, points))

    def apply_roughly(self, points: Array) -> Array:
        """`apply` but for a few per cent of the motion: soon done, and finite also where there is no inverse."""
        if not self.maps_design:
            return self.apply(points)
        placed = places = transform(self.start, points)
        for _ in range(_ROUGH_STEPS):
            places = placed - self._motion(places)
        return places

    def displacement_at(self, design_points: Array) -> Array:
        """Where the material of `design_points` (n, D) mm went in the print, minus where it should be, (n, D) mm.

        NaN where the motion folds space.
        """
        return transform(self.datum, self._to_scan(design_points)) - design_points

    def inverse_displacement_at(self, design_points: Array) -> Array:
        """Where the material now found at `design_points` (n, D) mm belongs, minus that place, (n, D) mm.

        NaN where the motion has no inverse. Source: paper section 3.3, u = Y' - y, looked up at y.
        """
        return self._to_design(transform(inverse(self.datum), design_points)) - design_points

    def std(self, design_points: Array) -> Array:
        """Posterior standard deviation (RMS length of the error vector) of the displacement, (n,) mm.

        NaN where the method has no posterior or the motion no inverse.
        """
        if self.covariance is None:
            return np.full(len(design_points), np.nan)
        places, dimension = self._places(design_points), design_points.shape[1]
        unknowns = len(self.covariance) // dimension
        summed = np.einsum("iaib->ab", self.covariance.reshape(dimension, unknowns, dimension, unknowns))
        result = np.empty(len(places))
        for begin in range(0, len(places), _CHUNK):
            features = motion_features(self.basis, places[begin : begin + _CHUNK], self.origin, self.scale)
            variance = np.einsum("ij,ij->i", features @ summed, features)
            result[begin : begin + _CHUNK] = np.sqrt(np.maximum(variance, 0.0))
        return result

    def _places(self, design_points: Array) -> Array:
        """Where the motion of `design_points` is looked up."""
        return design_points if self.maps_design else self._invert(design_points)

    def _affine_moments(self, design_points: Array, weights: Array) -> Array:
        """Weighted products of the affine features with all features of the points, summed, (D+1, r+D+1)."""
        counted = weights > 0
        places, weights = self._places(design_points[counted]), weights[counted]
        known = np.isfinite(places).all(axis=1)
        places, weights = places[known], weights[known]
        size = places.shape[1] + 1
        total = np.zeros((size, len(self.coefficients) + size))
        for begin in range(0, len(places), _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            affine = affine_features(places[chunk], self.origin, self.scale)
            total += (weights[chunk, None] * affine).T @ np.hstack([self.basis(places[chunk]), affine])
        return total

    def _to_design(self, placed: Array) -> Array:
        return self._invert(placed) if self.maps_design else placed + self._motion(placed)

    def _to_scan(self, design_points: Array) -> Array:
        if not self.maps_design:
            return self._invert(design_points)
        placed = design_points + self._motion(design_points)
        placed[np.linalg.det(self.jacobian(design_points)) <= 0.0] = np.nan
        return placed

    def _motion(self, places: Array) -> Array:
        result = affine_features(places, self.origin, self.scale) @ self.affine
        weights = self.basis.weights(self.coefficients)  # a vector for each centre, not a matrix for each point
        for begin in range(0, len(places), _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            result[chunk] += gaussian_kernel(places[chunk], self.basis.centres, self.basis.width) @ weights
        return result

    def _invert(self, targets: Array) -> Array:
        """Solve y + motion(y) = target to 1e-9 of the scale; NaN where that has no solution.

        Fixed-point iteration, Newton where that stalls.
        """
        places = targets - self._motion(targets)
        unsolved = np.arange(len(places))
        for step in range(_FIXED_POINT_STEPS + _NEWTON_STEPS):
            error = places[unsolved] + self._motion(places[unsolved]) - targets[unsolved]
            far = ~(np.abs(error).max(axis=1) < 1e-9 * self.scale)
            unsolved, error = unsolved[far], error[far]
            if len(unsolved) == 0:
                return places
            if step >= _FIXED_POINT_STEPS:
                error = np.linalg.solve(self.jacobian(places[unsolved]), error[:, :, None])[:, :, 0]
            places[unsolved] -= error
        places[unsolved] = np.nan
        return places

    def jacobian(self, places: Array) -> Array:
        """Derivative of the motion M at `places` (n, D) mm, (n, D, D): row = component of M, column = of the place."""
        basis, dimension = self.basis, places.shape[1]
        squares = np.broadcast_to(np.square(basis.width), len(basis.centres))
        weights = basis.weights(self.coefficients) / squares[:, None]
        products = (weights[:, :, None] * basis.centres[:, None, :]).reshape(len(weights), -1)
        linear = np.eye(dimension) + self.affine[:dimension].T / self.scale
        result = np.empty((len(places), dimension, dimension))
        for begin in range(0, len(places), _CHUNK):
            chunk = places[begin : begin + _CHUNK]
            values = gaussian_kernel(chunk, basis.centres, basis.width)
            away = (values @ weights)[:, :, None] * chunk[:, None, :]
            away -= (values @ products).reshape(-1, dimension, dimension)
            result[begin : begin + _CHUNK] = linear - away
        return result


def tangential_stretches(jacobian: Array, normals: Array) -> Array:
    """By how much lengths in a surface grow, least and most, (n, 2).

    Parameters
    ----------
    jacobian : (n, 3, 3) float64
        Derivative of the motion at points of the surface.
    normals : (n, 3) float64
        Their unit normals: what a motion does along these is hardly measured.
    """
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    tangents = np.stack([across, np.cross(normals, across)], axis=2)
    values: Array = np.linalg.svd(jacobian @ tangents, compute_uv=False)
    return values[:, ::-1]


def motion_features(basis: KernelBasis, points: Array, origin: Array, scale: float) -> Array:
    """[Φ(y), (y - origin) / scale, 1] for `points` (n, D) mm, (n, r+D+1): what the motion is linear in."""
    return np.hstack([basis(points), affine_features(points, origin, scale)])


def affine_features(points: Array, origin: Array, scale: float) -> Array:
    """[(y - origin) / scale, 1] for `points` (n, D) mm, (n, D+1)."""
    return np.hstack([(points - origin) / scale, np.ones((len(points), 1))])


def without_rigid_part(
    motions: Sequence[Deformation], design_points: Sequence[Array], weights: Sequence[Array]
) -> tuple[Deformation, ...]:
    """The same motions with the covariance of what is left of them after the best rigid fit of all points together.

    Parameters
    ----------
    motions : sequence of Deformation
        Of the pieces of one part, independent of each other.
    design_points : sequence of (n, D) float64, mm
        Of each piece, those that the datum is fitted to.
    weights : sequence of (n,) float64

    Notes
    -----
    Where the part lies is no displacement; yet what is poorly known, such as a slide along the faces of a clip, shifts
    the clip as well. To first order the fit is linear in the unknowns c of all motions, θ = Σ X c, and what it takes
    away is an affine motion, E θ. Source: propagation of errors, (I - E X) cov(c) (I - E X)ᵀ.
    Cost O(n · r) and O(r²).
    """
    known = [motion.covariance for motion in motions if motion.covariance is not None]
    if len(known) < len(motions):
        return tuple(motions)
    generators = _rigid_generators(design_points[0].shape[1])
    sums = [one._affine_moments(*given) for one, *given in zip(motions, design_points, weights, strict=True)]
    pulls = [np.einsum("kfa,fm->kam", generators, each).reshape(len(generators), -1) for each in sums]
    rigid = [_as_unknowns(generators, each.shape[1]) for each in sums]
    normal = np.sum([pull @ one for pull, one in zip(pulls, rigid, strict=True)], axis=0)
    fits = [np.linalg.pinv(normal) @ pull for pull in pulls]
    crossed = [fit @ covariance for fit, covariance in zip(fits, known, strict=True)]
    of_fit = np.sum([one @ fit.T for one, fit in zip(crossed, fits, strict=True)], axis=0)
    left = []
    for motion, covariance, one, cross in zip(motions, known, rigid, crossed, strict=True):
        taken = one @ (cross - 0.5 * of_fit @ one.T)
        left.append(replace(motion, covariance=covariance - taken - taken.T))
    return tuple(left)


def _rigid_generators(dimension: int) -> Array:
    """Small rigid motions, the shifts and the turns, as coefficients A of affine features, (k, D+1, D)."""
    shifts = np.zeros((dimension, dimension + 1, dimension))
    shifts[range(dimension), dimension, range(dimension)] = 1.0
    turns = []
    for first, second in combinations(range(dimension), 2):
        turn = np.zeros((dimension + 1, dimension))
        turn[first, second], turn[second, first] = 1.0, -1.0
        turns.append(turn)
    return np.concatenate([shifts, turns])


def _as_unknowns(generators: Array, unknowns: int) -> Array:
    """Rigid motions as coefficients (C, A) of a motion with so many unknowns per axis, axis by axis, (D r', k)."""
    count, affine, dimension = generators.shape
    coefficients = np.zeros((dimension, unknowns, count))
    coefficients[:, unknowns - affine :] = generators.transpose(2, 1, 0)
    return coefficients.reshape(-1, count)
