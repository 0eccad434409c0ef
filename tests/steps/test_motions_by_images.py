"""Scans that planes leave to an odometry that images contradict: laid out by features of the images."""

from types import SimpleNamespace

import numpy as np
import pytest
from textured_room import COUNT

from lvba import geometry
from lvba.lidar.config import LidarConfig
from lvba.lidar.odometry_factor import odometry_prior, with_motions
from lvba.loop_closure.rough_poses import RoughError, StartPoses
from lvba.steps import lidar, motions_by_images
from lvba.steps.motions_by_images import ImageMotions

THERE, BACK = 7, 15
"""Scans after which the rough poses go aside, and back."""
ASIDE = geometry.exp(np.array([0.0, 0.0, 0.03, 0.25, 0.12, 0.0]))
CONFIG = LidarConfig()


def aside(truth, by=ASIDE):
    poses = truth.copy()
    poses[THERE + 1 : BACK + 1] = by @ poses[THERE + 1 : BACK + 1]
    return poses


def left_open(room, *steps):
    return np.isin(np.arange(len(room.truth) - 1), steps).astype(float)


def off(poses, truth):
    """m and degrees, (S - 1,) each, that motions are off."""
    error = geometry.inverse(geometry.steps(truth)) @ geometry.steps(poses)
    return np.linalg.norm(error[:, :3, 3], axis=1), geometry.rotation_angle_deg(error)


def test_scans_go_where_images_have_them(room, recording_of_room):
    rough = aside(room.truth)
    dataset, dependence = recording_of_room(rough), left_open(room, THERE, BACK)
    laid_out = motions_by_images.laid_out(dataset, room.surfels, rough, dependence, None, CONFIG)
    assert off(rough, room.truth)[0].max() > 0.2
    meters, degrees = off(laid_out.start.world_from_scan, room.truth)
    assert meters.max() < 0.05
    assert degrees.max() < 0.7
    np.testing.assert_array_equal(laid_out.start.world_from_scan[0], rough[0])
    assert np.isin([THERE, BACK], laid_out.start.error.by_images).all()
    assert laid_out.fits_better(dataset, laid_out.start.world_from_scan, rough)
    assert not laid_out.fits_better(dataset, rough, room.truth)


def test_one_open_motion_is_enough_to_look_at_all_images(room, recording_of_room):
    rough = np.concatenate([room.truth[: THERE + 1], ASIDE @ room.truth[THERE + 1 :]])
    dataset, dependence = recording_of_room(rough), left_open(room, THERE)
    laid_out = motions_by_images.laid_out(dataset, room.surfels, rough, dependence, None, CONFIG)
    assert off(laid_out.start.world_from_scan, room.truth)[0].max() < 0.05
    assert len(laid_out.motions) > 5


