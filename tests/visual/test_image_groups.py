"""Images that lost the others as a group, as where an odometry slips along a corridor: moved together by features."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room
from test_relocalization import off, solved
from textured_room import COUNT

from lvba import geometry
from lvba.visual import image_groups, refine
from lvba.visual.config import DEFAULTS
from lvba.visual.image import build_pyramid
from lvba.visual.scene import Inputs, scene_of

GROUP = np.arange(8, COUNT)
OTHERS = np.arange(8)
SLIP = geometry.exp(np.array([0.002, -0.004, 0.002, 0.7, 0.01, -0.02]))
"""Along x: three quarters of what images see faces across."""


@pytest.fixture(scope="module")
def room():
    return textured_room.make()


def slipped(truth, motion=SLIP):
    poses = truth.copy()
    poses[GROUP] = motion @ poses[GROUP]
    return poses


def groups_of(problem):
    return image_groups.find(problem.points, problem.observations, COUNT)


def test_a_group_that_slipped_is_put_beside_the_others_and_these_stay(room):
    inputs, truth, _ = room
    scene, start = scene_of(Inputs(**inputs), DEFAULTS), slipped(truth)
    problem, state = solved(scene, start)
    group = groups_of(problem)
    assert len(set(group[OTHERS])) == len(set(group[GROUP])) == 1
    assert group[0] != group[-1]
    joined = image_groups.rejoined(problem, scene.pyramid, state).cameras.world_from_camera
    assert off(start, truth)[0][GROUP].min() > 500.0
    assert off(joined, truth)[0][GROUP].max() < 30.0
    assert off(joined, truth)[1][GROUP].max() < 0.4
    assert joined[OTHERS].tobytes() == start[OTHERS].tobytes()
    within = geometry.inverse(joined[GROUP[0]]) @ joined[GROUP]
    np.testing.assert_allclose(within, geometry.inverse(truth[GROUP[0]]) @ truth[GROUP], atol=1e-9)
    again = image_groups.rejoined(problem, scene.pyramid, state).cameras.world_from_camera
    assert again.tobytes() == joined.tobytes()


def test_images_of_one_group_stay(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, truth)
    assert len(set(groups_of(problem))) == 1
    assert image_groups.rejoined(problem, scene.pyramid, state) is state


def test_a_group_that_sees_something_else_stays(room):
    inputs, truth, _ = room
    full = inputs["pyramid"].levels[0].copy()
    full[GROUP] = np.roll(full[GROUP][:, ::-1], 97, axis=2)
    inputs = inputs | {"pyramid": build_pyramid(full, inputs["pyramid"].camera, 2)}
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, truth)
    assert image_groups.rejoined(problem, scene.pyramid, state) is state


def test_a_group_does_not_leave_its_own_surfaces(room):
    """Up, off the floor: the scans of the same moments are off as well then, and its images are right on these."""
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    up = geometry.exp(np.array([0, 0, 0, 0.0, 0.5, 0.5]))
    problem, state = solved(scene, slipped(truth, up))
    assert groups_of(problem)[0] != groups_of(problem)[-1]
    assert image_groups.rejoined(problem, scene.pyramid, state) is state


def test_what_would_move_a_group_too_far_is_another_place_that_looks_alike(room, monkeypatch):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    start = slipped(truth)
    problem, state = solved(scene, start)
    monkeypatch.setattr(image_groups, "_FARTHEST_M", 0.3)
    assert (
        image_groups.rejoined(problem, scene.pyramid, state).cameras.world_from_camera.tobytes()
        == start.tobytes()
    )


def test_where_pairs_are_few_each_image_is_alone(room):
    inputs, truth, _ = room
    scene = scene_of(Inputs(**inputs), DEFAULTS)
    problem, state = solved(scene, truth)
    observations = problem.observations
    some = np.arange(0, len(observations), max(len(observations) // (20 * COUNT), 1))
    few = type(observations)(
        observations.point[some], observations.target[some], observations.is_global[some]
    )
    assert len(set(image_groups.find(problem.points, few, COUNT))) == COUNT
    assert image_groups.rejoined(replace(problem, observations=few), scene.pyramid, state) is state


def test_groups_of_parts_are_one_where_they_have_an_image_in_common():
    first = np.array([0, 1, 2, 3]), np.array([0, 0, 1, 1])
    second = np.array([3, 4, 5]), np.array([7, 7, 2])
    of_all = image_groups.of_all([first, second], 7)
    assert [[int(k) for k in np.flatnonzero(of_all == group)] for group in dict.fromkeys(of_all)] == [
        [0, 1], [2, 3, 4], [5], [6],
    ]  # fmt: skip
    assert len(set(image_groups.of_all([], 3))) == 3


def test_motions_count_if_another_agrees_or_many_features_do():
    at, motion = np.eye(4), geometry.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    near, far = (motion @ geometry.exp(np.array([0, 0, 0, 0, each, 0])) for each in (0.04, 0.5))
    assert image_groups._agreed([], at) is None
    assert image_groups._agreed([(motion, 40), (far, 40)], at) is None
    np.testing.assert_allclose(image_groups._agreed([(motion, 90)], at), motion, atol=1e-12)
    both = image_groups._agreed([(motion, 90), (far, 40), (near, 30)], at)
    np.testing.assert_allclose(both[:3, 3], [1.0, 0.01, 0.0], atol=1e-9)


def test_the_visual_stage_brings_a_group_that_slipped_to_the_truth(room, monkeypatch):
    """Scans of the group slipped as well, and nothing but images knows."""
    inputs, truth, _ = room
    rough = slipped(inputs["images"].world_from_sensor)
    inputs = inputs | {"images": replace(inputs["images"], world_from_sensor=rough)}
    # the spline knows nothing
    monkeypatch.setattr("lvba.spline.FEWEST_SAMPLES", 10**6)
    mm, degrees = off(refine.refine(Inputs(**inputs)).world_from_camera, truth)
    assert mm.max() < 5.0
    assert degrees.max() < 0.1
    monkeypatch.setattr(image_groups, "rejoined", lambda problem, pyramid, state: state)
    left = refine.refine(Inputs(**inputs)).world_from_camera
    assert off(left, truth)[0][GROUP].min() > 100.0
