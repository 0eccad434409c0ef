"""Planes in cells that hold several surfaces: against a twin, on stairs, and on what is none."""

import naive_mixed_cells as naive
import numba
import numpy as np
import pytest

from lvba.kernels import mixed_cells as kernel
from lvba.lidar import bundle_adjustment, mixed_cells, rounds, voxel_map
from lvba.lidar.config import Stage
from lvba.lidar.plane_feature import fit
from lvba.lidar.scan import gather

NOISE = 0.02
TREAD, RISER, WIDTH, STEPS = 0.28, 0.17, 1.2, 8
STAGE = Stage(sizes=(0.25, 0.5, 1.0))
UP = np.array([0.0, 0.0, 1.0])


def steps(rng, count):
    """(count, 3): points of treads and risers of a flight that climbs along y, without noise, and their normals."""
    tread = rng.random(count) < TREAD / (TREAD + RISER)
    step, along = rng.integers(0, STEPS, count), rng.random(count)
    points = np.stack(
        [
            rng.uniform(-WIDTH / 2, WIDTH / 2, count),
            TREAD * (step + np.where(tread, along, 0.0)),
            RISER * (step + np.where(tread, 1.0, along)),
        ],
        axis=1,
    )
    return points, np.where(tread[:, None], UP, [0.0, 1.0, 0.0])


