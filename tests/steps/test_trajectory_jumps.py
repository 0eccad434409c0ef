"""Jumps of a trajectory are found; speed, braking, shaking and gaps in time are none."""

from types import SimpleNamespace

import numpy as np
import pytest

from lvba import geometry, spline
from lvba.loop_closure.rough_poses import RoughError
from lvba.steps import odometry_data, trajectory_jumps
from lvba.steps.outcomes import LidarStage
from lvba.trajectory import Trajectory


def drive(times, noise=0.005, seed=0):
    """A car that speeds up, brakes and turns, with the noise of an odometry."""
    rng = np.random.default_rng(seed)
    x = 8 * times + 6 * np.sin(0.5 * times)
    heading = 0.3 * np.sin(0.4 * times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :2, :2] = np.moveaxis(
        np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]), -1, 0
    )
    poses[:, 0, 3], poses[:, 1, 3] = x, 2 * np.sin(0.3 * times)
    return geometry.retract(poses, rng.normal(0, [noise / 10] * 3 + [noise] * 3, (len(times), 6)))


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_driving_is_no_jump_at_any_rate_nor_over_a_gap(rate):
    times = np.arange(0, 60, 1 / rate)
    assert len(trajectory_jumps.find(Trajectory(times, drive(times))).after) == 0
    kept = (times < 20) | (times > 21.5)
    assert len(trajectory_jumps.find(Trajectory(times[kept], drive(times[kept]))).after) == 0


@pytest.mark.parametrize(("meters", "degrees"), [(1.0, 0.0), (0.4, 1.0), (0.0, 6.0)])
def test_jumps_are_found_where_they_are(meters, degrees):
    times = np.arange(0, 30, 0.1)
    poses = drive(times)
    at = [40, 200]
    for after in at:
        jump = geometry.exp(np.array([0, 0, np.radians(degrees), 0, meters, 0]))
        poses[after + 1 :] = poses[after] @ jump @ geometry.inverse(poses[after]) @ poses[after + 1 :]
    found = trajectory_jumps.find(Trajectory(times, poses))
    assert found.after.tolist() == at
    assert found.meters == pytest.approx([meters] * 2, abs=0.1)
    # one degree is nothing special for an odometry
    assert found.degrees == pytest.approx([degrees if degrees > 1.8 else 0.0] * 2, abs=0.3)


@pytest.mark.parametrize(("pause", "jumps"), [(1.0, 1), (72.5, 0)])
def test_where_a_sensor_went_while_the_recording_stood_still_is_no_jump(pause, jumps):
    times = np.arange(0, 20, 0.1)
    poses = drive(times)
    poses[100:, 1, 3] += 3.0
    times[100:] += pause
    assert len(trajectory_jumps.find(Trajectory(times, poses)).after) == jumps


def swinging(times, fastest):
    """A sensor that walks straight on and is swung from side to side, so many degrees per second at most."""
    sides = np.random.default_rng(2).choice(
        [-1.0, -0.9, 0.0, 0.8, 1.0], len(times), p=[0.1, 0.1, 0.6, 0.1, 0.1]
    )
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for k in range(1, len(times)):
        interval = times[k] - times[k - 1]
        step = geometry.exp(np.array([0, 0, np.radians(fastest) * sides[k] * interval, interval, 0, 0]))
        poses[k] = poses[k - 1] @ step
    return poses


def test_a_sensor_that_swings_does_not_jump_where_it_turns_back():
    """Between sparse frames nothing shows how a turn came to; a meter aside is still one."""
    times = np.arange(0, 40, 0.8)
    poses = swinging(times, 60.0)
    assert trajectory_jumps.unexpected(Trajectory(times, poses))[1].max() > 40
    assert len(trajectory_jumps.find(Trajectory(times, poses)).after) == 0
    poses[21:] = (
        poses[20] @ geometry.exp(np.array([0, 0, 0, 0, 1.0, 0])) @ geometry.inverse(poses[20]) @ poses[21:]
    )
    assert trajectory_jumps.find(Trajectory(times, poses)).after.tolist() == [20]


