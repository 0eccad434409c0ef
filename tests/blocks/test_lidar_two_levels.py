"""Joint rounds at two levels: shares say the same of groups as of their scans, and rounds end at the same poses."""

from dataclasses import replace

import numpy as np
import plane_world
import pytest

from lvba import geometry
from lvba.blocks import lidar_block, lidar_joint
from lvba.kernels.lidar import TILE
from lvba.lidar.config import STAGES, LidarConfig
from lvba.lidar.odometry_factor import odometry_prior
from lvba.lidar.rounds import OBLIQUE
from lvba.optim import two_level
from lvba.trajectory import pose_error

CONFIG = LidarConfig(dense_points=0)
STAGE = STAGES[-1]
SENSOR = np.zeros(3)
SCANS, PARTS = 40, 3


@pytest.fixture(scope="module")
def world():
    """Scans of a courtyard, true and rough poses, and the cells of three shares."""
    scans, truth, rough = plane_world.recording("courtyard", scans=SCANS, points=3200, seed=3)
    return truth, rough, shares(scans, truth)


def odometry_of(rough):
    return odometry_prior(rough, CONFIG.prior_rotation, CONFIG.prior_translation)


def shares(scans, poses):
    owned = lidar_block.Regions(poses[:, :3, 3], np.arange(len(poses)) * PARTS // len(poses))
    return [
        lidar_block.collect(
            lambda numbers: [scans[n] for n in numbers],
            # the first share does not see some scans, and so begins within a group
            lidar_block.candidates(owned, part, 100.0)[5 if part == 0 else 0 :],
            poses,
            owned,
            part,
            size=STAGE.sizes[0],
            largest=STAGE.sizes[-1],
            grid_from_world=OBLIQUE,
        )
        for part in range(PARTS)
    ]


@pytest.mark.parametrize("tiles", [1, 2])
def test_shares_at_two_levels_say_what_all_pairs_of_scans_say(world, tiles):
    _, rough, cells = world
    rng = np.random.default_rng(0)
    flat = np.broadcast_to(np.eye(6), (SCANS, 6, 6)).copy()
    flat[[7, 30]] -= 0.5 * np.outer(axis := rng.normal(size=6), axis) / (axis @ axis)
    groups = two_level.groups_of(rough, tiles * TILE)
    for each in cells:
        whole = lidar_block.over_all(lidar_block.linearize(each, rough, SENSOR, STAGE), SCANS)
        both = lidar_block.over_all(
            lidar_block.linearize(each, rough, SENSOR, STAGE, groups.projected(flat)), SCANS
        )
        expected = two_level.split(whole.equations, groups)
        scale = np.abs(whole.equations.blocks).max()
        np.testing.assert_allclose(both.equations.dense(), expected.inner.dense(), atol=1e-9 * scale)
        np.testing.assert_allclose(both.equations.gradient, whole.equations.gradient)
        assert both.equations.cost == whole.equations.cost
        carried = two_level.split(whole.equations.projected(flat), groups).bodies
        np.testing.assert_allclose(both.bodies.dense(), carried.dense(), atol=1e-9 * scale)


def rounds(cells, state, count):
    for _ in range(count):
        found = lidar_block.summed(
            lidar_block.linearize(each, state.world_from_scan, SENSOR, STAGE, state.groups) for each in cells
        )
        state = lidar_joint.step(state, found, len(STAGES) - 1, STAGE, CONFIG)
    return state, found


def test_rounds_at_two_levels_end_where_all_pairs_of_scans_do(world):
    truth, rough, cells = world
    rng = np.random.default_rng(1)
    start = geometry.retract(truth, rng.normal(size=(SCANS, 6)) * np.repeat([5e-4, 3e-3], 3))
    state = lidar_joint.begin(odometry_of(rough), start)
    whole, found = rounds(cells, state, 5)
    grouped, summed = rounds(cells, replace(state, group_size=TILE), 5)
    assert summed.bodies is not None
    assert np.array_equal(grouped.world_from_scan[0], start[0])
    before = pose_error(start, whole.world_from_scan)
    after = pose_error(grouped.world_from_scan, whole.world_from_scan)
    assert after.ate_max_m < 5e-4 < 3e-3 < before.ate_max_m
    assert after.rotation_max_deg < 0.005
    certain, of_all = (
        lidar_joint.covariance(each, blocks, CONFIG, 1.5)
        for each, blocks in ((grouped, summed), (whole, found))
    )
    deviation, expected = (
        np.sqrt(np.diagonal(each.marginal, axis1=1, axis2=2)) for each in (certain, of_all)
    )
    np.testing.assert_allclose(deviation, expected, rtol=0.1)


def test_a_step_at_two_levels_is_not_the_whole_way(world):
    """With all pairs the first small step is the last one; at two levels the next one tells what was left."""
    truth, rough, cells = world
    rng = np.random.default_rng(1)
    start = geometry.retract(truth, rng.normal(size=(SCANS, 6)) * np.repeat([5e-4, 3e-3], 3))
    state = lidar_joint.begin(odometry_of(rough), start)
    whole, grouped = (rounds(cells, replace(state, group_size=size), 8)[0] for size in (0, TILE))
    for each, needed in ((whole, 1), (grouped, 2)):
        small = [entry.small for entry in each.history]
        assert each.converged_stage == len(STAGES) - 1
        assert small == [False] * (len(small) - needed) + [True] * needed


def test_what_planes_leave_open_stays_at_the_odometry_at_two_levels():
    """Along a wall on flat ground nothing tells how far one went."""
    world = plane_world.World()
    world.rectangle([-30, -30, 0], [60, 0, 0], [0, 60, 0])
    world.rectangle([-30, 4, 0], [60, 0, 0], [0, 0, 6])
    truth = np.tile(np.eye(4), (2 * TILE, 1, 1))
    truth[:, :3, 3] = np.column_stack(
        [np.linspace(-3, 3, 2 * TILE), np.zeros(2 * TILE), np.full(2 * TILE, 1.5)]
    )
    scans = plane_world.scan_all(world, truth, 3200, 0.02, "spinning", 0)
    rng = np.random.default_rng(2)
    start = geometry.retract(truth, rng.normal(size=(2 * TILE, 6)) * np.repeat([3e-4, 2e-3], 3))
    cells = shares(scans, truth)
    state = replace(lidar_joint.begin(odometry_of(start), start), group_size=TILE)
    first, _ = rounds(cells, state, 1)
    assert first.projector is not None
    assert np.array_equal(first.world_from_scan, start)
    last, _ = rounds(cells, first, 4)
    assert last.history[-1].degenerate_scans == 2 * TILE
    moved = last.world_from_scan[:, :3, 3] - start[:, :3, 3]
    assert np.abs(moved[:, 0]).max() < 1e-3 < np.abs(moved[:, 1]).max()


def test_scans_are_grouped_where_too_many_see_each_other(monkeypatch):
    street = np.tile(np.eye(4), (400, 1, 1))
    street[:, 0, 3] = 2.0 * np.arange(400)
    monkeypatch.setattr(lidar_joint, "MOST_PAIRS", 20_000)
    assert lidar_joint.group_size(street, 30.0) == 0
    monkeypatch.setattr(lidar_joint, "MOST_PAIRS", 2_000)
    assert lidar_joint.group_size(street, 30.0) == 0  # more pairs, but few of all
    assert lidar_joint.group_size(street, 500.0) == TILE
    monkeypatch.setattr(lidar_joint, "MOST_GROUPS", 20)
    assert lidar_joint.group_size(street, 500.0) == 2 * TILE
    assert lidar_joint.begin(odometry_of(street), street).groups is None
    assert lidar_joint.begin(odometry_of(street), street, 500.0).groups.count == 17
