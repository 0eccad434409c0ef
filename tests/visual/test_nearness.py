"""What nearer views of a surface seem brighter by: found, taken out of ratios, and not found where there is none."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from lvba.visual import exposure, nearness, radiometry, vignetting
from lvba.visual.exposure_graph import BLOCKS
from lvba.visual.nearness import NONE, Nearness
from lvba.visual.radiometry import Radiometry
from lvba.visual.ratios import Ratios
from lvba.visual.vignetting import PairPlaces, Vignetting

TRUE = -0.0015
STRETCH = 40


def drive(seed=0, by_nearness=TRUE, falloff=vignetting.NONE, per_pair=150, sigma=0.01):
    """Log ratios of patches along a path that looks ahead, and the exposures of its images.

    Patches come nearer by a tenth to a half from one image to the next, and move outward as they do.
    """
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-0.3, 0.3, STRETCH)
    first = np.repeat(np.arange(STRETCH - 2), 2 * per_pair)
    steps = 1 + np.tile(np.repeat([0, 1], per_pair), STRETCH - 2)
    nearer = steps * rng.uniform(0.1, 0.5, len(first))
    reference = rng.uniform(-0.4, 0.4, (len(first), 2))
    target = reference * np.exp(nearer)[:, None]
    bias = by_nearness * nearer + falloff.log_light(target) - falloff.log_light(reference)
    value = truth[first + steps] - truth[first] + bias + sigma * rng.standard_normal(len(first))
    block = rng.integers(0, BLOCKS, len(first))
    ratios = Ratios(
        first=first.astype(np.int32),
        second=(first + steps).astype(np.int32),
        value=value,
        sigma=np.full(len(first), 1.5 * sigma),
        block=block,
        stretch=block,
        level=rng.uniform(np.log(60), np.log(160), len(first)),
        patch=np.arange(len(first)),
        places=PairPlaces(reference, target),
        nearer=nearer,
    )
    return truth, ratios


def off(exposures, truth):
    """Root mean square of the errors of log exposures about their mean, and what is promised."""
    error = exposures.log_exposure - truth
    return np.std(error), np.sqrt(np.mean(exposures.sigma**2))


def test_it_does_not_add_up_along_a_path():
    truth, ratios = drive(sigma=0.003)
    found = exposure.solve_ratios(ratios, STRETCH)
    assert found.radiometry.nearness.value == pytest.approx(TRUE, abs=6e-4)
    error, promised = off(found, truth)
    blind, _ = off(exposure.solve_ratios(replace(ratios, nearer=None), STRETCH), truth)
    assert blind > 0.004
    assert error < 0.4 * blind
    assert error < 2 * promised


def test_none_is_found_where_there_is_none():
    assert not any(
        exposure.solve_ratios(drive(seed, by_nearness=0.0, per_pair=60)[1], STRETCH).radiometry.nearness
        for seed in range(30)
    )


def test_vignetting_is_not_taken_for_it():
    """What moves outward gets darker."""
    lens = Vignetting((-0.3, -0.1, 0.0))
    truth, ratios = drive(by_nearness=0.0, falloff=lens)
    found = exposure.solve_ratios(ratios, STRETCH)
    assert found.radiometry.vignetting.corner_loss == pytest.approx(lens.corner_loss, abs=0.03)
    assert not found.radiometry.nearness
    error, promised = off(found, truth)
    assert error < 3 * promised


def test_what_is_too_uncertain_to_be_taken_out_is_promised():
    truth, ratios = drive(by_nearness=TRUE, per_pair=8, sigma=0.02)
    found = exposure.solve_ratios(ratios, STRETCH)
    assert not found.radiometry.nearness
    error, promised = off(found, truth)
    _, blind = off(exposure.solve_ratios(replace(ratios, nearer=None), STRETCH), truth)
    assert promised > blind
    assert error < 2 * promised


def test_patches_that_come_nearer_alike_tell_nothing():
    """However well they agree: as those of a camera that looks sideways."""
    _, ratios = drive()
    found = exposure.solve_ratios(replace(ratios, nearer=1e-6 * ratios.nearer), STRETCH)
    assert found.radiometry.nearness == Nearness(0.0, nearness.PRIOR_SIGMA)


def test_what_contrast_does_not_make_is_refused():
    assert not nearness.judged(-0.02, 1e-4)
    assert not nearness.judged(-0.0004, 1e-6)
    assert not nearness.judged(-0.002, 5e-4)
    assert not nearness.judged(0.002, 1e-4)
    assert nearness.judged(-0.002, 1e-4).value == -0.002


def test_a_mean_weighs_what_each_part_knows():
    sure, vague = Radiometry(nearness=Nearness(TRUE, 1e-4)), Radiometry(nearness=Nearness(0.0, 1e-2))
    assert radiometry.mean([sure, vague]).nearness.value == pytest.approx(TRUE, rel=1e-3)
    assert radiometry.mean([radiometry.NONE, radiometry.NONE]).nearness == NONE


def test_images_are_not_changed_by_it():
    assert not Radiometry(nearness=Nearness(TRUE, 1e-4))


def test_nearer_views_of_contrast_are_darker_where_grey_is_a_power_of_the_light():
    """And not where it is the light: what one pixel sees from afar are four of a nearer view."""
    light = np.exp(0.3 * np.random.default_rng(1).standard_normal((64, 64)))
    far = light.reshape(32, 2, 32, 2).mean(axis=(1, 3))
    assert np.log((light ** (1 / 2.2)).mean() / (far ** (1 / 2.2)).mean()) < -0.005
    assert np.log(light.mean() / far.mean()) == pytest.approx(0.0, abs=1e-12)


def test_how_much_nearer():
    found = nearness.log_nearer(np.array([4.0, 3.0, 0.0]), np.array([2.0, 3.0, 1.0]))
    np.testing.assert_allclose(found[:2], [np.log(2), 0.0])
    assert np.isfinite(found).all()


def test_ratios_of_some_images_keep_all_that_is_known_of_them():
    _, ratios = drive(per_pair=5)
    kept = np.arange(STRETCH) % 3 == 0
    mine, some = kept[ratios.first], ratios.of_images(kept)
    for name in ("first", "second", "value", "sigma", "block", "stretch", "level", "patch", "nearer"):
        np.testing.assert_array_equal(getattr(some, name), getattr(ratios, name)[mine])
    np.testing.assert_array_equal(some.places.target, ratios.places.target[mine])
    assert {each.name for each in dataclasses.fields(Ratios)} == {
        "first", "second", "value", "sigma", "block", "stretch", "level", "patch", "nearer", "places", "curve",
    }  # fmt: skip