def test_a_jump_upwards_shows_where_motions_change_as_much_along_the_ground():
    rng = np.random.default_rng(4)
    times = np.arange(0, 24, 0.8)
    step = np.column_stack([rng.normal(0.5, 0.25, 30), rng.normal(0, 0.25, 30), rng.normal(0, 0.02, 30)])
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, 3] = np.cumsum(step, axis=0)
    assert len(trajectory_jumps.find(Trajectory(times, poses)).after) == 0
    for way, jumps in (([0.7, 0.0, 0.0], []), ([0.4, 0.0, -0.7], [17])):
        jumping = poses.copy()
        jumping[18:, :3, 3] += way
        assert trajectory_jumps.find(Trajectory(times, jumping)).after.tolist() == jumps


@pytest.mark.parametrize("frames", [0, 1, 3, 5])
def test_few_frames_have_none(frames):
    times = np.arange(float(frames))
    assert len(trajectory_jumps.find(Trajectory(times, drive(times))).after) == 0


def aside(poses, x, y):
    """The poses from the 13th on moved by so much."""
    moved = np.eye(4)
    moved[:2, 3] = x, y
    return np.concatenate([poses[:13], moved @ poses[13:]])


MOUNT = geometry.exp(np.array([1.2, -1.1, 1.0, 0.05, -0.1, 0.08]))


def seen(times, scans, group):
    """Images a little after each scan, refined to where these scans have them, and the group of each."""
    moments = times + 0.03
    cameras = spline.through(Trajectory(times, scans), moments) @ MOUNT
    return SimpleNamespace(
        keyframes=np.arange(len(times)), world_from_camera=cameras, scan_from_camera=MOUNT, moments=lambda t: t,
        group=np.asarray(group),
    )  # fmt: skip


def facts(rough, refined, accepted, confirmed, images=None, used=True, error=None):
    """What the report says of poses every tenth of a second."""
    times = np.arange(len(rough)) / 10
    dataset = SimpleNamespace(scans=Trajectory(times, rough), images=SimpleNamespace(times=times + 0.03))
    lidar = SimpleNamespace(
        world_from_scan=refined,
        odometry_dependence=np.zeros(len(rough) - 1),
        degenerate_scans=np.zeros(len(rough)),
    )
    stage = LidarStage(lidar, rough_error=error, confirmed=np.array(confirmed, np.int64))
    state = SimpleNamespace(world_from_scan=accepted, cameras=SimpleNamespace(accepted=used))
    return odometry_data.of_odometry(dataset, state, stage, SimpleNamespace(result=images))


def odometry(*arguments, **options):
    """The scans after which poses jump, and those where nothing ties the next ones."""
    given = facts(*arguments, **options)
    return given["jumps_after"].tolist(), given["unconfirmed_after"].tolist()


def test_what_surfaces_confirm_is_no_jump_and_only_where_poses_go_as_they_say():
    true = drive(np.arange(30) / 10)
    jumped = aside(true, 0.9, 0.4)
    # a fast motion that all poses have, or a jump that all have: what surfaces say decides
    assert odometry(jumped, jumped, jumped, [12]) == ([], [])
    assert odometry(jumped, jumped, jumped, []) == ([12], [12])
    # surfaces confirm the refined motion: the input's jump is one, and stays one where the result is the input
    assert odometry(jumped, true, true, [12]) == ([12], [])
    assert odometry(jumped, true, jumped, [12]) == ([12], [12])
    # no jump to be seen any more is no tie: planes of one side may have pulled scans of the other anywhere
    assert odometry(jumped, true, true, []) == ([12], [12])


def test_a_jump_that_images_of_one_group_agree_with_is_tied():
    times = np.arange(30) / 10
    true = drive(times)
    jumped = aside(true, 0.9, 0.4)
    one, two = np.zeros(30, int), np.repeat([3, 5], [13, 17])
    right, wrong = seen(times, true, one), seen(times, jumped, one)
    assert odometry(jumped, true, true, [], right) == ([12], [])
    # images that have the scans elsewhere, that nothing ties to those before, or that are not used
    assert odometry(jumped, true, true, [], wrong) == ([12], [12])
    assert odometry(jumped, true, true, [], seen(times, true, two)) == ([12], [12])
    assert odometry(jumped, true, true, [], right, used=False) == ([12], [12])
    right.group = np.zeros(0, np.int64)
    assert odometry(jumped, true, true, [], right) == ([12], [12])