def flight(seed=0, scans=6, count=15_000):
    """Scans of a flight, climbed: points in each scan's frame, and poses (S, 4, 4)."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 1, 3] = np.linspace(-1.0, 0.4, scans)
    poses[:, 2, 3] = np.linspace(1.6, 2.4, scans)
    seen = []
    for pose in poses:
        points, normals = steps(rng, count)
        beams = points - pose[:3, 3]
        beams /= np.linalg.norm(beams, axis=1)[:, None]
        front = np.abs(np.sum(beams * normals, axis=1)) > 0.2
        seen.append(
            (points + NOISE * rng.normal(size=(count, 1)) * beams - pose[:3, 3])[front].astype(np.float32)
        )
    return seen, poses


def grid_of(scans, poses):
    points = gather(scans)
    grid = rounds.build_grid(points, poses, STAGE)
    return points, grid, voxel_map.find_planes(grid, poses, np.zeros(3), STAGE.plane_test)


def test_steps_are_planes_where_cells_hold_no_single_one():
    scans, poses = flight()
    points, grid, association = grid_of(scans, poses)
    found = mixed_cells.find(grid, association, points, poses, np.zeros(3), NOISE, STAGE.plane_test)
    fits = fit(found, poses)
    upright, level = np.abs(fits.normal[:, 1]) > 0.98, np.abs(fits.normal[:, 2]) > 0.98
    assert np.mean(upright | level) > 0.9
    assert level.sum() >= 2 * STEPS
    # a tread is at a multiple of the riser
    off = fits.center[level, 2] / RISER
    # as far as faces of cells, which cut noise off, take planes of whole cells along
    assert np.abs(off - np.round(off)).max() * RISER < 0.7 * NOISE
    assert np.sqrt(np.mean((off - np.round(off)) ** 2)) * RISER < 0.35 * NOISE
    before = fit(association.features, poses)
    steep = np.abs(before.normal[:, 2]) > 0.98
    assert found.clusters.count[np.isin(found.feature, np.flatnonzero(level))].sum() > 1.5 * np.sum(
        before.total[steep]
    )


def test_scans_of_stairs_are_put_together_in_height():
    """Walls do not tell of heights; steps do, where they count."""
    rng = np.random.default_rng(4)
    scans, poses = flight(4)
    for scan, pose in zip(scans, poses, strict=True):
        for x in (-WIDTH / 2, WIDTH / 2):
            wall = np.stack([np.full(4000, x), rng.uniform(-1, 3, 4000), rng.uniform(0, 3, 4000)], axis=1)
            wall[:, 0] += NOISE * rng.normal(size=4000)
            scan.resize((len(scan) + 4000, 3), refcheck=False)
            scan[-4000:] = wall - pose[:3, 3]
    rough = poses.copy()
    rough[1:, 2, 3] += rng.normal(0, 0.02, len(poses) - 1)
    errors = {}
    for mixed in (False, True):
        stage = Stage(sizes=STAGE.sizes, mixed_cells=mixed)
        refined = bundle_adjustment.refine(scans, rough, stages=(stage,)).world_from_scan
        errors[mixed] = np.std(refined[:, 2, 3] - poses[:, 2, 3])
    assert errors[True] < 0.003
    assert errors[True] < 0.5 * errors[False]


def test_where_other_planes_hold_all_scans_none_are_looked_for():
    """The same stairs over a floor and before a wall."""
    rng = np.random.default_rng(5)
    scans, poses = flight(5, count=3000)
    surfaces = [
        (np.array([2.5, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])),
        (np.array([0.0, 4.5, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])),
        (np.array([0.0, 0.0, -0.5]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])),
    ]
    held = []
    for scan, pose in zip(scans, poses, strict=True):
        parts = [scan]
        for corner, one, other in surfaces:
            at = rng.uniform(-2, 3, (4000, 2))
            points = corner + at[:, :1] * one + at[:, 1:] * other
            normal = np.cross(one, other)
            parts.append(
                (points + NOISE * rng.normal(size=(4000, 1)) * normal - pose[:3, 3]).astype(np.float32)
            )
        held.append(np.concatenate(parts))
    assert bundle_adjustment.refine(held, poses, stages=(STAGE,)).mixed is None
    alone = [scan[:3000] for scan in flight(5)[0]]
    assert bundle_adjustment.refine(alone, poses, stages=(STAGE,)).mixed is not None


@pytest.mark.parametrize("seed", range(3))
def test_clutter_has_no_planes(seed):
    rng = np.random.default_rng(seed)
    leaves = [rng.uniform(-1, 1, (20_000, 3)).astype(np.float32) for _ in range(3)]
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = -5.0
    scans = [(each - poses[0, :3, 3]).astype(np.float32) for each in leaves]
    points, grid, association = grid_of(scans, poses)
    found = mixed_cells.find(grid, association, points, poses, np.zeros(3), NOISE, STAGE.plane_test)
    assert found.clusters.count.sum() < 0.01 * len(points.points)


def test_each_side_of_a_thin_wall_is_a_plane_of_its_own():
    """What lies on a plane, but is seen from its other side, is no part of it."""
    rng = np.random.default_rng(1)
    scans, poses = flight(1)
    below = poses[:1].copy()
    below[:, 2, 3] = -2.0
    under = steps(rng, 15_000)[0] - [0.0, 0.0, 0.08]
    scans.append((under - below[0, :3, 3]).astype(np.float32))
    poses = np.concatenate([poses, below])
    points, grid, association = grid_of(scans, poses)
    found = mixed_cells.find(grid, association, points, poses, np.zeros(3), NOISE, STAGE.plane_test)
    level = np.abs(fit(found, poses).normal[:, 2]) > 0.98
    own = found.scan == len(scans) - 1
    with_others = level[found.feature] & own & np.isin(found.feature, found.feature[~own])
    assert found.clusters.count[with_others].sum() < 0.02 * found.clusters.count.sum()


def test_kernels_against_their_twin():
    scans, poses = flight(2, scans=4)
    points, grid, association = grid_of(scans, poses)
    near = mixed_cells._free_points(grid, association, points, STAGE.plane_test)
    test = kernel.MixedTest(sigma=NOISE, size=0.25, min_points=16, ratio=1 / 9, max_tilt=0.02)
    sensors = np.ascontiguousarray(poses[:, :3, 3])
    labels = kernel.label(near, points.points, poses, sensors, test)
    scan_of = np.repeat(np.arange(len(scans)), np.diff(points.offsets))
    compared = 0
    for cell in range(len(near.key)):
        own = slice(near.first[near.starts[cell]], near.first[near.starts[cell + 1]])
        index = near.order[own]
        if len(index) < 2 * test.min_points:
            assert (labels[own] == -1).all()
            continue
        world = points.points[index].astype(float) + poses[scan_of[index], :3, 3]
        expected = naive.label(world, sensors[scan_of[index]], test, near.key[cell])
        np.testing.assert_array_equal(labels[own], expected)
        compared += (expected >= 0).sum()
    assert compared > 3000
    made = kernel.observations(near, points.points, labels)
    key = np.repeat(np.arange(len(near.key)), np.diff(near.first[near.starts])) * kernel.MOST_PLANES + labels
    for plane, scan, count, mean, scatter in zip(*made, strict=True):
        own = points.points[
            near.order[(labels >= 0) & (key == plane) & (scan_of[near.order] == scan)]
        ].astype(float)
        assert len(own) == count
        np.testing.assert_allclose(own.mean(0), mean, atol=1e-9)
        rows, columns = np.triu_indices(3)
        spread = (own - own.mean(0)).T @ (own - own.mean(0))
        np.testing.assert_allclose(spread[rows, columns], scatter, atol=1e-8)
    assert made.number.sum() == (labels >= 0).sum()


def test_any_number_of_threads_gives_the_same_planes():
    scans, poses = flight(3)
    points, grid, association = grid_of(scans, poses)
    before, found = numba.get_num_threads(), []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            found.append(
                mixed_cells.find(grid, association, points, poses, np.zeros(3), NOISE, STAGE.plane_test)
            )
    finally:
        numba.set_num_threads(before)
    assert found[0].clusters.mean.tobytes() == found[1].clusters.mean.tobytes()
    assert found[0].offsets.tobytes() == found[1].offsets.tobytes()
