"""Scans and cameras on one path: what the one does not know it takes from the other, and not more."""

from dataclasses import replace

import numpy as np
import pytest
from fusion_cases import (
    IMAGE_TIMES,
    MOUNT,
    OFFSET,
    SCAN_TIMES,
    TIGHT,
    blocks,
    cameras,
    errors,
    lifted,
    path,
    scans,
)

from lvba import geometry, spline
from lvba.lidar.covariance import Covariance
from lvba.steps import pose_fusion
from lvba.trajectory import Trajectory


def test_loose_scans_go_where_the_cameras_have_them():
    rng = np.random.default_rng(0)
    loose = np.arange(10, 50, 6)
    given, covariance, truth = scans(rng, loose)
    found = pose_fusion.fuse(given, covariance, cameras(rng))
    assert errors(given.world_from_sensor, truth)[loose].min() > 0.029
    assert errors(found.world_from_scan, truth)[loose].max() < 0.003
    others = np.setdiff1d(np.arange(len(SCAN_TIMES)), loose)
    before, after = (
        errors(poses, truth)[others] for poses in (given.world_from_sensor, found.world_from_scan)
    )
    assert np.sqrt((after**2).mean()) < np.sqrt((before**2).mean())
    assert found.contradicted == 0
    assert found.moved_m[loose].min() > 0.025


def test_a_group_that_is_off_together_goes_where_its_cameras_have_it():
    """Each of its scans would be well held if the others were known; within the trajectory all of them are vague."""
    rng = np.random.default_rng(9)
    given, covariance, truth = scans(rng)
    group = slice(26, 33)
    poses = given.world_from_sensor.copy()
    poses[group, 2, 3] += 0.02
    marginal = covariance.marginal.copy()
    marginal[group] += np.diag([0, 0, 0, 0, 0, 0.02**2])
    given = replace(given, world_from_sensor=poses)
    found = pose_fusion.fuse(given, Covariance(marginal, covariance.conditional, marginal), cameras(rng))
    assert errors(found.world_from_scan, truth)[group].max() < 0.003 < errors(poses, truth)[group].min()
    # what grows slowly along a path is no group: relative to the map around them these scans are as certain as ever
    drifting = covariance.conditional * np.linspace(1, 8, len(SCAN_TIMES))[:, None, None]
    usual = pose_fusion.fuse(given, covariance, cameras(np.random.default_rng(1)))
    slow = pose_fusion.fuse(
        given, Covariance(drifting, covariance.conditional, drifting), cameras(np.random.default_rng(1))
    )
    np.testing.assert_allclose(slow.world_from_scan, usual.world_from_scan, atol=1e-6)


def test_a_group_moves_as_one():
    """What the motion within it is known by keeps its scans together, though each camera has noise of its own."""
    scatter = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        given, covariance, truth = scans(rng)
        group = np.arange(26, 33)
        poses = given.world_from_sensor.copy()
        poses[group, 2, 3] += 0.02
        marginal = covariance.marginal.copy()
        marginal[group] += np.diag([0, 0, 0, 0, 0, 0.02**2])
        step = covariance.conditional[1:] + covariance.conditional[:-1]
        step[[25, 32]] += np.diag([0, 0, 0, 0, 0, 0.02**2])
        vague = cameras(rng, np.repeat([2e-3, 5e-3], 3))
        given = replace(given, world_from_sensor=poses)
        found = [
            pose_fusion.fuse(given, Covariance(marginal, covariance.conditional, marginal, steps), vague)
            for steps in (np.zeros((0, 6, 6)), step)
        ]
        scatter.append([(each.world_from_scan - truth)[group, 2, 3].std() for each in found])
        assert np.abs((found[1].world_from_scan - truth)[group, 2, 3]).max() < 0.01
    apart, together = np.mean(scatter, axis=0)
    assert together < 0.8 * apart


def test_the_covariance_is_honest():
    nees = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        given, covariance, truth = scans(rng, range(5, 55, 4))
        found = pose_fusion.fuse(given, covariance, cameras(rng))
        wrong = geometry.log(geometry.inverse(found.world_from_scan) @ truth)
        whitened = np.linalg.solve(found.covariance, wrong[..., None])[..., 0]
        nees.append((wrong * whitened).sum(1).mean() / 6)
    assert 0.5 < np.mean(nees) < 1.5


def test_vague_cameras_change_nothing():
    rng = np.random.default_rng(1)
    given, covariance, _ = scans(rng)
    found = pose_fusion.fuse(given, covariance, cameras(rng, np.repeat([0.02, 0.05], 3)))
    assert found.moved_m.max() < 1e-4


def test_scans_before_the_first_and_after_the_last_image_stay():
    rng = np.random.default_rng(2)
    given, covariance, _ = scans(rng, loose=(0, 1, 59))
    found = pose_fusion.fuse(given, covariance, cameras(rng))
    assert (found.world_from_scan[[0, 1, 59]] == given.world_from_sensor[[0, 1, 59]]).all()
    np.testing.assert_allclose(found.covariance[[0, 1, 59]], covariance.marginal[[0, 1, 59]], atol=1e-11)


