"""Surfels of a part, and what is done with them, against plain twins."""

import numpy as np
import plane_world
import pytest
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.kernels import see_through
from lvba.lidar.bundle_adjustment import find_planes
from lvba.loop_closure import correlation, submap, surfel_icp, verification
from lvba.loop_closure.submap import Patch, SubmapConfig
from lvba.loop_closure.surfel_icp import Target


@pytest.fixture(scope="module")
def yard():
    """Planes, points and poses of a few scans."""
    poses = plane_world.path("courtyard", 40)[:6]
    scans = plane_world.scan_all(plane_world.courtyard(), poses, 6000, 0.02, "spinning", 1)
    return *find_planes(scans, poses), poses


@pytest.fixture(scope="module")
def patch(yard):
    planes, points, poses = yard
    return submap.around(submap.build(planes, points, poses, np.arange(10, 16)), 12, 20.0)


def test_surfels_are_the_means_of_the_points_of_a_plane_in_a_cell(yard):
    planes, points, poses = yard
    config = SubmapConfig(cell=0.8)
    built = submap.build(planes, points, poses, np.arange(10, 16), config=config)
    scan = np.repeat(np.arange(6), np.diff(points.scan_offsets))
    cells: dict[tuple[int, ...], list[int]] = {}
    for k in np.flatnonzero(points.plane >= 0):
        cell = np.floor(points.points_world[k] / 0.8).astype(int)
        cells.setdefault((*cell, int(points.plane[k])), []).append(k)
    plain, centers = [], []
    for (*_, plane), members in cells.items():
        if len(members) >= config.min_points:
            xyz = points.points_world[members].astype(float)
            away = np.linalg.norm(xyz - poses[scan[members], :3, 3], axis=1)
            plain.append((plane, len(members), scan[members][np.argmin(away)]))
            centers.append(xyz.mean(0))
    assert len(built) == len(plain)
    off, twin = cKDTree(np.array(centers)).query(built.center)
    assert off.max() < 1e-5
    for k in range(0, len(built), 7):
        plane, count, nearest = plain[twin[k]]
        np.testing.assert_allclose(built.normal[k], planes.normal[plane], atol=1e-6)
        assert built.weight[k] == count
        assert built.observer[k] == nearest


def test_a_submap_is_small_and_cells_of_small_places_too(yard):
    planes, points, poses = yard
    built = submap.build(planes, points, poses, np.arange(6))
    arrays = (built.center, built.normal, built.thickness, built.weight, built.observer)
    assert sum(array.nbytes for array in arrays) < 0.3 * points.points_world.nbytes
    assert built.cell == 0.4
    small = submap.build(planes, points, poses, np.arange(6), config=SubmapConfig(enough=10**6, full=4))
    assert small.cell == 0.1


def test_a_part_without_planes_has_an_empty_submap(yard):
    planes, points, poses = yard
    off = submap.PlanePoints(points.points_world, np.full_like(points.plane, -1), points.scan_offsets)
    assert len(submap.build(planes, off, poses, np.arange(6))) == 0


def test_a_patch_is_in_the_frame_of_its_scan(yard, patch):
    _, _, poses = yard
    assert np.linalg.norm(patch.center, axis=1).max() <= 20.0
    away = np.linalg.norm(patch.observer, axis=1)
    np.testing.assert_allclose(away.min(), 0.0, atol=1e-9)
    back = patch.moved(poses[2])
    ground = np.abs(back.normal[:, 2]) > 0.99
    assert np.median(np.abs(back.center[ground & (back.center[:, 2] < 0.2), 2])) < 0.02
    facing = np.einsum("ki,ki->k", patch.normal, patch.observer - patch.center)
    assert np.mean(facing > 0) > 0.98
    with pytest.raises(KeyError):
        submap.around(submap.build(*yard, np.arange(10, 16)), 3, 20.0)


def plain_first_hit(origins, ends, margin, centers, normals, radius, cosine):
    found = []
    for origin, end in zip(origins, ends):
        length = np.linalg.norm(end - origin)
        along = (end - origin) / length
        toward = normals @ along
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.einsum("ki,ki->k", normals, centers - origin) / toward
        off = np.linalg.norm(origin + t[:, None] * along - centers, axis=1)
        met = (toward <= -cosine) & (off <= radius) & (t >= margin) & (t < length - margin)
        found.append(np.argmin(np.where(met, t, np.inf)) if met.any() and length > 2 * margin else -1)
    return np.array(found)


def test_rays_meet_what_the_plain_twin_says():
    rng = np.random.default_rng(0)
    centers, cell = rng.uniform(-3, 3, (500, 3)), 0.5
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    low = centers.min(0)
    at = np.floor((centers - low) / cell).astype(np.int64)
    shape = at.max(0) + 1
    flat = np.ravel_multi_index(at.T, shape)
    order = np.argsort(flat, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(np.prod(shape))))])
    origins, ends = rng.uniform(-5, 5, (2, 400, 3))
    ends[0] = origins[0]
    centers, normals = centers[order], normals[order]
    hit = see_through.first_hit(origins, ends, 0.3, centers, normals, starts, low, shape, cell, 0.4, 0.3)
    with np.errstate(invalid="ignore"):
        plain = plain_first_hit(origins, ends, 0.3, centers, normals, 0.4, 0.3)
    np.testing.assert_array_equal(hit, plain)
    assert np.count_nonzero(hit >= 0) > 40