@pytest.mark.parametrize(
    ("by", "open_steps", "images"),
    [
        (np.eye(4), (THERE, BACK), range(COUNT)),  # a right odometry
        (geometry.exp(np.array([0, 0, 0.01, 0.05, 0.02, 0])), (THERE, BACK), range(COUNT)),  # hardly off
        (ASIDE, (), range(COUNT)),  # planes tell of all motions
        (ASIDE, (THERE, BACK), range(1)),
        (ASIDE, (THERE,), range(THERE // 2)),  # no images there
    ],
)
def test_poses_stay_where_images_have_nothing_against_them(room, recording_of_room, by, open_steps, images):
    rough = aside(room.truth, by)
    dataset, dependence = recording_of_room(rough, images), left_open(room, *open_steps)
    assert motions_by_images.laid_out(dataset, room.surfels, rough, dependence, None, CONFIG) is None


def test_jumps_that_images_tell_of_are_no_jumps_any_more(room, recording_of_room):
    rough = aside(room.truth)
    none = np.zeros(0, np.int64)
    begin = StartPoses(rough, RoughError(0.08, 0.4, np.array([THERE]), np.array([THERE]), none))
    laid_out = motions_by_images.laid_out(
        recording_of_room(rough), room.surfels, rough, left_open(room, THERE), begin, CONFIG
    )
    error = laid_out.start.error
    assert (error.wrong_after.tolist(), error.open_after.tolist()) == ([], [])
    assert error.step_m >= 0.08


def test_what_images_tell_of_half_of_a_motion_counts():
    scans, times = np.array([0, 2, 4, 6]), np.array([0.0, 0.4, 1.0, 1.6, 2.0, 2.1, 3.0])
    covered = motions_by_images._covered(times, scans, np.array([1, 3]), np.array([3, 5]))
    assert covered.tolist() == [0, 1]


def test_images_about_a_motion_are_those_beside_and_between():
    images = SimpleNamespace(times=np.array([0.0, 0.9, 1.1, 1.5, 2.0, 3.0]))
    dataset = SimpleNamespace(images=images, scans=SimpleNamespace(times=np.arange(4.0)))
    about = motions_by_images._about(dataset, np.arange(6), np.array([1]))
    assert about.tolist() == [False, True, True, True, False]
    assert motions_by_images._about(dataset, np.arange(6), np.array([0, 2])).tolist() == [
        True, True, False, False, True,
    ]  # fmt: skip


def test_the_fewer_motions_of_two_kinds_say_nothing_of_the_others():
    truth = geometry.exp(np.outer(np.arange(6.0), [0, 0, 0.1, 1, 0, 0]))
    moved = geometry.exp(np.outer(np.arange(6.0), [0, 0, 0.1, 2, 0, 0]))
    prior = odometry_prior(truth, 0.01, 0.05)
    one = with_motions(prior, np.array([1]), moved, 0.02, 0.2)
    np.testing.assert_allclose(one.previous_from_next[1], geometry.steps(moved)[1], atol=1e-12)
    np.testing.assert_array_equal(one.previous_from_next[[0, 2]], prior.previous_from_next[[0, 2]])
    np.testing.assert_allclose(np.diagonal(one.information[1]), np.repeat([0.02, 0.2], 3) ** -2.0)
    assert one.jumps.tolist() == [1]
    assert with_motions(prior, np.arange(4), moved, 0.02, 0.2).jumps.tolist() == [4]
    assert with_motions(prior, np.zeros(0, np.int64), moved, 0.02, 0.2) is prior


@pytest.mark.parametrize("better", [True, False])
def test_the_bundle_adjustment_begins_again_and_the_better_result_is_used(
    room, recording_of_room, monkeypatch, better
):
    rough = aside(room.truth)
    dataset = recording_of_room(rough)
    dataset.sensor_position_scan = np.zeros(3)
    results = {True: room.truth if better else rough, False: rough}
    none = np.zeros(0, np.int64)

    def refined(*arguments):
        poses = results[arguments[-1] is not None]
        return SimpleNamespace(world_from_scan=poses, odometry_dependence=left_open(room, THERE, BACK))

    monkeypatch.setattr(lidar, "_refined", refined)
    monkeypatch.setattr(lidar, "_jumps_by_images", lambda *_: None)
    monkeypatch.setattr(lidar.rough_motions, "typically_off", lambda *_: 0.0)
    monkeypatch.setattr(lidar.rough_poses, "surfels_of", lambda *_: room.surfels)
    monkeypatch.setattr(lidar.rough_poses, "start_if_contradicted", lambda *_, **__: None)
    monkeypatch.setattr(lidar, "_confirmed", lambda *_: none)
    monkeypatch.setattr(
        lidar, "ScanReader", lambda _: SimpleNamespace(load=lambda _: [], cosines=lambda _: None)
    )
    part = SimpleNamespace(scan_numbers=np.arange(len(rough)))
    stage = lidar.solve_lidar(dataset, part, [], CONFIG)
    assert stage.result.world_from_scan is results[True]
    assert (stage.rough_error is not None) == better


def test_motions_that_differ_little_cost_little_and_others_a_bounded_amount(room, recording_of_room):
    """From the last image before the scans go aside to the next."""
    dataset, first = recording_of_room(room.truth), THERE // 2
    motion = geometry.inverse(room.truth[2 * first]) @ room.truth[2 * first + 2]
    motions = ImageMotions(np.array([first]), np.array([first + 1]), motion[None])
    costs = [
        motions.cost(dataset, aside(room.truth, geometry.exp(np.array([0, 0, 0, x, 0, 0]))))
        for x in (0.0, 0.03, 1.0, 5.0)
    ]
    assert costs[0] == pytest.approx(0.0, abs=1e-9)
    assert 0.5 < costs[1] < costs[2] == costs[3] == 16.0