@pytest.mark.parametrize("past", [0.1, 0.3, 0.6, 1.0])
def test_followed_past_their_ends_splines_are_off_by_less_than_what_is_promised_there(past):
    samples = Trajectory(SCAN_TIMES, swaying(SCAN_TIMES))
    off, promised = [], []
    for first in range(0, 40):
        some = Trajectory(SCAN_TIMES[first : first + 20], samples.world_from_sensor[first : first + 20])
        time = some.times[-1:] + past * 0.1
        assert spline.past_ends(some, time) == pytest.approx(past)
        wrong = geometry.log(geometry.inverse(swaying(time)) @ spline.through(some, time, beyond=0.2))
        off.append(np.linalg.norm(wrong[0, :3]))
        error = spline.extrapolation_error(spline.past_ends(some, time))
        promised.append(np.sqrt(3.0) * error[0] * spline.leave_one_out_error(some, time)[0, 0])
    ratio = np.sqrt(np.mean(np.square(off)) / np.mean(np.square(promised)))
    assert 0.2 < ratio < 1.2


def test_a_camera_that_jumps_moves_no_scan():
    """What is missed about it is large, so nobody trusts the spline there."""
    rng = np.random.default_rng(3)
    given, covariance, truth = scans(rng)
    found = pose_fusion.fuse(given, covariance, lifted(cameras(rng), slice(30, 31), 0.5))
    assert errors(found.world_from_scan, truth).max() < 0.003


def test_cameras_that_are_off_together_beyond_all_promises_move_no_scan():
    rng = np.random.default_rng(3)
    given, covariance, truth = scans(rng)
    found = pose_fusion.fuse(given, covariance, lifted(cameras(rng), slice(25, 40), 0.05))
    assert found.contradicted >= 8
    assert errors(found.world_from_scan, truth).max() < 0.003


def test_what_the_extrinsic_leaves_open_is_no_news_to_the_scans():
    """All cameras off together, as far as the extrinsic may be: scans must not follow."""
    rng = np.random.default_rng(4)
    given, covariance, truth = scans(rng)
    good = cameras(rng, extrinsic_sigma=np.array([0, 0, 0, 0.01, 0.01, 0.01, 0]))
    poses = good.world_from_scan.world_from_sensor @ geometry.exp(np.array([0, 0, 0, 0.01, 0, 0]))
    found = pose_fusion.fuse(
        given,
        covariance,
        replace(good, world_from_scan=replace(good.world_from_scan, world_from_sensor=poses)),
    )
    off = geometry.log(geometry.inverse(truth) @ found.world_from_scan)[:, 3:]
    before = geometry.log(geometry.inverse(truth) @ given.world_from_sensor)[:, 3:]
    assert np.abs(off.mean(0) - before.mean(0)).max() < 1e-4
    assert np.sqrt((off**2).mean()) < 0.85 * np.sqrt((before**2).mean()), (
        "else the cameras tell as much as ever"
    )


def test_groups_that_cameras_see_beside_each_other_move_to_each_other():
    """Planes hold each group within itself, and the groups to each other by little: there cameras decide."""
    rng = np.random.default_rng(12)
    given, covariance, truth = scans(rng)
    poses = given.world_from_sensor.copy()
    poses[30:, 2, 3] += 0.04
    marginal = covariance.marginal + np.diag([0, 0, 0, 0, 0, 0.02**2])
    step = covariance.conditional[1:] + covariance.conditional[:-1]
    step[29] += np.diag([0, 0, 0, 0, 0, 0.04**2])
    seen = cameras(rng, extrinsic_sigma=np.array([0, 0, 0, 0.01, 0.01, 0.01, 0]))
    found = pose_fusion.fuse(
        replace(given, world_from_sensor=poses),
        Covariance(marginal, covariance.conditional, marginal, step),
        seen,
    )
    after = (found.world_from_scan - truth)[:, 2, 3]
    assert abs(after[32:57].mean() - after[3:28].mean()) < 0.001
    assert after[2:58].std() < 0.001


def test_covariances_that_promise_too_much_are_widened():
    rng = np.random.default_rng(6)
    given, covariance, truth = scans(rng)
    sure = Covariance(*[covariance.marginal / 400] * 3)
    good = cameras(rng)
    found = pose_fusion.fuse(given, sure, replace(good, covariance=good.covariance / 400))
    assert found.interpolation_error_scale > 0.9
    honest = pose_fusion.fuse(given, covariance, good)
    assert honest.variance_factor < 1.2
    assert np.trace(found.covariance[30]) * found.variance_factor > np.trace(sure.marginal[30])
    assert errors(found.world_from_scan, truth).max() < 0.003


