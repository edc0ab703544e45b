"""What holds for every surface, scan and map: tried on many, the same ones every time."""

import numpy as np
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from property_samples import clouds, random_motion, seeds, tried
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

import mdf_core as mdf
from mdf_core.deformation import Deformation
from mdf_core.design_surface import DesignSurface, spread_samples
from mdf_core.geometry import PointSet
from mdf_core.kernel import KernelBasis
from mdf_core.rigid import best_rigid_fit, homogeneous, inverse, transform
from mdf_core.sampling import thin
from mdf_core.settings import ThinningSettings

# --- the design's surface --------------------------------------------------------------------------------------------


@st.composite
def surfaces(draw):
    """Closed bodies of any proportions, dented ones, and triangles strewn at random."""
    rng = np.random.default_rng(draw(seeds))
    kind = draw(st.sampled_from(["box", "dented", "strewn"]))
    size = rng.uniform(2.0, 60.0, 3)
    if kind == "box":
        mesh = trimesh.creation.box(size)
        return mdf.Design(mesh.vertices, mesh.faces)
    if kind == "dented":
        mesh = trimesh.creation.icosphere(subdivisions=2)
        return mdf.Design(size * mesh.vertices * rng.uniform(0.8, 1.2, (len(mesh.vertices), 1)), mesh.faces)
    corners = rng.uniform(-30.0, 30.0, (25, 1, 3)) + rng.uniform(-12.0, 12.0, (25, 3, 3))
    return mdf.Design(corners.reshape(-1, 3), np.arange(75).reshape(-1, 3))


def distance_to_all_triangles(design, points):
    feet = closest_point(np.repeat(design.triangles, len(points), axis=0), np.tile(points, (len(design.faces), 1)))
    squares = ((feet.reshape(len(design.faces), len(points), 3) - points) ** 2).sum(axis=2)
    return np.sqrt(squares.min(axis=0))


@tried(20)
@given(design=surfaces(), seed=seeds, reach=st.sampled_from([0.01, 3.0, 200.0]), motion_seed=seeds)
def test_the_foot_found_is_the_nearest_or_as_near_as_the_samples_are_dense(design, seed, reach, motion_seed):
    motion = random_motion(motion_seed)
    samples, _ = spread_samples(design, 20_000)
    rng = np.random.default_rng(seed)
    points = samples[rng.integers(0, len(samples), 60)] + rng.uniform(-reach, reach, (60, 3))
    found = DesignSurface(design, 20_000).closest(points)
    distances, nearest = np.linalg.norm(points - found.points, axis=1), distance_to_all_triangles(design, points)
    excess = distances - nearest
    assert excess.min() > -1e-9
    assert (distances <= KDTree(samples).query(points)[0] + 1e-9).all()  # for certain
    spacing = np.sqrt(design.face_areas.sum() / 20_000)
    assert excess.max() < spacing  # in practice
    assert (excess < 1e-9).mean() > 0.8
    # The distance along the normal is no longer than the distance, and as long where the foot lies within a triangle.
    assert (np.abs(found.distances) <= distances + 1e-9).all()
    # The same surface elsewhere.
    there = mdf.Design(transform(motion, design.vertices), design.faces)
    again = DesignSurface(there, 20_000).closest(transform(motion, points))
    np.testing.assert_allclose(
        np.linalg.norm(transform(motion, points) - again.points, axis=1), distances, atol=0.1 * spacing
    )


# --- thinning --------------------------------------------------------------------------------------------------------


@st.composite
def scans(draw):
    """Points of a bent sheet with normals and areas, up to tenfold denser at one end."""
    rng = np.random.default_rng(draw(seeds))
    count = draw(st.integers(300, 3_000))
    along = rng.uniform(0.0, 1.0, count) ** draw(st.sampled_from([1.0, 1.5]))
    points = np.column_stack([100.0 * along, rng.uniform(0.0, 60.0, count), 8.0 * np.sin(5.0 * along)])
    points = transform(random_motion(draw(seeds)), points)
    normals = rng.normal(size=(count, 3))
    return PointSet(points, normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(0.1, 2.0, count))


def places_in(scan, thinned):
    """Where the points kept were in the scan."""
    index_of = {tuple(point): index for index, point in enumerate(scan.points)}
    return np.array([index_of[tuple(point)] for point in thinned.points])


@tried(15)
@given(scan=scans(), share=st.floats(0.1, 0.9), seed=st.integers(0, 5))
def test_thinning_keeps_points_as_they_are_and_hands_their_areas_on(scan, share, seed):
    settings = ThinningSettings(target_points=max(100, round(share * len(scan))))
    thinned = thin(scan, settings, seed)
    assert len(thinned) <= settings.target_points
    kept = places_in(scan, thinned)
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(thinned.normals, scan.normals[kept])
    assert (thinned.areas >= scan.areas[kept]).all()
    assert 0.98 * scan.areas.sum() < thinned.areas.sum() <= (1.0 + 1e-12) * scan.areas.sum()
    assert thin(thinned, settings, seed) is thinned


