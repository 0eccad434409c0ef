"""How residuals scatter: the model's two numbers are found in residuals made to follow it, and in rendered images."""

import numpy as np
import pytest
import textured_planes

from lvba.camera import Camera
from lvba.visual import noise, photometric
from lvba.visual.noise import NoiseModel
from lvba.visual.photometric import COUNT, SQUARE, WEIGHTS, PhotometricState
from lvba.visual.states import CameraStates

SAMPLES = 81


def sums_of(model: NoiseModel, gradient: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sums of observations of these mean squared gradients whose residuals follow the model."""
    made = np.zeros((len(gradient), 13))
    made[:, COUNT] = made[:, WEIGHTS] = SAMPLES
    part = rng.uniform(0.2, 0.8, len(gradient))
    made[:, 0], made[:, 2] = SAMPLES * gradient * part, SAMPLES * gradient * (1 - part)
    made[:, SQUARE] = model.sigma(gradient) ** 2 * rng.chisquare(SAMPLES, len(gradient))
    return made


@pytest.mark.parametrize(("pixel", "shift"), [(2.0, 0.3), (1.0, 0.05), (3.0, 0.0)])
def test_both_numbers_are_found_though_many_patches_do_not_fit(pixel, shift):
    rng = np.random.default_rng(0)
    model, gradient = NoiseModel(pixel, shift), rng.lognormal(3.5, 1.3, 3000)
    made = sums_of(model, gradient, rng)
    found = noise.estimate(made, SAMPLES)
    assert found.pixel == pytest.approx(pixel, rel=0.03)
    assert found.shift == pytest.approx(shift, rel=0.05, abs=0.03)
    made[::5, SQUARE] *= 100
    spoiled = noise.estimate(made, SAMPLES)
    assert spoiled.sigma(gradient) == pytest.approx(model.sigma(gradient), rel=0.15)


def test_the_gradient_of_a_patch_without_samples_is_taken_as_the_median():
    made = sums_of(NoiseModel(1.0, 0.1), np.array([4.0, 9.0, 16.0]), np.random.default_rng(0))
    made = np.vstack([made, np.zeros((1, 13))])
    assert noise.gradients(made) == pytest.approx([4.0, 9.0, 16.0, 9.0])


def test_few_observations_give_one_level_and_none_the_floor():
    made = sums_of(NoiseModel(2.0, 0.3), np.full(30, 50.0), np.random.default_rng(0))
    found = noise.estimate(made, SAMPLES)
    assert found.shift == 0
    assert found.pixel == pytest.approx(NoiseModel(2.0, 0.3).sigma(50.0), rel=0.1)
    assert noise.estimate(made[:0], SAMPLES) == NoiseModel(0.5, 0.0)
    half = made.copy()
    half[:, COUNT] = 0.4 * SAMPLES
    assert noise.estimate(half, SAMPLES) == NoiseModel(0.5, 0.0), (
        "patches that are mostly masked have no vote"
    )


def test_interpolation_of_rendered_images_shows_as_shift():
    camera = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)
    world, poses = textured_planes.room(), textured_planes.walk(4)
    images = textured_planes.render(world, poses, camera, [1, 1.2, 0.9, 1.1], noise=2.0)
    points, observations = textured_planes.scene_points(world, poses, camera, step=10)
    problem = photometric.prepare(images, camera, points, observations)
    truth = CameraStates(poses, np.log([1, 1.2, 0.9, 1.1]))
    sums = photometric.sums(problem, PhotometricState(truth, np.zeros(len(points))))
    found = noise.estimate(sums, problem.samples)
    assert 1.0 < found.pixel < 2.0
    assert 0.1 < found.shift < 0.3
    square, gradient = sums[:, SQUARE] / sums[:, COUNT], noise.gradients(sums)
    normalized = square / found.sigma(gradient) ** 2
    strong = gradient > np.median(gradient)
    assert np.median(square[strong]) > 2 * np.median(square[~strong])
    for half in (strong, ~strong):
        assert np.median(normalized[half]) == pytest.approx(1.0, abs=0.3)