def test_too_few_cameras_tell_nothing():
    rng = np.random.default_rng(7)
    given, covariance, _ = scans(rng)
    spread = blocks(np.tile(TIGHT, (6, 1)))
    spread[:3] = np.nan
    few = pose_fusion.scan_poses_from_cameras(
        path(IMAGE_TIMES[:6]) @ MOUNT, IMAGE_TIMES[:6] + OFFSET, spread, MOUNT, np.zeros(7)
    )
    assert len(few.world_from_scan) == 3
    assert pose_fusion.fuse(given, covariance, few) is None


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_scans_that_alignment_leaves_no_error_are_no_trouble(count):
    rng = np.random.default_rng(13)
    given, covariance, _ = scans(rng)
    few = slice(20, 20 + count)
    given = Trajectory(SCAN_TIMES[few], given.world_from_sensor[few])
    none = np.zeros((count, 6, 6))
    none = Covariance(none, covariance.conditional[few], none, np.zeros((count - 1, 6, 6)))
    found = pose_fusion.fuse(given, none, cameras(rng))
    assert np.isfinite(found.world_from_scan).all()
    assert np.isfinite(found.covariance).all()
    assert found.moved_m.max() < 0.005


def test_images_that_all_lie_outside_the_scans_move_none():
    rng = np.random.default_rng(8)
    given, covariance, _ = scans(rng)
    later = cameras(rng)
    times = later.world_from_scan.times + 100.0
    later = replace(later, world_from_scan=replace(later.world_from_scan, times=times))
    found = pose_fusion.fuse(given, covariance, later)
    assert (found.world_from_scan == given.world_from_sensor).all()
    assert found.variance_factor == 1.0


def test_splines_are_off_by_a_part_of_what_is_missed_and_by_more_at_their_ends():
    times = np.linspace(-0.5, 6.2, 400)
    samples = Trajectory(SCAN_TIMES, path(SCAN_TIMES))
    inside = ~spline.outside(samples, times)
    wrong = geometry.log(geometry.inverse(path(times)) @ spline.through(samples, times))[inside]
    leave_one_out_error, end = (
        spline.leave_one_out_error(samples, times)[inside],
        spline.boundary_error(samples, times)[inside],
    )
    for part, column in ((slice(3), 0), (slice(3, 6), 1)):
        off = np.linalg.norm(wrong[:, part], axis=1) / np.sqrt(3.0)
        for where, share in ((end > 0.2, 1.0), (end < 0.001, 0.1)):
            assert off[where].max() < share * leave_one_out_error[where, column].max()


def swaying(times):
    """Somebody who rolls from side to side faster than samples follow, and does nothing else in a hurry."""
    roll = np.zeros((len(times), 6))
    roll[:, 0] = 0.02 * np.sin(23.0 * np.asarray(times))
    return path(times) @ geometry.exp(roll)


def test_samples_that_are_left_out_tell_about_which_axis_the_sensor_sways():
    samples = Trajectory(SCAN_TIMES, swaying(SCAN_TIMES))
    times = SCAN_TIMES[5:-5] + 0.05
    by_axis, mean = (
        spline.leave_one_out_error_by_axis(samples, times), spline.leave_one_out_error(samples, times)
    )  # fmt: skip
    assert (by_axis[:, 0] > 4 * by_axis[:, 1:3].max(axis=1)).all()
    total = np.sqrt(np.square(by_axis[:, :3]).mean(axis=1))
    np.testing.assert_allclose(total, mean[:, 0], rtol=0.02)
    wrong = geometry.log(geometry.inverse(swaying(times)) @ spline.through(samples, times))
    assert np.sqrt((wrong[:, 0] ** 2).mean()) < np.sqrt((by_axis[:, 0] ** 2).mean())


def test_a_sway_between_images_turns_no_scan_though_other_axes_agree_better_than_promised():
    """Scans are surer than promised, as in a street: so is the roll of cameras, but not between them."""
    rng = np.random.default_rng(21)
    truth = swaying(SCAN_TIMES)
    sigma = np.tile(TIGHT, (len(SCAN_TIMES), 1))
    given = Trajectory(SCAN_TIMES, geometry.retract(truth, 0.2 * rng.normal(size=sigma.shape) * sigma))
    spread = np.tile(TIGHT, (len(IMAGE_TIMES), 1)) * [0.25, 1, 1, 1, 1, 1]
    careful = spread * [1, 10, 10, 10, 10, 10]
    seen = pose_fusion.scan_poses_from_cameras(
        geometry.retract(swaying(IMAGE_TIMES), rng.normal(size=spread.shape) * spread),
        IMAGE_TIMES, blocks(careful), np.eye(4), np.zeros(7),
    )  # fmt: skip
    found = pose_fusion.fuse(given, Covariance(*[blocks(sigma)] * 3), seen)
    before, after = (
        np.sqrt(np.square(geometry.log(geometry.inverse(truth) @ poses)[3:-3, 0]).mean())
        for poses in (given.world_from_sensor, found.world_from_scan)
    )
    assert after < 1.2 * before


def test_splines_meet_their_samples_and_stand_still_beyond_the_ends():
    """Half a turn and more, so that quaternions change their sign on the way."""
    times = np.arange(90) * 0.1
    samples = Trajectory(times, path(times))
    assert np.allclose(spline.through(samples, times), samples.world_from_sensor, atol=1e-12)
    ends = spline.through(samples, np.array([-3.0, 99.0]))
    assert np.allclose(ends, samples.world_from_sensor[[0, -1]], atol=1e-12)
