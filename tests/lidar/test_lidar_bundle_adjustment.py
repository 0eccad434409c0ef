"""The whole of it on small worlds with known truth."""

from dataclasses import replace

import numba
import numpy as np
import plane_world
import pytest

from lvba import geometry, trajectory
from lvba.errors import DegenerateProblemError
from lvba.lidar import voxel_map
from lvba.lidar.bundle_adjustment import LidarConfig, find_planes, refine
from lvba.lidar.config import STAGES, Stage
from lvba.lidar.plane_feature import fit
from lvba.lidar.scan import gather
from lvba.lidar.voxel_map import PlaneTest


@pytest.fixture(scope="module")
def yard():
    scans, truth, rough = plane_world.recording("courtyard", scans=24, points=6400, seed=3)
    return scans, truth, rough, refine(scans, rough)


def errors(result, truth):
    """(S, 6) local tangent errors after alignment."""
    poses = trajectory.align(result.world_from_scan, truth) @ result.world_from_scan
    return geometry.log(geometry.inverse(truth) @ poses)


def test_open_scene_ends_near_the_truth(yard):
    _, truth, rough, result = yard
    before, after = (trajectory.pose_error(p, truth) for p in (rough, result.world_from_scan))
    assert before.ate_m > 0.05
    assert after.ate_m < 0.002
    assert after.rotation_deg < 0.01
    assert result.converged
    assert result.cost_final < 0.5 * result.cost_initial
    assert result.iterations == sum(entry.steps for entry in result.history)


def test_first_pose_and_world_frame_stay(yard):
    _, _, rough, result = yard
    np.testing.assert_array_equal(result.world_from_scan[0], rough[0])
    rotation = result.world_from_scan[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
    )


def test_covariance_is_honest(yard):
    _, truth, _, result = yard
    error = errors(result, truth)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariance), error) / 6
    assert 0.3 < squared.mean() < 3.0


def test_nothing_is_weak_in_an_open_scene(yard):
    result = yard[3]
    assert result.degenerate_directions == ()
    assert not result.degenerate_scans.any()
    assert result.warnings == ()


def test_planes_lie_on_the_world(yard):
    _, truth, _, result = yard
    planes, points = result.planes, result.plane_points
    assert len(planes) > 50
    assert np.mean(points.plane >= 0) > 0.6
    assert points.plane.max() < len(planes)
    on = points.plane >= 0
    away = np.einsum(
        "ij,ij->i", points.points_world[on] - planes.center[points.plane[on]], planes.normal[points.plane[on]]
    )
    assert np.abs(away).max() < 0.25
    assert np.sqrt(np.mean(away**2)) < 0.03
    np.testing.assert_allclose(np.linalg.det(planes.axes), 1.0, atol=1e-9)
    np.testing.assert_allclose(planes.axes[:, :, 0], planes.normal, atol=1e-12)
    # the ground, the largest plane, is seen from above and known to a fraction of a millimeter
    ground = (planes.size >= 2) & (np.abs(planes.normal[:, 2]) > 0.999)
    assert ground.any()
    assert (planes.normal[ground, 2] > 0).all()
    to_truth = trajectory.align(result.world_from_scan, truth)
    height = geometry.transform_points(to_truth, planes.center[ground])[:, 2]
    assert np.median(np.abs(height)) < 0.001
    assert np.abs(height).max() < 0.02


def test_the_order_of_points_does_not_matter(yard):
    scans, _, rough, _ = yard
    rng = np.random.default_rng(0)
    stages = (Stage(rounds=2),)
    one = refine(scans[:8], rough[:8], stages=stages)
    other = refine([scan[rng.permutation(len(scan))] for scan in scans[:8]], rough[:8], stages=stages)
    np.testing.assert_allclose(other.world_from_scan, one.world_from_scan, atol=1e-7)


def test_the_place_of_the_world_matters_no_more_than_noise(yard):
    scans, _, rough, result = yard
    motion = geometry.exp(np.array([0.0, 0.0, 0.7, 640.0, -320.0, 64.0]))
    moved = refine(scans, motion @ rough)
    difference = trajectory.pose_error(moved.world_from_scan, motion @ result.world_from_scan)
    noise = np.sqrt(np.mean(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2)))
    assert difference.ate_m < 2.0 * noise


def test_the_order_of_scans_does_not_matter_to_the_planes(yard):
    scans, _, _, result = yard
    order = np.random.default_rng(1).permutation(len(scans))
    planes, _ = find_planes([scans[i] for i in order], result.world_from_scan[order])
    assert len(planes) == len(result.planes)
    np.testing.assert_allclose(planes.center, result.planes.center, atol=1e-6)