@tried(15)
@given(scan=scans(), edge=st.floats(2.0, 12.0), seed=st.integers(0, 5))
def test_a_box_keeps_one_point_and_all_of_its_area(scan, edge, seed):
    thinned = thin(scan, ThinningSettings(box_mm=edge), seed)
    boxes = np.floor(scan.points / edge)
    _, box_of = np.unique(boxes, axis=0, return_inverse=True)
    box_of = box_of.reshape(-1)
    kept = places_in(scan, thinned)
    assert len({*box_of[kept]}) == len(kept)
    np.testing.assert_allclose(thinned.areas, np.bincount(box_of, scan.areas)[box_of[kept]], rtol=1e-12)
    assert thinned.areas.sum() > 0.95 * scan.areas.sum()  # what is nearly empty is left out


# --- maps and their inverses -----------------------------------------------------------------------------------------


@st.composite
def deformations(draw):
    """Smooth motions of any strength, of the scan or of the design, between poses, in the plane and in space."""
    dimension = draw(st.sampled_from([2, 3]))
    rng = np.random.default_rng(draw(seeds))
    turns = [np.linalg.qr(rng.normal(size=(dimension, dimension)))[0] for _ in range(2)]
    turns = [turn * np.where(np.arange(dimension) == 0, np.linalg.det(turn), 1.0) for turn in turns]
    amplitude = draw(st.sampled_from([0.0, 0.1, 2.0, 15.0, 100.0]))
    return Deformation(
        start=homogeneous(turns[0], rng.uniform(-300.0, 300.0, dimension)),
        datum=homogeneous(turns[1], rng.uniform(-1.0, 1.0, dimension)),
        basis=KernelBasis(rng.uniform(-50.0, 50.0, (20, dimension)), draw(st.sampled_from([20.0, 60.0])), None),
        coefficients=amplitude / 3.0 * rng.normal(size=(20, dimension)),
        affine=0.2 * amplitude * rng.normal(size=(dimension + 1, dimension)),
        origin=np.zeros(dimension),
        scale=40.0,
        maps_design=draw(st.booleans()),
    )


def steepest(deformation):
    """More than which the motion's derivative is nowhere, in any direction; below 1 the motion cannot fold."""
    dimension = len(deformation.origin)
    waves = np.linalg.norm(deformation.coefficients, axis=1).sum() * np.exp(-0.5) / deformation.basis.width
    return waves + np.linalg.norm(deformation.affine[:dimension], 2) / deformation.scale


@tried(40)
@given(deformation=deformations(), seed=seeds)
def test_the_way_there_and_back_ends_where_it_began_or_is_not_a_number(deformation, seed):
    nominal = np.random.default_rng(seed).uniform(-50.0, 50.0, (50, len(deformation.origin)))
    displacement = deformation.displacement_at(nominal)
    known = np.isfinite(displacement).all(axis=1)
    assert np.isnan(displacement[~known]).all()
    may_fold = steepest(deformation) >= 1.0
    assert may_fold or known.all()
    if deformation.maps_design:
        np.testing.assert_array_equal(known, np.linalg.det(deformation.jacobian(nominal)) > 0.0)
        if may_fold:
            return  # several places of the design may come to lie on one
    nominal, displaced = nominal[known], (nominal + displacement)[known]
    in_scanner = transform(inverse(deformation.pose), displaced)
    np.testing.assert_allclose(deformation.apply(in_scanner), nominal, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(deformation.inverse_displacement_at(displaced), nominal - displaced, rtol=0, atol=1e-6)


@tried(60)
@given(points=clouds(most=15), seed=seeds, weighted=st.booleans())
def test_the_best_rigid_fit_undoes_every_rigid_motion(points, seed, weighted):
    dimension = points.shape[1]
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    motion = homogeneous(turn, rng.uniform(-500.0, 500.0, dimension))
    weights = rng.uniform(0.1, 2.0, len(points)) if weighted else None
    fit = best_rigid_fit(points, transform(motion, points), weights)
    np.testing.assert_allclose(transform(fit, points), transform(motion, points), rtol=0.0, atol=1e-8)
    # Also where the points leave it open: a rotation, never a reflection.
    found = fit[:dimension, :dimension]
    np.testing.assert_allclose(found @ found.T, np.eye(dimension), atol=1e-12)
    assert np.linalg.det(found) > 0
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if (spread > 1e-6 * np.abs(points).max()).sum() >= dimension - 1:
        np.testing.assert_allclose(found, turn, atol=1e-5)
