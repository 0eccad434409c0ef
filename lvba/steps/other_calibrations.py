"""What images would say of scans were the cameras calibrated otherwise, by as much as a calibration may be off.

Scans are judged before the cameras are refined. A camera that is a degree or some hundredths of a second off sees a sharp
map in the wrong place, and may predict images better by a blurred one. So where images speak against scans, they are
asked again with other extrinsics and clocks, the same for both states; how far the gain differs is an error of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Times
from lvba.products.evaluate import Scores
from lvba.products.views import Views
from lvba.steps import acceptance
from lvba.steps.acceptance import Figure, GateConfig
from lvba.trajectory import Trajectory, sample
from lvba.visual.prior_config import PriorConfig

_SIGNS = np.array(
    [[1, 1, 1, 1, 1, 1, 1], [-1, -1, 1, 1, -1, -1, 1], [-1, 1, -1, 1, -1, 1, -1], [1, -1, -1, 1, 1, -1, -1]]
)
"""Of rotation, translation and clock in each calibration: no two of them alike in more than chance (Hadamard)."""
COUNT = len(_SIGNS)


def name(state: str, number: int) -> str:
    """Of a state with one of the other calibrations."""
    return f"{state}, calibration {number}"


def views(as_given: Views, number: int, prior: PriorConfig) -> Views:
    """The views with the cameras where one of the other calibrations has them."""
    known = prior.sigma
    sigma = np.concatenate([np.atleast_1d(known["scan_from_camera"]), np.atleast_1d(known["time_offset"])])
    off = _SIGNS[number] * sigma
    poses = _moved(as_given.world_from_camera, as_given.times, off[:6], float(off[6]))
    return replace(as_given, world_from_camera=poses)


def _moved(world_from_camera: Poses, times: Times, tangent: np.ndarray, later: float) -> np.ndarray:
    """(I, 4, 4): cameras `later` s on along their path, moved on it by a tangent (6,) `[rotation | translation]`, rad and
    m."""
    path = Trajectory(times, world_from_camera)
    return geometry.retract(sample(path, times + later), np.tile(tangent, (len(times), 1)))


def counted(
    figures: tuple[Figure, ...], scores: Mapping[str, Scores], states: tuple[str, str], config: GateConfig
) -> tuple[Figure, ...]:
    """The figures with what their gains depend on the calibration in their errors; as they are where nobody asked.

    scores: of the states before and after, and of these with the other calibrations
    """
    asked = [number for number in range(COUNT) if name(states[1], number) in scores]
    if not asked:
        return figures
    result = []
    for figure in figures:
        changes = [_change(figure.name, scores, states, number) for number in asked]
        spread = float(np.sqrt(np.mean(np.square(changes))))
        result.append(acceptance.with_calibration(figure, spread if np.isfinite(spread) else 0.0, config))
    return tuple(result)


def _change(figure: str, scores: Mapping[str, Scores], states: tuple[str, str], number: int) -> float:
    """By what the mean gain differs with another calibration, over the images that were asked with it."""
    before, after = (scores[name(state, number)] for state in states)
    rows = np.searchsorted(scores[states[0]].images, after.images)
    given = (scores[states[1]].per_image[figure] - scores[states[0]].per_image[figure])[rows]
    return float(np.nanmean(after.per_image[figure] - before.per_image[figure] - given))