def test_same_bytes_for_one_and_two_threads(yard):
    scans, _, rough, _ = yard
    stages = (Stage(rounds=1),)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        single = refine(scans[:8], rough[:8], stages=stages)
        numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
        double = refine(scans[:8], rough[:8], stages=stages)
    finally:
        numba.set_num_threads(before)
    assert double.world_from_scan.tobytes() == single.world_from_scan.tobytes()
    assert double.covariance.tobytes() == single.covariance.tobytes()
    assert double.plane_points.plane.tobytes() == single.plane_points.plane.tobytes()


def test_rooms_with_thin_walls():
    scans, truth, rough = plane_world.recording("rooms", scans=60, points=8000, seed=2)
    after = trajectory.pose_error(refine(scans, rough).world_from_scan, truth)
    assert after.ate_m < 0.004
    assert after.rotation_deg < 0.05


def wall_from_both_sides(thickness=0.06):
    world = plane_world.World()
    for sign in (-1, 1):
        world.rectangle([sign * thickness / 2, 0, 0], [0, 3, 0], [0, 0, 3])
    poses = np.stack([plane_world.look([x, y, 0.1 * y], 0.0) for x in (-2.5, 2.5) for y in (-0.5, 0.0, 0.5)])
    return plane_world.scan_all(world, poses, 6400, 0.01, "spinning", 0), poses


@pytest.mark.parametrize(("test", "faces"), [(PlaneTest(), 2), (PlaneTest(two_sided=False), 1)])
def test_faces_of_a_thin_wall_are_two_planes(test, faces):
    scans, poses = wall_from_both_sides()
    points = gather(scans)
    grid = voxel_map.build(points, poses, (0.5, 1.0))
    features = voxel_map.find_planes(grid, poses, np.zeros(3), test).features
    assert len(features) > 0
    mixed = 0
    for f in range(len(features)):
        seen = features.scan[features.offsets[f] : features.offsets[f + 1]]
        mixed += len(np.unique(seen < 3)) == 2
    assert (mixed == 0) == (faces == 2)


def test_a_coarse_plane_that_finer_ones_contradict_is_refused():
    world = plane_world.World()
    world.rectangle([0, 0, 0], [8, 0, 0], [0, 8, 0])
    world.rectangle([5.35, 0, 0.06], [2.35, 0, 0], [0, 8, 0])
    poses = np.stack([plane_world.look([0.1 * k, 0.2, 1.5], 0.4 * k) for k in range(5)])
    points = gather(plane_world.scan_all(world, poses, 16000, 0.01, "spinning", 1))
    grid = voxel_map.build(points, poses, (0.5, 1.0, 2.0, 4.0))
    strict = voxel_map.find_planes(grid, poses, np.zeros(3), PlaneTest()).features
    loose = voxel_map.find_planes(grid, poses, np.zeros(3), PlaneTest(max_residual_growth=np.inf)).features
    # the finest cells have no finer ones to contradict them
    strict, loose = (features.select(features.size >= 2.0) for features in (strict, loose))
    thickness = [np.sqrt(fit(features, poses).eigenvalues[:, 0].max()) for features in (strict, loose)]
    assert thickness[0] < 0.6 * thickness[1]
    assert strict.size.max() == 4.0


def bare(kind):
    world = plane_world.World()
    world.rectangle([0, 0, 0], [60, 0, 0], [0, 60, 0])
    if kind == "corridor":
        world.rectangle([0, 0, 3], [60, 0, 0], [0, 60, 0])
        for side in (-1.5, 1.5):
            world.rectangle([0, side, 1.5], [60, 0, 0], [0, 0, 1.5])
    truth = np.stack([plane_world.look([0.3 * k, 0.0, 1.5], 0.05 * k) for k in range(16)])
    scans = plane_world.scan_all(world, truth, 6400, 0.02, "spinning", 7)
    return scans, truth, plane_world.drift(truth, 4, translation=0.05)


@pytest.mark.parametrize(("kind", "weak"), [("plane", 3), ("corridor", 1)])
def test_what_planes_leave_open_is_reported_and_stays_at_the_odometry(kind, weak):
    scans, truth, rough = bare(kind)
    result = refine(scans, rough)
    assert (result.degenerate_scans == weak).all()
    assert len(result.degenerate_directions) == weak
    assert any("open" in warning for warning in result.warnings)
    # along the corridor, or in the plane, each step is that of the odometry
    along = np.diff(result.world_from_scan[:, 0, 3]) - np.diff(rough[:, 0, 3])
    assert np.abs(along).max() < 0.003
    # what the planes do determine, gets better
    height = [
        np.std((trajectory.align(p, truth) @ p)[:, 2, 3] - truth[:, 2, 3])
        for p in (rough, result.world_from_scan)
    ]
    assert height[1] < 0.2 * height[0]
    if kind == "plane":
        directions = np.stack([d.direction for d in result.degenerate_directions])
        assert np.linalg.norm(directions[:, [0, 1, 5]]) < 0.1


