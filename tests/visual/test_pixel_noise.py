"""How far images contradict each other by the noise of their pixels alone, and by more than that."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import textured_planes

from lvba.camera import Camera
from lvba.visual import covariance, photometric, pixel_noise
from lvba.visual import noise as noise_of_residuals
from lvba.visual.photometric import PhotometricState
from lvba.visual.states import CameraStates

CAMERA = Camera(320, 240, 190.0, 190.0, 159.5, 119.5)
COUNT, SIGMA = 8, 2.0
POSES = textured_planes.walk(COUNT)


@functools.cache
def pictures(noise):
    """Of the room, at the true poses."""
    return textured_planes.render(textured_planes.room(), POSES, CAMERA, np.ones(COUNT), noise=noise)


@functools.cache
def factors(step, camera=CAMERA, weight=1.0, noise=SIGMA):
    """The variance factor at the true poses, and what the noise of the pixels makes of it."""
    points, observations = textured_planes.scene_points(textured_planes.room(), POSES, CAMERA, step=step)
    problem = photometric.prepare(
        pictures(noise), camera, points, observations, 7, sigma=noise, variance_factor=weight
    )
    state = PhotometricState(CameraStates(POSES, np.zeros(COUNT)), np.zeros(len(points)))
    sums = photometric.sums(problem, state)
    sigma = noise_of_residuals.estimate(sums, problem.samples).sigma(noise_of_residuals.gradients(sums))
    problem = replace(problem, sigma=sigma)
    at = photometric.linearize(problem, state)
    walls = covariance.find_wall_clusters(problem)
    clusters = covariance.cluster_gradients(problem, at, walls)
    actual = weight * covariance.variance_factor(at.equations, clusters)
    return actual, pixel_noise.variance_factor(problem, state, at, walls)


def test_it_is_what_right_poses_show_the_more_the_closer_scene_points_are():
    for step in (14, 7, 5):
        actual, of_noise = factors(step)
        # the rest is interpolation
        assert 0.65 < of_noise / actual < 1.2, step
    assert factors(5)[1] > 1.8 * factors(7)[1] > 2.5 * factors(14)[1] > 2.5


def test_a_wrong_camera_contradicts_more_than_noise():
    wrong = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    actual, of_noise = factors(step=14, camera=wrong)
    assert actual > 15 * of_noise
    # sigma is estimated from the residuals
    assert of_noise < 4 * factors(step=14)[1]


def test_neither_the_weight_of_pixels_nor_a_sigma_below_one_grey_value_changes_what_noise_makes_of_it():
    of_noise = factors(step=7)[1]
    assert factors(step=7, weight=7.0)[1] == pytest.approx(of_noise, rel=1e-6)
    assert factors(step=7, noise=0.5)[1] == pytest.approx(of_noise, rel=0.25)
