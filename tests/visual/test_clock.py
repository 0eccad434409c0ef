"""A rate of the camera's clock: found where images call for it, and put together from parts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import textured_planes
import textured_room
from textured_room import MOUNT

from lvba import trajectory
from lvba.trajectory import Trajectory
from lvba.visual import clock, refine
from lvba.visual.calibration_prior import Evidence
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration

LAYOUT = Calibration.layout()
OFFSET, RATE = LAYOUT["time_offset"].start, LAYOUT["clock_rate"].start
RATE_S = 0.06
"""Much, for the walk is short and slow: 3 cm at its ends."""
CONFIG = refine.VisualConfig(prior=PriorConfig(time_offset_s=1.0))


@pytest.fixture(scope="module")
def room():
    return textured_room.make()


def stamped(problem, rate):
    """The same images with stamps of a clock that loses, and rough poses by these."""
    taken = problem["images"].times
    middle = (taken[0] + taken[-1]) / 2
    stamps = middle + (taken - middle) / (1 + rate)
    where = trajectory.sample(Trajectory(problem["scans"].times, problem["refined_scans"]), stamps)
    rough = textured_planes.disturbed(where @ MOUNT, 0.006, 0.15, seed=3)
    return problem | {"images": Trajectory(stamps, rough)}


def test_a_rate_is_found_where_images_call_for_it(room):
    problem, truth, _ = room
    found = refine.refine(refine.Inputs(**stamped(problem, RATE_S)), CONFIG)
    spread = found.calibration_sigma[RATE]
    assert 0 < spread < 0.005
    assert found.calibration.clock_rate == pytest.approx(RATE_S, abs=4 * spread)
    assert trajectory.pose_error(found.world_from_camera, truth, aligned=np.eye(4)).ate_m < 0.002
    assert found.moments(found.clock_epoch + np.arange(2.0)) == pytest.approx(
        found.clock_epoch + found.calibration.time_offset + np.array([0, 1 + found.calibration.clock_rate])
    )


def test_a_clock_that_is_known_does_not_drift(room):
    problem = room[0]
    known = replace(CONFIG, prior=PriorConfig(time_offset_s=1e-5))
    found = refine.refine(refine.Inputs(**stamped(problem, RATE_S)), known)
    assert found.calibration.clock_rate == 0.0


def result(epoch, offset, rate=0.0, sigma=1e-4, rate_sigma=1e-5):
    """A part's result as far as its clock goes."""
    sigmas = np.ones(LAYOUT.size)
    sigmas[OFFSET], sigmas[RATE] = sigma, rate_sigma
    calibration = Calibration(np.eye(4), time_offset=offset, clock_rate=rate)
    return SimpleNamespace(clock_epoch=epoch, calibration=calibration, calibration_sigma=sigmas)


def test_parts_of_one_clock_agree_at_any_epoch():
    parts = [result(epoch, 0.01 + 2e-3 * epoch, 2e-3) for epoch in (-20.0, 0.0, 30.0)]
    mean = clock.common_calibration(parts, 10.0)
    assert mean.time_offset == pytest.approx(0.03)
    assert mean.clock_rate == pytest.approx(2e-3)


def test_a_part_far_away_tells_little_of_the_offset():
    near, far = result(0.0, 0.010, 1e-9), result(100.0, 0.020, 1e-9)
    assert clock.common_calibration([near, far], 0.0).time_offset == pytest.approx(0.01, abs=2e-4)


def test_parts_without_a_rate_are_averaged_as_they_are():
    parts = [result(epoch, offset) for epoch, offset in ((0.0, 0.01), (50.0, 0.03))]
    assert clock.common_calibration(parts, 25.0).time_offset == pytest.approx(0.02)


def test_evidence_is_that_of_the_same_clock():
    """What a part tells of its own offset and rate, as a cost, is the same cost of offset and rate from elsewhere."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(LAYOUT.size, LAYOUT.size))
    evidence, later = Evidence(root @ root.T, 2 * root @ root.T, rng.normal(size=LAYOUT.size)), 7.0
    moved = clock.evidence_from(evidence, later)
    there = rng.normal(size=LAYOUT.size)
    here = there.copy()
    here[OFFSET] -= later * there[RATE]
    assert there @ moved.information @ there == pytest.approx(here @ evidence.information @ here)
    assert there @ moved.spread @ there == pytest.approx(here @ evidence.spread @ here)
    assert there @ moved.pull == pytest.approx(here @ evidence.pull)
    assert (clock.evidence_from(evidence, 0.0).information == evidence.information).all()


@pytest.mark.parametrize(
    ("slope", "scatter", "count", "drifts"),
    [(2e-4, 0.0, 5, True), (0.0, 0.0, 5, False), (2e-4, 0.0, 2, False), (2e-4, 0.005, 5, False)],
    ids=["a line", "none", "two parts", "scattered"],
)
def test_offsets_of_parts_show_a_drift(slope, scatter, count, drifts):
    epochs = 20.0 * np.arange(count)
    noise = scatter * np.array([1, -1, 1, -1, 1])[:count]
    parts = [result(e, slope * e + n, sigma=5e-4) for e, n in zip(epochs, noise, strict=True)]
    assert clock.clock_drifts(parts) == drifts


def test_the_slope_is_that_of_a_plain_fit():
    rng = np.random.default_rng(1)
    times, values, sigma = rng.uniform(0, 100, 20), rng.normal(size=20), rng.uniform(0.5, 2, 20)
    (wanted, _), covariance = np.polyfit(times, values, 1, w=1 / sigma, cov="unscaled")
    found, spread = clock.slope(times, values, sigma)
    assert found == pytest.approx(wanted)
    residual = (values - np.polyval(np.polyfit(times, values, 1, w=1 / sigma), times)) / sigma
    assert spread == pytest.approx(np.sqrt(covariance[0, 0] * max(1.0, (residual**2).sum() / 18)))
