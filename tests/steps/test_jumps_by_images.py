"""Rough poses that jump where surfaces do not tell: features of the images on both sides say by how much."""

from types import SimpleNamespace

import numpy as np
import pytest
from textured_room import COUNT

from lvba import geometry
from lvba.lidar.config import LidarConfig
from lvba.steps import jumps_by_images, lidar
from lvba.trajectory import Trajectory

AFTER = 11
JUMP = geometry.exp(np.array([0.01, -0.02, 0.04, 0.7, 0.3, -0.1]))
NONE = np.zeros(0, np.int64)


def jumped(truth, by=JUMP):
    return np.concatenate([truth[: AFTER + 1], by @ truth[AFTER + 1 :]])


def off(poses, truth):
    """m and degrees that the motion over the jump is off."""
    step, true = (geometry.inverse(each[AFTER]) @ each[AFTER + 1] for each in (poses, truth))
    error = geometry.inverse(true) @ step
    return np.linalg.norm(error[:3, 3]), geometry.rotation_angle_deg(error)


def test_scans_after_a_jump_go_where_images_have_them(room, recording_of_room):
    rough = jumped(room.truth)
    poses, moved = jumps_by_images.mended(recording_of_room(rough), room.surfels, rough, np.array([AFTER]))
    assert moved.tolist() == [AFTER]
    assert off(rough, room.truth)[0] > 0.7
    meters, degrees = off(poses, room.truth)
    assert meters < 0.04
    assert degrees < 0.5
    np.testing.assert_array_equal(poses[0], rough[0])
    # within each run nothing changes
    steps = np.delete(np.arange(len(poses) - 1), AFTER)
    np.testing.assert_allclose(geometry.steps(poses)[steps], geometry.steps(rough)[steps], atol=1e-9)


@pytest.mark.parametrize(
    ("by", "images"),
    [
        (np.eye(4), range(COUNT)),  # a true motion
        (geometry.exp(np.array([0, 0, 0.01, 0.05, 0.02, 0])), range(COUNT)),  # nearer than features tell
        (JUMP, range(AFTER // 2 + 1)),  # no images after it
        (JUMP, range(0)),
    ],
)
def test_poses_stay_where_images_do_not_tell_of_a_jump(room, recording_of_room, by, images):
    rough = jumped(room.truth, by)
    poses, moved = jumps_by_images.mended(
        recording_of_room(rough, images), room.surfels, rough, np.array([AFTER])
    )
    assert len(moved) == 0
    assert poses is rough


def test_the_bundle_adjustment_begins_there_and_the_jump_counts_as_open(room, recording_of_room, monkeypatch):
    rough, config = jumped(room.truth), LidarConfig()
    monkeypatch.setattr(lidar.trajectory_jumps, "find", lambda _: SimpleNamespace(after=np.array([AFTER])))
    # as of a narrow sensor: surfaces confirm nothing
    monkeypatch.setattr(lidar.rough_motions, "confirmed", lambda *_: NONE)
    begin = lidar._jumps_by_images(recording_of_room(rough), room.surfels, None, config)
    assert off(begin.world_from_scan, room.truth)[0] < 0.04
    assert begin.error.wrong_after.tolist() == begin.error.open_after.tolist() == [AFTER]
    assert begin.error.step_m == config.prior_translation
    assert lidar._jumps_by_images(recording_of_room(rough, range(0)), room.surfels, None, config) is None
    monkeypatch.setattr(lidar.rough_motions, "confirmed", lambda *_: np.array([AFTER]))
    assert lidar._jumps_by_images(recording_of_room(rough), room.surfels, None, config) is None


def test_runs_that_images_put_together_move_and_others_follow_those_before():
    """Five runs: 0 goes to 2, 4 to 3; nothing is known of 1, which stays beside 0, and 3 beside 2."""
    to = [geometry.exp(np.array([0, 0, 0, x, 0, 0])) for x in (1.0, 0.0, 0.0, 0.0, 5.0)]
    final = jumps_by_images._beside_each_other(np.stack(to), np.array([7, -2, 7, 4, 4]))
    np.testing.assert_allclose(final[:, 0, 3], [0.0, 0.0, -1.0, -1.0, 4.0], atol=1e-12)


def test_an_image_just_beside_a_jump_is_seen_by_the_scans_on_its_side():
    scans = Trajectory(np.arange(6.0), geometry.exp(np.outer(np.arange(6.0), [0, 0, 0, 1, 0, 0])))
    images = SimpleNamespace(times=np.array([-0.1, 0.5, 2.1, 2.5, 2.9, 3.0, 4.6, 5.2]))
    dataset = SimpleNamespace(scans=scans, images=images, camera_from_scan=np.eye(4))
    run = np.array([0, 0, 0, 1, 1, 1])
    numbers, of_run = jumps_by_images._of_images(dataset, run)
    assert numbers.tolist() == [1, 2, 4, 5, 6]
    assert of_run.tolist() == [0, 0, 1, 1, 1]
    jumps = scans.world_from_sensor.copy()
    jumps[3:, 1, 3] += 1.0
    cameras = jumps_by_images._cameras(dataset, jumps, run, numbers, of_run)
    np.testing.assert_allclose(cameras[:, 0, 3], [0.5, 2.1, 2.9, 3.0, 4.6], atol=1e-9)
    np.testing.assert_allclose(cameras[:, 1, 3], [0, 0, 1, 1, 1], atol=1e-9)
    # a scan alone between two jumps does not tell how the sensor moves
    assert 4 not in jumps_by_images._of_images(dataset, np.array([0, 0, 0, 1, 2, 2]))[0]
