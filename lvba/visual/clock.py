"""The camera's clock beside that of the LiDAR, where parts of a recording are put together.

Each part counts the rate of the clock from the middle of its own images, and its time offset is of that moment.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lvba.arrays import Times
from lvba.optim.shared_parameters import weighted_mean
from lvba.visual.calibration_prior import Evidence
from lvba.visual.fixed_calibration import beyond_chance
from lvba.visual.result import VisualResult
from lvba.visual.states import Calibration

_FEWEST = 3
"""Parts whose offsets can lie off a line."""


def common_calibration(results: Sequence[VisualResult], epoch: float) -> Calibration:
    """The mean of the parts' calibrations, each number weighed by what its part knows of it.

    epoch: s, the stamp that the mean's clock rate counts from
    """
    calibrations, sigmas = [result.calibration for result in results], [r.calibration_sigma for r in results]
    if any(each.clock_rate for each in calibrations):
        moved = [_at_epoch(result, epoch) for result in results]
        calibrations, sigmas = [each for each, _ in moved], [sigma for _, sigma in moved]
    return weighted_mean(calibrations[0], calibrations, sigmas)


def _at_epoch(result: VisualResult, epoch: float) -> tuple[Calibration, np.ndarray]:
    """A part's calibration with the time offset of another epoch, and standard deviations (k,) that go with it."""
    calibration, sigma, layout = result.calibration, result.calibration_sigma.copy(), Calibration.layout()
    later = epoch - result.clock_epoch
    offset, rate = layout["time_offset"].start, layout["clock_rate"].start
    sigma[offset] = np.hypot(sigma[offset], later * sigma[rate])
    return replace(calibration, time_offset=calibration.time_offset + later * calibration.clock_rate), sigma


def evidence_from(evidence: Evidence, later: float) -> Evidence:
    """Evidence by a calibration whose clock rate counts from an epoch that is later by so many s."""
    layout = Calibration.layout()
    here_by_there = np.eye(layout.size)
    here_by_there[layout["time_offset"], layout["clock_rate"]] = -later
    parts = evidence.information, evidence.spread
    information, spread = (here_by_there.T @ each @ here_by_there for each in parts)
    return Evidence(information, spread, here_by_there.T @ evidence.pull)


def clock_drifts(results: Sequence[VisualResult]) -> bool:
    """Whether the time offsets of parts change along the recording by more than chance and their own scatter."""
    if len(results) < _FEWEST:
        return False
    offset = Calibration.layout()["time_offset"].start
    rate, sigma = slope(
        np.array([result.clock_epoch for result in results]),
        np.array([result.calibration.time_offset for result in results]),
        np.array([result.calibration_sigma[offset] for result in results]),
    )
    return beyond_chance(rate, sigma)


def slope(times: Times, values: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """Of a line through values at times, and its standard deviation, by that of the values or by their scatter about the
    line where this is larger.

    times: (n,) s; values: (n,) float64, s; sigma: (n,) float64, s
    """
    weight = 1 / np.square(sigma)
    since = times - np.average(times, weights=weight)
    above = values - np.average(values, weights=weight)
    known = float((weight * since**2).sum())
    rise = float((weight * since * above).sum()) / known
    scatter = float((weight * np.square(above - rise * since)).sum()) / (len(times) - 2)
    return rise, float(np.sqrt(max(scatter, 1.0) / known))