def test_a_fast_motion_that_images_confirm_is_no_jump_of_the_rough_poses():
    times = np.arange(30) / 10
    true = drive(times)
    fast = aside(true, 0.9, 0.4)
    one, two = np.zeros(30, int), np.repeat([3, 5], [13, 17])
    assert odometry(fast, fast, fast, [], seen(times, fast, one)) == ([], [])
    assert odometry(fast, fast, fast, [], seen(times, fast, two)) == ([12], [12])
    # 5 cm from where images have it, it may be anything
    assert odometry(fast, fast, fast, [], seen(times, aside(fast, 0.0, 0.05), one)) == ([12], [])
    # a jump of the rough poses that was mended is one
    assert odometry(true, fast, fast, [], seen(times, fast, one)) == ([], [])
    assert odometry(fast, true, true, [], seen(times, true, one)) == ([12], [])


def test_images_of_one_group_confirm_motions_that_surfaces_leave_open():
    times = np.arange(30) / 10
    true = drive(times)
    off = aside(true, 0.03, 0.04)
    error = RoughError(0.1, 1.0, np.array([12, 20]), np.array([0, 12, 20, 28]), np.array([25]))
    groups = np.repeat([0, 1], [21, 9])

    def left(scans, images):
        far = facts(true, scans, scans, [], images, error=error)["too_far_off"]
        assert far["wrong_after"].tolist() == [12, 20]
        assert far["left_after"].tolist() == [25]
        return far["open_after"].tolist(), far["by_images_after"].tolist(), far["unconnected_ends"]

    # what is open at either end concerns one scan alone
    assert left(true, None) == ([12, 20], [], [0, 29])
    # images at scans 12 and 13 are of one group, and at both ends, but not those at 20 and 21; none is before scan 0
    assert left(true, seen(times, true, groups)) == ([20], [12, 28], [0])
    # a step that images have 5 cm elsewhere is not what they confirm
    assert left(off, seen(times, true, groups)) == ([12, 20], [28], [0])
    assert facts(true, true, true, [])["too_far_off"] is None


def test_expected_motions_are_those_around():
    times = np.arange(0, 30, 0.5)
    steady = geometry.exp(np.array([0, 0, 0.1, 2.0, 0.1, 0]) * times[:, None])
    steps = geometry.inverse(steady[:-1]) @ steady[1:]
    turned = steady.copy()
    turned[21:] = turned[21:] @ geometry.exp(np.array([0, 0, 1.0, 0, 0, 0]))
    assert np.allclose(trajectory_jumps.expected(Trajectory(times, steady)), steps)
    # frames see the way they go from another side once they have turned, but they turn as before
    assert np.allclose(trajectory_jumps.expected(Trajectory(times, turned))[20, :3, :3], steps[20, :3, :3])
    assert trajectory_jumps.expected(Trajectory(times[:3], steady[:3])).shape == (2, 4, 4)


@pytest.mark.parametrize("used", [True, False])
def test_a_pause_that_only_the_odometry_bridges_is_named_unless_images_do(used):
    times = np.arange(0, 6, 0.1)
    times[30:] += 20.0
    poses = drive(np.arange(0, 6, 0.1))
    dependence = np.full(len(times) - 1, 0.01)
    dependence[[10, 29]] = 0.99
    dataset = SimpleNamespace(scans=Trajectory(times, poses), images=SimpleNamespace(times=times + 0.03))
    lidar = SimpleNamespace(
        world_from_scan=poses, odometry_dependence=dependence, degenerate_scans=np.zeros(len(times))
    )
    stage = LidarStage(lidar, rough_error=None, confirmed=np.zeros(0, np.int64))
    state = SimpleNamespace(world_from_scan=poses, cameras=SimpleNamespace(accepted=used))
    images = seen(times, poses, np.zeros(len(times), np.int64))
    known = odometry_data.of_odometry(dataset, state, stage, SimpleNamespace(result=images))
    assert list(known["pauses_after"]) == ([] if used else [29])
