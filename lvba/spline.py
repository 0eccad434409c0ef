"""Poses between the samples of a trajectory, and how far these may be off."""

import numpy as np
from scipy.interpolate import CubicSpline

from lvba import geometry, trajectory
from lvba.arrays import Times
from lvba.trajectory import Trajectory

FEWEST_SAMPLES = 5
"""Of a trajectory, for anything here."""


def through(samples: Trajectory, times: Times, beyond: float = 0.0) -> np.ndarray:
    """Poses (Q, 4, 4) at times (Q,) by twice differentiable cubic splines; beyond the ends, those there.

    beyond: s, for which the splines are followed past the ends

    Rotations by splines of the quaternions' components: a spline that does not accelerate at its ends (as of rotation
    vectors, `scipy.spatial.transform.RotationSpline`) is off there by a hundred times as much as between.
    """
    clamped = np.clip(times, samples.times[0] - beyond, samples.times[-1] + beyond)
    turn = geometry.quaternion(samples.world_from_sensor)
    opposite = np.cumsum((turn[1:] * turn[:-1]).sum(1) < 0) % 2 == 1
    turn[1:][opposite] *= -1.0
    position = samples.world_from_sensor[:, :3, 3]
    components = CubicSpline(samples.times, np.concatenate([turn, position], axis=1))(clamped)
    turn = components[:, :4] / np.linalg.norm(components[:, :4], axis=1, keepdims=True)
    return geometry.from_quaternion_translation(turn, components[:, 4:])


def boundary_error(samples: Trajectory, times: Times) -> np.ndarray:
    """(Q,): least error of the splines near their ends, as a fraction of the `leave_one_out_error`.

    A quarter between the first two samples and between the last two: there they are the cubic through four samples on one
    side. By 2 - sqrt(3) less from one interval to the next: so falls the influence of a sample on a cubic spline.
    """
    before, _ = trajectory.bracket(samples.times, times)
    return np.asarray(0.25 * (2 - np.sqrt(3.0)) ** np.minimum(before, len(samples) - 2 - before))


def past_ends(samples: Trajectory, times: Times) -> np.ndarray:
    """(Q,): how far times (Q,) are before the first sample or after the last, over the time from there to the next; 0
    within."""
    first, last = samples.times[1] - samples.times[0], samples.times[-1] - samples.times[-2]
    before, after = (samples.times[0] - times) / first, (times - samples.times[-1]) / last
    return np.asarray(np.maximum(np.maximum(before, after), 0.0))


def extrapolation_error(past: np.ndarray) -> np.ndarray:
    """(Q,): how far splines that are followed past their ends are off, as a fraction of the `leave_one_out_error`.

    There they are nearly the cubic through the last four samples.
    past: (Q,) float64, as of `past_ends`
    """
    return np.asarray(np.sqrt(3.0) * past * (past + 1) * (past + 2) * (past + 3) / 4)


def leave_one_out_error(samples: Trajectory, times: Times) -> np.ndarray:
    """(Q, 2): error (rad, m) of a sample at each time that is predicted from its neighbors.

    From the samples around that time, each predicted from two neighbors on either side. The interpolation error is a
    fraction of it: largest half way between samples, where it is given in full, and zero at a sample. In an interval much
    longer than those beside it, where the samples about it tell little, as much more as the cubic may be off there.
    """
    each = _leave_one_out(samples)
    before, fraction = trajectory.bracket(samples.times, times)
    around = np.maximum(each[before], each[np.minimum(before + 1, len(samples) - 1)])
    around *= _in_gaps(samples.times)[np.minimum(before, len(samples) - 2), None]
    inside = ~outside(samples, times)
    around *= np.where(inside, 4 * fraction * (1 - fraction), 1.0)[:, None]
    return np.asarray(around)


def leave_one_out_error_by_axis(samples: Trajectory, times: Times) -> np.ndarray:
    """(Q, 6): `leave_one_out_error` along each axis of the sensor, `[rotation | translation]`, rad and m.

    How large it is, the samples about each time tell; how it is shared among the axes, many more before and after: who
    walks sways about one axis much more than about the others, and does so all the way.
    """
    return np.asarray(
        np.repeat(leave_one_out_error(samples, times), 3, axis=1) * _axis_fractions(samples, times)
    )


_WAY = 12
"""Samples before and after a time that tell how errors are shared among the axes."""
_LEAST_FRACTION = 0.1


