"""Exposures of images between keyframes, by the map that keyframes color."""

from dataclasses import fields, replace

import numpy as np
import pytest
from needed_steps import needed

from lvba import pipeline, plan, simulate
from lvba.blocks.split import SplitConfig
from lvba.io.dataset import open_dataset
from lvba.run_settings import Config
from lvba.steps import between_exposures
from lvba.steps.between_exposures import BetweenKeyframes
from lvba.steps.outcomes import VisualStage
from lvba.visual.result import VisualResult


def stage(log_exposure, sigma, keyframes):
    nothing = dict.fromkeys((each.name for each in fields(VisualResult)), None)
    given = {"log_exposure": log_exposure, "log_exposure_sigma": sigma, "keyframes": keyframes}
    return VisualStage(VisualResult(**nothing | given))


@pytest.fixture
def interpolated():
    """Keyframes 0, 2 and 4, known to 0.001; those between to 0.02, and far off."""
    log_exposure, sigma = np.array([0.0, 0.05, 0.1, 0.15, 0.2]), np.array([0.001, 0.02, 0.001, 0.02, 0.001])
    return stage(log_exposure, sigma, np.array([0, 2, 4]))


def test_what_the_map_says_counts_by_how_far_keyframes_are_off_by_it(interpolated):
    parts = [
        BetweenKeyframes(np.array([1]), np.array([0.3]), np.array([0.003])),
        BetweenKeyframes(np.array([3]), np.array([-0.1]), np.array([0.02])),
    ]
    result = between_exposures.merge(interpolated, parts).result
    first, second = np.hypot(0.003, 0.001), np.hypot(0.02, 0.001)
    expected = [
        (value / by_map**2 + before / 0.02**2) / (1 / by_map**2 + 1 / 0.02**2)
        for value, before, by_map in ((0.3, 0.05, first), (-0.1, 0.15, second))
    ]
    np.testing.assert_allclose(result.log_exposure[[1, 3]], expected)
    np.testing.assert_array_equal(result.log_exposure[[0, 2, 4]], [0.0, 0.1, 0.2])
    assert result.log_exposure_sigma[1] == pytest.approx(1 / np.hypot(1 / first, 1 / 0.02))
    np.testing.assert_array_equal(result.log_exposure_sigma[[0, 2, 4]], 0.001)


def test_where_the_map_tells_nothing_exposures_stay_interpolated(interpolated):
    nothing = BetweenKeyframes(np.zeros(0, int), np.zeros(0), np.zeros(0))
    assert between_exposures.merge(interpolated, [nothing]) is interpolated


def test_keyframes_that_little_is_known_of_are_known_by_the_map_and_by_others_than_themselves():
    """0 to 3 and 5 are keyframes; 3 is far off by few patches, of 5 nothing is known."""
    sigma = np.array([0.001, 0.001, 0.001, 0.2, np.inf, np.inf])
    vague = stage(np.array([0.0, 0.1, 0.1, 0.6, 0.0, 0.0]), sigma, np.array([0, 1, 2, 3, 5]))
    part = BetweenKeyframes(np.array([3, 4, 5]), np.array([0.3, 0.3, 0.3]), np.array([0.003, 0.003, 0.4]))
    result = between_exposures.merge(vague, [part]).result
    np.testing.assert_allclose(result.log_exposure, [0.0, 0.1, 0.1, 0.3, 0.3, 0.3], atol=1e-3)
    known = np.hypot([0.003, 0.003, 0.4], 0.001)
    np.testing.assert_allclose(result.log_exposure_sigma[3:], known, rtol=1e-3)


def test_where_nothing_is_known_of_any_keyframe_exposures_stay():
    unknown = stage(np.zeros(3), np.full(3, np.inf), np.array([0, 2]))
    part = BetweenKeyframes(np.array([1]), np.array([0.3]), np.array([0.003]))
    assert between_exposures.merge(unknown, [part]) is unknown


def test_of_what_nothing_else_is_known_the_map_counts_where_it_tells_more_than_the_line():
    sigma, own = np.array([0.2, 0.2, 0.01, np.inf]), np.array([0.02, np.inf, np.inf, 0.02])
    tells = between_exposures._tells(sigma, own, np.full(4, 0.03))
    assert tells.tolist() == [True, False, True, False]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A short street with an image every 20 cm, of which half are keyframes."""
    folder = tmp_path_factory.mktemp("between") / "street"
    sizes = {"width": 320, "height": 240, "points_per_scan": 6000}
    simulate.simulate("street", folder, frames=40, scans=40, length=10.0, seed=5, **sizes)
    return folder


@pytest.mark.parametrize("split", [{"by": "none"}, {"by": "count", "size": 20}], ids=["one", "parts"])
def test_in_a_run_they_are_better_than_interpolated_ones_and_as_good_as_promised(street, split):
    steps = pipeline.refine(open_dataset(street), replace(Config(), split=SplitConfig(**split)))
    results = plan.run(needed(steps, "fused-cameras", "exposures"), {})
    named = {step.name: results[key] for key, step in steps.steps.items() if key in results}
    before, after = (named[name].result for name in ("fused-cameras", "exposures"))
    exposure = np.loadtxt(street / "reference" / "exposures.csv", delimiter=",", skiprows=1)[:, 1]
    off = [each.log_exposure - np.log(exposure / exposure[0]) for each in (before, after)]
    between = np.setdiff1d(np.arange(40), before.keyframes)
    assert len(between) > 10
    interpolated, by_map = (float(np.sqrt(np.mean(each[between] ** 2))) for each in off)
    assert by_map < 0.5 * interpolated
    assert np.mean((off[1][between] / after.log_exposure_sigma[between]) ** 2) < 4.0
    np.testing.assert_allclose(off[1][before.keyframes], off[0][before.keyframes], atol=1e-12)