def test_a_scan_before_one_wall_may_slide_along_it_whatever_the_others_do():
    scans, _, rough = bare("plane")
    result = refine(scans, rough)
    spread = np.sqrt(np.linalg.eigvalsh(result.conditional_covariance[1:-1, 3:, 3:]))
    assert (spread[:, 0] < 0.002).all()
    assert (spread[:, 1:] > 0.005).all()


def test_empty_scans_and_scans_of_nothing_but_nan_move_with_the_odometry(yard):
    scans, truth, rough, _ = yard
    broken = list(scans[:12])
    broken[4] = np.zeros((0, 3), np.float32)
    broken[7] = np.full((50, 3), np.nan, np.float32)
    result = refine(broken, rough[:12])
    assert "2 of 12 scans see no plane" in " ".join(result.warnings)
    assert np.isfinite(result.world_from_scan).all()
    good = [k for k in range(12) if k not in (4, 7)]
    assert trajectory.pose_error(result.world_from_scan[good], truth[good]).ate_m < 0.004
    off = (
        geometry.inverse(truth)[:12]
        @ trajectory.align(result.world_from_scan[good], truth[good])
        @ result.world_from_scan
    )
    assert np.linalg.norm(off[[4, 7], :3, 3], axis=1).max() < 0.1


@pytest.mark.parametrize(
    "scans",
    [
        [np.zeros((0, 3), np.float32)] * 3,
        [np.full((9, 3), np.nan, np.float32)] * 3,
        [np.random.default_rng(k).uniform(-9, 9, size=(300, 3)).astype(np.float32) for k in range(3)],
    ],
)
def test_nothing_to_solve_is_one_clear_error(scans):
    with pytest.raises(DegenerateProblemError, match="no plane"):
        refine(scans, np.stack([np.eye(4)] * 3))


def test_a_stage_whose_cells_hold_no_plane_is_passed_over(yard):
    scans, truth, rough, _ = yard
    bare = Stage(sizes=(16.0,), plane_test=PlaneTest(min_scans=1000))
    with pytest.raises(DegenerateProblemError):
        refine(scans, rough, stages=(bare,))
    result = refine(scans, rough, stages=(bare, *STAGES))
    assert trajectory.pose_error(result.world_from_scan, truth).ate_m < 0.002


def test_progress_can_cancel(yard):
    scans, _, rough, _ = yard

    def stop(what, done, total):
        assert 0 <= done <= total
        if done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine(scans[:6], rough[:6], progress=stop)


@pytest.mark.parametrize(
    "change",
    [{"prior_translation": 0.0}, {"prior_rotation": 5.0}, {"dense_points": 3}],
)
def test_settings_out_of_range(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        LidarConfig(**change)


def test_sizes_must_double():
    with pytest.raises(ValueError, match="twice"):
        Stage(sizes=(0.5, 1.0, 3.0))


def test_points_stay_in_their_cells_while_they_hardly_move(yard):
    scans, _, rough, _ = yard
    scans, rough = scans[:6], rough[:6]
    grid = voxel_map.build(gather(scans), rough, (0.25, 0.5, 1.0))
    assert grid.shift(rough) == pytest.approx(0.0, abs=1e-9)
    step = np.zeros((6, 6))
    step[2, 5], step[4, 2] = 0.003, 1e-3
    moved = geometry.retract(rough, step)
    away = [
        np.sqrt(np.mean((geometry.transform_points(a, scan) - geometry.transform_points(b, scan)) ** 2) * 3)
        for a, b, scan in zip(rough, moved, scans, strict=True)
    ]
    assert max(away) < grid.shift(moved) < 2.0 * max(away)
    # planes found at the new poses in the old cells are those of new cells, but for points that crossed a face
    sensor, test = np.zeros(3), PlaneTest()
    kept = voxel_map.find_planes(grid, moved, sensor, test).features
    grid = voxel_map.build(gather(scans), moved, (0.25, 0.5, 1.0))
    anew = voxel_map.find_planes(grid, moved, sensor, test).features
    assert len(kept) == pytest.approx(len(anew), rel=0.05)
    assert fit(kept, moved).cost == pytest.approx(fit(anew, moved).cost, rel=0.05)


def test_rounds_end_when_poses_move_by_much_less_than_their_uncertainty(yard):
    scans, _, rough, _ = yard
    *first, last = STAGES
    stopped, forever = (
        refine(scans, rough, stages=(*first, replace(last, pose_tolerance=0.0, **more)))
        for more in ({}, {"cost_tolerance": 0.0})
    )
    assert stopped.converged
    assert not forever.converged
    assert len(stopped.history) < len(forever.history)
    difference = trajectory.pose_error(stopped.world_from_scan, forever.world_from_scan)
    sigma = np.sqrt(np.trace(stopped.covariance[:, 3:, 3:], axis1=1, axis2=2).mean())
    assert difference.ate_m < 0.3 * sigma