def _axis_fractions(samples: Trajectory, times: np.ndarray) -> np.ndarray:
    """(Q, 6): sizes of errors along each axis, over that of the mean axis: their squares are 1 on average."""
    off = _off(samples).reshape(-1, 2, 3)
    square = np.square(off / np.maximum(np.linalg.norm(off, axis=2, keepdims=True), 1e-12)).reshape(-1, 6)
    summed = np.concatenate([np.zeros((1, 6)), np.cumsum(square, axis=0)])
    middle = np.searchsorted(samples.times[2:-2], times)
    first = np.clip(middle - _WAY, 0, max(len(off) - 2 * _WAY, 0))
    last = np.minimum(first + 2 * _WAY, len(off))
    fraction = np.sqrt(3 * (summed[last] - summed[first]) / (last - first)[:, None])
    return np.asarray(np.maximum(fraction, _LEAST_FRACTION))


def leave_one_out_rates(samples: Trajectory, times: Times, floor: np.ndarray) -> np.ndarray:
    """(Q, 2): what rates by the splines differ by where samples are left out, rad/s and m/s, of one component.

    At times (Q,) what samples about them differ by from the cubic through their neighbors, over the time between them.
    floor: (2,) float64, rad and m, by which samples differ at least
    """
    each = np.maximum(_leave_one_out(samples), floor)
    before, _ = trajectory.bracket(samples.times, times)
    after = np.minimum(before + 1, len(samples) - 1)
    first = np.minimum(before, len(samples) - 2)
    left_out = np.maximum(each[before], each[after]) * _in_gaps(samples.times)[first, None]
    return np.asarray(left_out / np.diff(samples.times)[first, None])


def unknown(samples: Trajectory, times: Times) -> np.ndarray:
    """(Q,) bool: times (Q,) before the first sample, after the last, or in a gap so long that splines tell nothing."""
    before, _ = trajectory.bracket(samples.times, times)
    lost = _in_gaps(samples.times)[np.minimum(before, len(samples) - 2)] > _LOST
    return np.asarray(lost | outside(samples, times))


def outside(samples: Trajectory, times: np.ndarray) -> np.ndarray:
    """Which times (Q,) are before the first sample or after the last, (Q,) bool."""
    return np.asarray((times < samples.times[0]) | (times > samples.times[-1]))


def _leave_one_out(samples: Trajectory) -> np.ndarray:
    """(N, 2): by how much (rad, m) each pose differs from the cubic through its two neighbors on either side."""
    off = _off(samples)
    size = np.stack([np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)], axis=1)
    # of the two at each end nothing tells: they are as bad as the worse of the nearest two that are known
    each = np.pad(size, ((2, 2), (0, 0)), mode="maximum", stat_length=2)
    return np.asarray(each / np.sqrt(3.0))


_USUAL = 9 / 64
"""Error of the cubic half way between samples at equal intervals, over that of leaving one of them out."""
_GAP = 2.0
"""Times the usual that the first is larger where an interval is a gap; stamps that jitter make less of it."""
_LOST = 10.0
"""Times the usual from which on a spline across a gap tells nothing: five intervals."""


def _in_gaps(times: Times) -> np.ndarray:
    """(N - 1,): times that the error between two samples (N,), over that of leaving one of them out, is larger than at
    equal intervals, in gaps; 1 elsewhere.

    The remainder of a cubic through four samples (Lagrange) grows with the product of the times to these: by ten in a gap
    of five intervals, by a hundred in one of twenty. Leaving out a sample beside it tells of the near side only.
    """
    count = len(times)
    first = np.clip(np.arange(-1, count - 2), 0, count - 4)
    used = times[first[:, None] + np.arange(4)]
    middle = (times[:-1] + times[1:]) / 2
    halfway = np.abs(np.prod(middle[:, None] - used, axis=1))
    inner = np.arange(2, count - 2)
    left_out = np.abs(np.prod(times[inner, None] - times[inner[:, None] + [-2, -1, 1, 2]], axis=1))
    left_out = np.pad(left_out, 2, mode="edge")
    more = halfway / (_USUAL * np.maximum(left_out[:-1], left_out[1:]))
    return np.asarray(np.where(more > _GAP, more, 1.0))


def _off(samples: Trajectory) -> np.ndarray:
    """(N - 4, 6): of all but two poses at either end, the cubic through their two neighbors on either side, in their
    tangents."""
    count = len(samples)
    index = np.arange(2, count - 2)[:, None] + [-2, -1, 1, 2]
    middle = geometry.inverse(samples.world_from_sensor[2:-2])
    around = geometry.log(middle[:, None] @ samples.world_from_sensor[index])
    weight = _cubic_weights(samples.times[index] - samples.times[2:-2, None])
    return np.asarray(np.einsum("sa,saj->sj", weight, around))


def _cubic_weights(offset: np.ndarray) -> np.ndarray:
    """(Q, 4): of four samples, by their times (Q, 4) from where the cubic through them is wanted (Lagrange)."""
    weight = np.ones(offset.shape)
    for a in range(4):
        for b in range(4):
            if a != b:
                weight[:, a] *= offset[:, b] / (offset[:, b] - offset[:, a])
    return weight
