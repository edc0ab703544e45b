"""The paper's algorithm line by line, dense, with its formulas as they should read or as they are printed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.distance import cdist

from mdf_core.mixture import box_density

_LEAST_SIGMA = 1e-4


@dataclass(frozen=True)
class Formulas:
    """The corrected ones; each field can be set to what the paper prints instead.

    `filled_dimension` is d in the weight w^(1 - d/2) of a component in the posterior; None: D, the space's. The paper's
    table prints D, its text leaves the weight out, which is d = 2.
    """

    outlier_constant: Literal["beside the sum", "in the exponent", "in the sum"] = "beside the sum"
    outlier_density: Literal["1 / volume", "1 / N"] = "1 / volume"
    filled_dimension: int | None = None
    explained: Literal["1'P1", "1'P~1"] = "1'P1"
    motion_sign: Literal["X - (y + GV)", "X - y + GV"] = "X - (y + GV)"


CORRECT = Formulas()


@dataclass(frozen=True)
class Parameters:
    """Of the mixture; lengths in units of the scale."""

    outlier_share: float
    beta: float = 3.0
    alpha: float = 2.0
    iterations: int = 300
    tolerance: float = 1e-4


def register(
    scan: np.ndarray, design: np.ndarray, weights: np.ndarray, parameters: Parameters, formulas: Formulas = CORRECT
) -> np.ndarray:
    """Where the scan points (m, D) belong on the design (N, D), (m, D); all lengths in units of the scale.

    Written for reading and for small sets, memory O(m N); `mdf_core.registration` is the one to use.
    """
    count, dimension = scan.shape
    share, penalty = parameters.outlier_share, parameters.alpha
    kernel = np.exp(-_squares(scan, scan) / (2.0 * parameters.beta**2))
    variance = _squares(scan, design).mean() / dimension
    density = box_density(design) if formulas.outlier_density == "1 / volume" else 1.0 / len(design)
    factor = weights ** (1.0 - (formulas.filled_dimension or dimension) / 2.0)
    motion, moved = np.zeros_like(scan), scan
    for _ in range(parameters.iterations):
        sign = 1.0 if formulas.motion_sign == "X - (y + GV)" else -1.0
        exponents = -_squares(scan + sign * motion, design) / (2.0 * weights[:, None] * variance)
        constant = share / (1.0 - share) * (2.0 * np.pi * variance) ** (dimension / 2.0) * count * density
        responsibilities = _responsibilities(exponents, factor, constant, formulas)
        relative = responsibilities / weights[:, None]
        mass = relative.sum(axis=1)
        right = relative @ design - mass[:, None] * scan
        motion = kernel @ np.linalg.solve(mass[:, None] * kernel + penalty * variance * np.eye(count), right)
        last, moved = moved, scan + motion
        explained = (responsibilities if formulas.explained == "1'P1" else relative).sum()
        last_variance = variance
        variance = max((relative * _squares(moved, design)).sum() / (dimension * explained), _LEAST_SIGMA**2)
        step = max(np.linalg.norm(moved - last, axis=1).max(), abs(np.sqrt(variance) - np.sqrt(last_variance)))
        if step <= parameters.tolerance:
            break
    return moved


def _responsibilities(exponents: np.ndarray, factor: np.ndarray, constant: float, formulas: Formulas) -> np.ndarray:
    """P (m, N); the largest exponent of each design point is taken out first, which changes nothing but the range."""
    largest = exponents.max(axis=0)
    terms = factor[:, None] * np.exp(exponents - largest)
    if formulas.outlier_constant == "in the exponent":
        return terms / (terms.sum(axis=0) * np.exp(min(constant, 600.0)))
    times = len(factor) if formulas.outlier_constant == "in the sum" else 1
    with np.errstate(over="ignore"):  # an infinite constant is an outlier for certain
        return terms / (terms.sum(axis=0) + times * constant * np.exp(-largest))


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Squared distances of all pairs."""
    return cdist(one, other, "sqeuclidean")
