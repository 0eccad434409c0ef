from dataclasses import replace

import numpy as np
import pytest
from rectangle_world import CAMERA, room_with_screen

from lvba.simulate.camera import filmic_curve, srgb_curve
from lvba.visual import exposure, image, radiometry, response, vignetting
from lvba.visual.exposure_graph import BLOCKS
from lvba.visual.radiometry import Radiometry
from lvba.visual.ratios import Ratios
from lvba.visual.response import KNOTS, LINEAR, Response
from lvba.visual.vignetting import PairPlaces, Vignetting

TRUE = Response((0.6, 0.65, 0.7, 0.8, 1.0, 1.4, 2.2))
LIGHT = np.linspace(0, 1, 100_001).astype(np.float32)


def grey_of(name):
    """Log grey values 0 to 255 of log light, of a curve by name."""
    curves = {
        "linear": LIGHT,
        "gamma": LIGHT ** (1 / 2.2),
        "srgb": srgb_curve(LIGHT),
        "filmic": filmic_curve(LIGHT),
    }
    grey = 255 * curves[name].astype(float)
    return lambda log_light: np.log(np.interp(np.exp(log_light), LIGHT, grey))


def make(name, seed=0, images=12, per_pair=150, sigma=0.01, falloff=vignetting.NONE):
    """Log ratios of grey values of patches whose light spans a factor of ten, and the exposures."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-0.5, 0.5, images)
    first = np.repeat(np.arange(images - 2), 2 * per_pair)
    second = first + 1 + np.tile(np.repeat([0, 1], per_pair), images - 2)
    radiance = rng.uniform(np.log(0.03), np.log(0.3), len(first))
    reference = rng.uniform(-0.7, 0.7, (len(first), 2))
    target = np.clip(reference + rng.uniform(-0.25, 0.25, reference.shape), -0.7, 0.7)
    grey = [
        grey_of(name)(radiance + truth[image] + falloff.log_light(place))
        + sigma * rng.standard_normal(len(first))
        for image, place in ((first, reference), (second, target))
    ]
    block = rng.integers(0, BLOCKS, len(first))
    ratios = Ratios(
        first.astype(np.int32), second.astype(np.int32), grey[1] - grey[0], np.full(len(first), 1.5 * sigma),
        block, block, (grey[0] + grey[1]) / 2, np.arange(len(first)),
        PairPlaces(reference, target),
    )  # fmt: skip
    return truth, ratios


def left_of(estimate, truth):
    """The errors of log exposures after the one power that ratios leave open, in units of the true ones."""
    power, offset = np.polyfit(truth, estimate, 1)
    return (estimate - power * truth - offset) / power


@pytest.mark.parametrize("falloff", [vignetting.NONE, Vignetting((-0.4, -0.1, 0.0))])
def test_a_filmic_curve_leaves_exposures_to_one_percent(falloff):
    truth, ratios = make("filmic", falloff=falloff)
    estimate = exposure.solve_ratios(ratios, len(truth))
    assert estimate.radiometry.response
    without = exposure.solve_ratios(replace(ratios, places=None), len(truth))
    errors = [np.std(left_of(each.log_exposure, truth)) for each in (estimate, without)]
    assert errors[0] < 0.01
    assert errors[0] < 0.3 * errors[1]


def test_slopes_are_those_of_the_curve():
    truth, ratios = make("filmic", per_pair=600)
    slopes = np.array(exposure.solve_ratios(ratios, len(truth)).radiometry.response.slopes)
    log_light = np.interp(np.exp(KNOTS), 255 * filmic_curve(LIGHT).astype(float), LIGHT)
    step = 1e-3
    true = (
        2 * step / (grey_of("filmic")(np.log(log_light) + step) - grey_of("filmic")(np.log(log_light) - step))
    )
    seen = (np.exp(KNOTS) > 90) & (np.exp(KNOTS) < 230)  # few patches are brighter
    ratio = slopes[seen] / true[seen]
    np.testing.assert_allclose(ratio / ratio[1], 1.0, atol=0.12)


@pytest.mark.parametrize("name", ["linear", "gamma"])
def test_no_power_of_the_light_is_taken_for_a_curve(name):
    assert not any(exposure.solve_ratios(make(name, seed)[1], 12).radiometry.response for seed in range(20))


def test_srgb_leaves_exposures_to_one_percent_of_a_power():
    truth, ratios = make("srgb")
    estimate = exposure.solve_ratios(ratios, len(truth))
    assert np.std(left_of(estimate.log_exposure, truth)) < 0.01


def test_noise_that_grows_towards_dark_is_no_curve():
    truth, ratios = make("linear", seed=5, sigma=0.002)
    rng = np.random.default_rng(5)
    noise = 1.5 * rng.standard_normal((2, len(ratios.value))) / np.exp(ratios.level)
    noisy = replace(ratios, value=ratios.value + noise[1] - noise[0], level=ratios.level + noise.mean(axis=0))
    assert not exposure.solve_ratios(noisy, len(truth)).radiometry.response


def test_parts_add_up_to_the_whole():
    truth, ratios = make("filmic")
    whole = exposure.edges_of(ratios, len(truth))

    def part(mine):
        return exposure.edges_of(ratios.take(mine), len(truth))

    halves = [part(ratios.first < 5), part(ratios.first >= 5)]
    joint = radiometry.solve(halves[0].known + halves[1].known)
    grey = np.linspace(np.log(60), np.log(240), 20)
    slopes = [each.response.slope(grey) for each in (joint, whole.radiometry)]
    np.testing.assert_allclose(slopes[0] / slopes[1], np.mean(slopes[0] / slopes[1]), rtol=0.1)
    means = np.concatenate([each.supposing(joint) for each in halves])
    np.testing.assert_allclose(means, whole.supposing(joint), atol=0.02)


def test_derivatives_are_differences():
    level, light = np.linspace(3.0, 5.4, 40), np.linspace(-0.1, 0.1, 40)
    expected = response.by_slopes(TRUE, level, light)
    for knot in range(response.SLOPES):
        ends = []
        for sign in (1, -1):
            numbers = TRUE.numbers.copy()
            numbers[knot] += sign * 1e-6
            # the ratio of light at the ratio of grey values that is expected; of grey values it is the opposite
            ends.append(response.of_numbers(numbers).log_ratio(level, light / TRUE.slope(level)))
        np.testing.assert_allclose(expected[:, knot], -(ends[0] - ends[1]) / 2e-6, atol=1e-8)


def test_integrals_are_those_of_the_slopes():
    grey = np.linspace(np.log(5), np.log(255), 4001)
    table = TRUE.log_light(grey)
    np.testing.assert_allclose(np.gradient(table, grey)[1:-1], TRUE.slope(grey)[1:-1], atol=1e-3)
    assert table[-1] == pytest.approx(np.log(255))
    np.testing.assert_allclose(LINEAR.log_light(grey), grey)


def test_grey_values_come_back():
    grey = np.linspace(2, 255, 500).astype(np.float32)
    np.testing.assert_allclose(TRUE.grey(TRUE.light(grey)), grey, atol=1e-2)
    np.testing.assert_allclose(LINEAR.light(grey), grey, atol=1e-3)
    assert not LINEAR
    assert not response.of_numbers(np.zeros(response.SLOPES))
    assert not response.of_numbers(None)


def test_contrast_does_not_look_like_light():
    """A surface at two exposures: the curve of a mean of grey values is not the mean of the light."""
    curve = Response((0.5, 0.6, 0.7, 0.8, 1.0, 1.6, 2.6))
    rng = np.random.default_rng(3)
    contrast = np.exp(0.4 * rng.standard_normal((120, 160, 1)))
    light = np.stack([80 * gain * contrast for gain in (1.0, 1.5)])
    images = np.rint(curve.grey(np.minimum(light, 255).astype(np.float32))).astype(np.uint8)
    linear = radiometry.divided(images, np.ones(images.shape[1:3], np.float32), curve)
    inside = (images < image.SATURATED).all(axis=0)
    ratios = [float(np.log(each[1][inside].mean() / each[0][inside].mean())) for each in (images, linear)]
    of_means = curve.log_ratio(
        np.array([0.5 * np.log(images[0][inside].mean() * images[1][inside].mean())]), np.array([ratios[0]])
    )
    assert abs(of_means[0] - np.log(1.5)) > 5 * abs(ratios[1] - np.log(1.5))


def test_two_curves_are_one():
    gentle = Response((0.9, 0.92, 0.95, 1.0, 1.05, 1.1, 1.15))
    log_grey = np.linspace(np.log(20), np.log(255), 50)
    expected = TRUE.log_light(gentle.log_light(log_grey))
    np.testing.assert_allclose(gentle.then(TRUE).log_light(log_grey), expected, atol=0.03)
    assert TRUE.then(LINEAR).slopes == pytest.approx(TRUE.slopes)
    assert LINEAR.then(TRUE).slopes == pytest.approx(TRUE.slopes)


@pytest.mark.parametrize("slopes", [(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.05), (1.0,) * 6 + (11.0,)])
def test_what_no_camera_has_is_refused(slopes):
    sigma = np.full(response.SLOPES, 0.01)
    assert not response.judged(np.array(slopes) - 1, sigma)
    assert response.judged(TRUE.numbers, sigma)
    assert not response.judged(TRUE.numbers, np.full(response.SLOPES, 0.5))


def test_a_mean_weighs_what_each_part_knows():
    sure, vague = (
        Radiometry(response=replace(curve, sigma=sigma)) for curve, sigma in ((TRUE, 0.001), (LINEAR, 0.1))
    )
    assert radiometry.mean([sure, vague]).response.slopes == pytest.approx(TRUE.slopes, abs=1e-3)
    assert radiometry.mean([radiometry.NONE, radiometry.NONE]) == radiometry.NONE


def test_images_become_proportional_to_the_light():
    greys = np.arange(256, dtype=np.uint8)[None, None, :, None]
    even = radiometry.divided(greys, np.ones((1, 256), np.float32), TRUE).ravel()
    assert even[:4].tolist() == [0, 1, 2, 3]
    assert (even[250:] == 255).all()
    np.testing.assert_allclose(even[10:250], TRUE.light(np.arange(10.0, 250.0)), atol=0.5)


def curved_room():
    """The room through a filmic curve."""
    rec = room_with_screen()
    table = 255 * filmic_curve(np.linspace(0, 1, 256).astype(np.float32) * 0.5)
    return rec, np.rint(table[rec.images]).astype(np.uint8)


def test_the_curve_of_a_room():
    rec, images = curved_room()
    pyramid = image.build_pyramid(images, CAMERA, 2)
    given = (pyramid, rec.cameras, rec.surfaces, None)
    truth = np.log(rec.exposure)
    errors = [np.std(left_of(exposure.solve(*given, raw=raw).log_exposure, truth)) for raw in (CAMERA, None)]
    assert errors[0] < 0.01
    assert errors[0] < 0.5 * errors[1]
