"""Blocks of one LiDAR bundle adjustment: together they are the whole problem, and one solve moves all scans."""

from dataclasses import replace

import numpy as np
import plane_world
import pytest

from lvba import geometry
from lvba.blocks import lidar_block, lidar_joint
from lvba.blocks.merge import PartPoses
from lvba.blocks.split import Part
from lvba.errors import InputError
from lvba.kernels import voxel as kernel
from lvba.lidar import bundle_adjustment, plane_factor, voxel_map
from lvba.lidar.config import STAGES, LidarConfig
from lvba.lidar.odometry_factor import odometry_prior
from lvba.lidar.rounds import OBLIQUE
from lvba.lidar.scan import gather
from lvba.optim import normal_equations
from lvba.steps import joint_scans
from lvba.steps.joint_scans import PartScans
from lvba.trajectory import pose_error

CONFIG = LidarConfig(dense_points=0)
STAGE = STAGES[-1]
PLAIN = replace(STAGE, weight_passes=0)
SENSOR = np.zeros(3)


@pytest.fixture(scope="module")
def world():
    return plane_world.recording("courtyard", scans=24, points=6400, seed=3)


def regions(poses, parts):
    return lidar_block.Regions(poses[:, :3, 3], np.arange(len(poses)) * parts // len(poses))


def blocks_of(scans, poses, parts, mixed=None):
    owned = regions(poses, parts)
    return [
        lidar_block.collect(
            lambda numbers: [scans[n] for n in numbers],
            lidar_block.candidates(owned, part, 100.0),
            poses,
            owned,
            part,
            size=STAGE.sizes[0],
            largest=STAGE.sizes[-1],
            grid_from_world=OBLIQUE,
            mixed=mixed,
        )
        for part in range(parts)
    ]


def test_a_morton_code_gives_its_cell_back():
    cells = np.random.default_rng(0).integers(0, kernel.AXIS_CELLS, (500, 3))
    keys = np.array([kernel.morton(*cell) for cell in cells])
    assert np.array_equal(kernel.cell_of(keys), cells)


def test_every_point_is_in_one_share(world):
    scans, _, rough = world
    found = blocks_of(scans, rough, 3)
    whole = blocks_of(scans, rough, 1)[0]
    assert sum(each.clusters.count.sum() for each in found) == whole.clusters.count.sum()
    assert whole.clusters.count.sum() == sum(len(scan) for scan in scans)
    assert min(len(each.key) for each in found) > 0


def test_scans_further_apart_than_the_grid_reaches_are_an_error(world):
    scans, _, rough = world
    far = rough.copy()
    far[-1, :3, 3] += 30_000.0
    with pytest.raises(InputError, match="split the recording"):
        blocks_of(scans, far, 1)


@pytest.mark.parametrize("parts", [1, 3])
def test_the_equations_of_all_shares_add_up_to_those_of_the_whole(world, parts):
    scans, _, rough = world
    found = [lidar_block.linearize(each, rough, SENSOR, PLAIN) for each in blocks_of(scans, rough, parts)]
    # every share has its own noise: compare the sums of squares, which do not depend on it
    grid = voxel_map.build(gather(scans), rough, STAGE.sizes, OBLIQUE)
    features = voxel_map.find_planes(grid, rough, SENSOR, STAGE.plane_test).features
    whole = plane_factor.linearize(features, rough, 1.0, exact=False)
    scaled = [
        lidar_block.BlockEquations(
            each.scans,
            each.equations.scaled(each.sigma**2),
            each.information,
            each.noise_information,
            0,
            0,
            each.points,
            1.0,
        )
        for each in found
    ]
    together = lidar_block.over_all(lidar_block.summed(scaled), len(scans)).equations
    assert sum(each.planes for each in found) == len(features)
    assert sum(each.observations for each in found) == len(features.scan)
    assert together.cost == pytest.approx(whole.cost, rel=1e-12)
    np.testing.assert_allclose(together.gradient, whole.gradient, atol=1e-9 * np.abs(whole.gradient).max())
    dense = whole.dense()
    np.testing.assert_allclose(together.dense(), dense, atol=1e-9 * np.abs(dense).max())


@pytest.fixture(scope="module")
def mixed(world):
    """Planes of another grid in the place of those that points tell of."""
    scans, _, rough = world
    grid = voxel_map.build(gather(scans), rough, (2.0,), OBLIQUE)
    return voxel_map.find_planes(grid, rough, SENSOR, STAGE.plane_test).features


def test_planes_in_cells_of_several_surfaces_count_beside_those_of_cells(world, mixed):
    scans, _, rough = world
    assert len(mixed) > 50
    [without], [with_them] = blocks_of(scans, rough, 1), blocks_of(scans, rough, 1, mixed)
    before = lidar_block.linearize(without, rough, SENSOR, PLAIN)
    after = lidar_block.linearize(with_them, rough, SENSOR, PLAIN)
    assert after.planes == before.planes + len(mixed)
    own = plane_factor.linearize(mixed, rough, 1.0, exact=False)
    together = before.equations.scaled(before.sigma**2) + own
    found = after.equations.scaled(after.sigma**2)
    assert found.cost == pytest.approx(together.cost, rel=1e-12)
    np.testing.assert_allclose(found.dense(), together.dense(), atol=1e-9 * np.abs(together.dense()).max())


def test_parts_bring_the_planes_of_scans_in_their_cores(world, mixed):
    """Of two parts that overlap, each scan's observations come from the one whose core it is in."""
    scans, _, rough = world
    count = len(scans)
    parts = []
    for number, (first, end) in enumerate(((0, 14), (10, count))):
        inside = (mixed.scan >= first) & (mixed.scan < end)
        own = mixed.observations_where(inside)
        numbers = np.arange(first, end)
        parts.append(
            PartScans(
                poses=PartPoses(numbers, rough[first:end], np.zeros((end - first - 1, 6, 6))),
                surfaces=None,
                variance_factor=1.0,
                history=(),
                converged=True,
                warnings=(),
                mixed=replace(own, scan=own.scan - first),
            )
        )
        parts[number] = (
            parts[number],
            Part(number, (first, end), ((0, 12), (12, count))[number], (0, 0), (0, 0)),
        )
    for part, core in parts:
        found = joint_scans._mixed_of(core, [lambda part=part: part])
        low, high = core.core_scans
        expected = mixed.observations_where((mixed.scan >= low) & (mixed.scan < high))
        expected = expected.select(np.diff(expected.offsets) > 1)
        np.testing.assert_array_equal(found.scan, expected.scan)
        np.testing.assert_array_equal(found.offsets, expected.offsets)
        np.testing.assert_array_equal(found.clusters.mean, expected.clusters.mean)


@pytest.mark.parametrize("parts", [1, 2, 5, 8])
def test_shares_are_added_up_one_after_another_to_what_they_are_together(world, parts):
    scans, _, rough = world
    found = [lidar_block.linearize(each, rough, SENSOR, PLAIN) for each in blocks_of(scans, rough, parts)]
    asked = []
    at_once = lidar_block.summed(asked.append(number) or each for number, each in enumerate(found))
    assert asked == list(range(parts))
    count = len(scans)
    together = normal_equations.scattered([(each.scans, each.equations) for each in found], count)
    whole = lidar_block.over_all(at_once, count)
    dense = together.dense()
    np.testing.assert_allclose(whole.equations.dense(), dense, atol=1e-14 * np.abs(dense).max())
    assert whole.equations.cost == pytest.approx(together.cost, rel=1e-12)
    information = np.zeros((count, 6, 6))
    for each in found:
        information[each.scans] += each.information
    np.testing.assert_allclose(whole.information, information, rtol=1e-12, atol=1e-9)
    assert whole.planes == sum(each.planes for each in found)
    points = sum(each.points for each in found)
    assert whole.points == pytest.approx(points)
    assert whole.sigma == pytest.approx(sum(each.sigma * each.points for each in found) / points)


def test_no_shares_are_no_sum():
    assert lidar_block.summed([]) is None


def rounds(scans, rough, start, parts, stages):
    """stages: (number of the stage, rounds) in turn, points put into cells anew for each."""
    state = lidar_joint.begin(odometry_prior(rough, CONFIG.prior_rotation, CONFIG.prior_translation), start)
    for number, count in stages:
        cells = blocks_of(scans, state.world_from_scan, parts)
        stage = STAGES[number]
        for _ in range(count):
            found = lidar_block.summed(
                lidar_block.linearize(each, state.world_from_scan, SENSOR, stage) for each in cells
            )
            state = lidar_joint.step(state, found, number, stage, CONFIG)
    return state, found


def test_joint_rounds_end_where_the_undivided_problem_does(world):
    scans, truth, rough = world
    whole = bundle_adjustment.refine(scans, rough, config=CONFIG).world_from_scan
    # parts that do not fit: a step of 1 cm and 0.1 degrees half way
    start = whole.copy()
    start[12:] = geometry.exp(np.array([0, 0, 0.002, 0.01, -0.005, 0.0])) @ start[12:]
    state, _ = rounds(scans, rough, start, 3, ((1, 3), (2, 4)))
    before, after = pose_error(start, whole), pose_error(state.world_from_scan, whole)
    assert after.ate_max_m < 0.001 < 0.01 < before.ate_max_m
    assert after.rotation_max_deg < 0.01
    assert np.array_equal(state.world_from_scan[0], start[0])
    assert pose_error(state.world_from_scan, truth).ate_m < 1.1 * pose_error(whole, truth).ate_m


def test_a_settled_state_comes_back_as_it_is(world):
    scans, _, rough = world
    state, found = rounds(scans, rough, rough, 2, ((2, 1),))
    state = replace(state, converged_stage=2)
    assert lidar_joint.step(state, found, 2, STAGE, CONFIG) is state


def test_a_step_longer_than_the_one_before_is_refused_and_damped(world):
    scans, _, rough = world
    state, found = rounds(scans, rough, rough, 2, ((2, 1),))
    shorter = replace(state.history[-1], moved=1e-6)
    again = lidar_joint.step(replace(state, history=(shorter,)), found, 2, STAGE, CONFIG)
    assert again.history[-1].refused
    assert np.array_equal(again.world_from_scan, state.world_from_scan)
    assert again.damping > state.damping


def test_covariances_are_those_of_the_dense_inverse(world):
    scans, _, rough = world
    state, found = rounds(scans, rough, rough, 3, ((2, 4),))
    sparse = lidar_joint.covariance(state, found, CONFIG, 1.5)
    equations, _ = lidar_joint.assemble(state, found, CONFIG)
    count = len(scans)
    dense = np.zeros((6 * count, 6 * count))
    dense[6:, 6:] = 1.5 * np.linalg.inv(equations.dense()[6:, 6:])
    motion, pick = lidar_joint.alignment(state.world_from_scan)
    free = np.eye(6 * count) - motion @ np.linalg.solve(pick.T @ motion, pick.T)
    here = np.arange(count)
    blocks = (free @ dense @ free.T).reshape(count, 6, count, 6)[here, :, here]
    np.testing.assert_allclose(sparse.marginal, blocks, atol=1e-6 * np.abs(blocks).max())
