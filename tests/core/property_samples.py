"""Point sets and motions to try what holds for all of them: many, and the same ones every time."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mdf_core.rigid import homogeneous


def tried(examples):
    return settings(max_examples=examples, deadline=None, derandomize=True, database=None)


seeds = st.integers(0, 2**31 - 1)


def random_motion(seed, farthest=1_000.0):
    """T (4, 4): any rotation, and a translation up to `farthest` mm along every axis."""
    rng = np.random.default_rng(seed)
    return homogeneous(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-farthest, farthest, 3))


@st.composite
def clouds(draw, dimensions=(2, 3), least=1, most=40):
    """Points (n, D) that fill space, a plane, a line or a spot, with or without copies, near or far from the origin."""
    dimension = draw(st.sampled_from(dimensions))
    count = draw(st.integers(least, most))
    rng = np.random.default_rng(draw(seeds))
    points = rng.normal(size=(count, dimension))
    points[:, draw(st.integers(0, dimension)) :] = 0.0
    points = points @ np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    if draw(st.booleans()):
        points = points[rng.integers(0, count, count)]
    size = draw(st.sampled_from([1e-3, 1.0, 50.0]))
    return size * points + draw(st.sampled_from([0.0, 3.0, 1e3])) * size