def test_derivatives_of_distances_are_those_of_differences(patch):
    target = Target.of(patch)
    pose = geometry.exp(np.array([0.01, -0.02, 0.015, 0.05, 0.03, -0.02]))
    found = surfel_icp.match(target, patch, pose, 0.5, 20.0)
    jacobian = surfel_icp.jacobians(target, patch, pose, found)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ends = []
        for sign in (1, -1):
            center = patch.moved(pose @ geometry.exp(sign * step)).center[found.source]
            normal = patch.normal[found.target]
            ends.append(np.einsum("mi,mi->m", normal, center - patch.center[found.target]))
        np.testing.assert_allclose(jacobian[:, axis], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_matches_face_the_same_way_and_are_the_nearest_that_do(patch):
    target = Target.of(patch)
    pose = geometry.exp(np.array([0.0, 0.0, 0.02, 0.1, 0.1, 0.0]))
    found = surfel_icp.match(target, patch, pose, 0.5, 20.0)
    moved = patch.moved(pose)
    alike = moved.normal[found.source] @ patch.normal.T > np.cos(np.radians(20.0))
    away = np.linalg.norm(moved.center[found.source, None] - patch.center[None], axis=2)
    chosen = away[np.arange(len(found.source)), found.target]
    nearest = np.where(alike, away, np.inf).min(1)
    assert np.all(alike[np.arange(len(found.source)), found.target])
    # only the few nearest are looked at
    assert np.mean(chosen <= nearest + 1e-12) > 0.98


def test_each_of_several_alignments_ends_where_it_does_alone(patch):
    begin = geometry.exp(np.random.default_rng(8).normal(0, 1, (5, 6)) * ([0.05] * 3 + [0.3] * 3))
    begin[3, :3, 3] += 1000.0  # nothing matches from there
    prior, stages = np.eye(6), surfel_icp.COARSE + surfel_icp.FINE
    target, still = Target.of(patch), np.eye(4)
    together = surfel_icp.align_each(target, patch, begin, stages, still, prior)
    alone = [surfel_icp.align(target, patch, pose, stages, still, prior) for pose in begin]
    np.testing.assert_allclose(together, alone, atol=1e-9)
    assert np.array_equal(together[3], begin[3])
    assert np.linalg.norm(geometry.log(together[:3]), axis=1).max() < 0.01


def test_the_search_finds_a_shift_of_meters_and_a_turn(patch):
    off = geometry.exp(np.array([0.03, -0.02, 0.06, 2.6, -1.8, 0.5]))
    starts = correlation.search(patch, patch.moved(geometry.inverse(off)), np.eye(4), 4.0, 6.0, 0.8, 20)
    errors = geometry.log(geometry.inverse(off) @ starts.a_from_b)
    close = (np.linalg.norm(errors[:, 3:], axis=1) < 1.0) & (np.linalg.norm(errors[:, :3], axis=1) < 0.07)
    assert close.any()
    assert np.all(np.diff(starts.score) <= 0)


def test_the_same_place_agrees_and_one_that_is_seen_through_does_not(patch):
    target = Target.of(patch)
    same = verification.evidence(target, target, np.eye(4), 0.1)
    assert same.agreeing == 1.0
    assert same.overlap == 1.0
    wall = Patch(
        np.stack([np.full(25, 2.0), *np.mgrid[-0.8:0.9:0.4, -0.8:0.9:0.4].reshape(2, -1)], -1),
        np.tile([-1.0, 0, 0], (25, 1)),
        np.zeros((25, 3)),
        np.full(25, 0.01),
        0.4,
    )
    behind = Patch(wall.center + np.array([3.0, 0, 0]), wall.normal, wall.observer, wall.thickness, 0.4)
    told = verification.evidence(Target.of(wall), Target.of(behind), np.eye(4), 0.1)
    assert told.agreeing == 0.0
    assert np.count_nonzero(told.against_b) > 10
    assert np.count_nonzero(told.against_a) == 0


def test_certainty_knows_the_number_of_surfels_and_open_directions():
    rng = np.random.default_rng(0)
    flat = np.stack([*rng.uniform(-5, 5, (2, 400)), np.zeros(400)], -1)
    ground = Patch(
        flat, np.tile([0.0, 0, 1], (400, 1)), flat + np.array([0, 0, 2.0]), np.full(400, 0.01), 0.4
    )
    lifted = Patch(
        flat + rng.normal(0, [0, 0, 0.01], (400, 3)), ground.normal, ground.observer, ground.thickness, 0.4
    )
    target = Target.of(ground)
    found = surfel_icp.match(target, lifted, np.eye(4), 0.5, 20.0)
    known = surfel_icp.certainty(target, lifted, np.eye(4), found, np.full(6, 1e-9), 0.05)
    assert len(known.open) == 3
    assert known.sigma == pytest.approx(0.01, rel=0.2)
    height = 1 / np.sqrt(known.information[5, 5])
    assert 0.8 * 0.01 / 20 < height < 3 * 0.01 / 20
    for motion in known.open:
        assert abs(motion @ known.information @ motion) < 1e-6 * known.information[5, 5]


def test_doubt_of_a_scan_grows_on_the_way_to_the_scans_that_saw_the_surfaces(yard):
    planes, points, poses = yard
    rng = np.random.default_rng(3)
    each = rng.normal(size=(6, 6, 6)) * 1e-3
    each = each @ np.swapaxes(each, 1, 2)
    built = submap.build(planes, points, poses, np.arange(10, 16), covariance=each)
    near = np.linalg.norm(built.center - poses[2, :3, 3], axis=1) <= 12.0
    plain = np.zeros((6, 6))
    for seen in built.observer[near]:
        for scan in range(min(2, seen), max(2, seen) + 1):
            carried = geometry.adjoint(geometry.inverse(poses[2]) @ poses[scan])
            plain += carried @ each[scan] @ carried.T / np.count_nonzero(near)
    np.testing.assert_allclose(submap.uncertainty(built, 12, 12.0), plain, rtol=1e-6, atol=1e-12)
