"""Images that the trajectory leaves degrees off: found again by features, or left alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import textured_room
from textured_room import COUNT

from lvba import geometry
from lvba.visual import photometric, refine, relocalization, scene_points, visibility
from lvba.visual.config import DEFAULTS
from lvba.visual.image import LevelImages, build_pyramid
from lvba.visual.scene import Inputs, scene_of
from lvba.visual.states import CameraStates, VisualState

LOST = 5
TURN = geometry.exp(np.radians([2.0, 12.0, -3.0, 0.0, 0.0, 0.0]))
TURN[:3, 3] = [0.05, -0.03, 0.04]


@pytest.fixture(scope="module")
def room():
    return textured_room.make()


def pairs_at(scene, poses, level=1):
    """Points and pairs of a level at given poses, found as the visual stage does."""
    camera = scene.pyramid.camera.at_level(level)
    shown = LevelImages(scene.pyramid.levels[level], camera, float(scene.pyramid.noise[level]))
    points = scene_points.select(shown, scene.cameras(poses), scene.surfaces, scene.points)
    depth = scene.depth_buffers(camera, poses, 0.5)
    return visibility.find(shown, poses, points, scene.seen, DEFAULTS.visibility, depth)


def solved(scene, poses):
    """A problem as the last but one level leaves it, and its state."""
    points, observations = pairs_at(scene, poses)
    camera = scene.pyramid.camera.at_level(1)
    problem = photometric.prepare(scene.pyramid.levels[1], camera, points, observations, 9)
    return problem, VisualState(CameraStates(poses, np.zeros(COUNT)), scene.prior.calibration.reference)


def moved(truth):
    poses = truth.copy()
    poses[LOST] = poses[LOST] @ TURN
    return poses


def off(poses, truth):
    """mm and degrees of each."""
    error = geometry.inverse(truth) @ poses
    return 1e3 * np.linalg.norm(error[:, :3, 3], axis=1), geometry.rotation_angle_deg(error)


def test_an_image_degrees_off_is_found_again_and_the_others_stay(room):
    inputs, truth, _ = room
    scene, start = scene_of(Inputs(**inputs), DEFAULTS), moved(truth)
    problem, state = solved(scene, start)
    assert relocalization.lost(problem.points, problem.observations, COUNT).tolist() == [LOST]
    found = relocalization.relocalized(problem, scene.pyramid, state).cameras.world_from_camera
    mm, degrees = off(found, truth)
    assert mm[LOST] < 15.0
    assert degrees[LOST] < 0.3
    others = np.delete(np.arange(COUNT), LOST)
    assert found[others].tobytes() == start[others].tobytes()
    again = relocalization.relocalized(problem, scene.pyramid, state).cameras.world_from_camera
    assert again.tobytes() == found.tobytes()


def test_any_number_of_threads_finds_the_same_bytes(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, moved(truth))
    threads, found = cv2.getNumThreads(), []
    for count in (1, 4):
        cv2.setNumThreads(count)
        at = relocalization.relocalized(problem, scene.pyramid, state)
        found.append(at.cameras.world_from_camera.tobytes())
    cv2.setNumThreads(threads)
    assert found[0] == found[1]


def test_where_no_image_is_lost_nothing_is_looked_for(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, truth)
    assert len(relocalization.lost(problem.points, problem.observations, COUNT)) == 0
    assert relocalization.relocalized(problem, scene.pyramid, state) is state


@pytest.mark.parametrize("shown", ["noise", "nothing", "another place"])
def test_an_image_that_shows_nothing_of_the_others_stays_where_it_is(room, shown):
    inputs, truth, _ = room
    full = inputs["pyramid"].levels[0].copy()
    if shown == "another place":
        full[LOST] = np.roll(full[LOST][::-1], 97, axis=1)
    else:
        full[LOST] = np.random.default_rng(0).integers(30, 200, full[LOST].shape) if shown == "noise" else 90
    inputs = inputs | {"pyramid": build_pyramid(full, inputs["pyramid"].camera, 2)}
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, truth)
    assert relocalization.lost(problem.points, problem.observations, COUNT).tolist() == [LOST]
    found = relocalization.relocalized(problem, scene.pyramid, state).cameras.world_from_camera
    assert found.tobytes() == truth.tobytes()


def test_a_place_is_matched_by_one_feature_the_nearest():
    """Where an image has few places, hundreds of features seem to match the best: the second best is far off."""
    generator = np.random.default_rng(3)
    usual = generator.uniform(0, 60, 128)
    seen = usual + generator.normal(0, 1, (90, 128)) * np.linspace(3, 1, 90)[:, None]
    there = np.stack([usual, usual + 100, seen[7]]).astype(np.float32)
    pixel, position = relocalization._matched(
        relocalization._Features(np.arange(180.0).reshape(90, 2), seen.astype(np.float32)),
        relocalization._Places(np.arange(9.0).reshape(3, 3), there),
    )
    assert len(pixel) == 2
    nearest = int(np.argmin(np.linalg.norm(seen - usual, axis=1)))
    by_place = dict(zip(position[:, 0].tolist(), (pixel[:, 0] / 2).tolist(), strict=True))
    assert by_place == {0.0: nearest, 6.0: 7.0}


def test_the_visual_stage_brings_a_lost_image_to_the_truth(room, monkeypatch):
    """Its rough pose is off, and so is what the trajectory says: as where the sensor turned between scans."""
    inputs, truth, _ = room
    rough = inputs["images"].world_from_sensor.copy()
    rough[LOST] = rough[LOST] @ TURN
    inputs = inputs | {"images": replace(inputs["images"], world_from_sensor=rough)}
    # the spline knows nothing
    monkeypatch.setattr("lvba.spline.FEWEST_SAMPLES", 10**6)
    found = refine.refine(Inputs(**inputs)).world_from_camera
    mm, degrees = off(found, truth)
    assert mm[LOST] < 4.0
    assert degrees[LOST] < 0.06
    monkeypatch.setattr(relocalization, "relocalized", lambda problem, pyramid, state: state)
    left = refine.refine(Inputs(**inputs)).world_from_camera
    assert off(left, truth)[1][LOST] > 5.0


def test_pairs_by_chance_do_not_count(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    points, observations = pairs_at(scene, truth)
    ends = points.reference[observations.point], observations.target
    of_lost = np.flatnonzero((ends[0] == LOST) | (ends[1] == LOST))
    kept = np.setdiff1d(np.arange(len(observations)), of_lost[3:])
    few = scene_points.Observations(
        observations.point[kept], observations.target[kept], observations.is_global[kept]
    )
    points, few = relocalization.without_chance(points, few, COUNT)
    assert len(few) == len(kept) - 3
    assert LOST not in points.reference[few.point]
    assert LOST not in few.target
    assert np.unique(few.point).tolist() == list(range(len(points)))
    same, unchanged = relocalization.without_chance(points, few, COUNT)
    assert (same, unchanged) == (points, few)


def test_few_pairs_are_what_there_is_where_all_have_few(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    points, observations = pairs_at(scene, truth)
    some = np.arange(0, len(observations), max(len(observations) // (20 * COUNT), 1))
    few = scene_points.Observations(
        observations.point[some], observations.target[some], observations.is_global[some]
    )
    assert len(relocalization.lost(points, few, COUNT)) == 0
    assert relocalization.without_chance(points, few, COUNT)[1] is few
