"""The readings of an IMU between scans as one motion each. Source: Forster et al. 2017."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Times
from lvba.inertial.readings import MOST_APART_S, ImuReadings
from lvba.kernels import preintegration as kernel
from lvba.kernels.preintegration import ImuMotions, ImuNoise, ImuSteps

CONSUMER = ImuNoise(gyroscope=3e-4, accelerometer=3e-3)
"""About twice what the data sheets of MEMS as in LiDARs and cameras say (BMI088: 2.4e-4 and 1.7e-3 to 2.3e-3)."""
_SCALE = 0.005
"""Part of a turn, and of a change of velocity, by which the scales of a MEMS and the angles of its axes are off."""
_SLOW_FORCE = 0.01
"""m/s^2: how much the bias of an accelerometer differs from its mean, by tilt (scale and axes) and warmth."""


_EITHER_WAY_S = 2e-3
"""How far intervals are moved to see how their motions change with the offset of the clocks."""


@dataclass(frozen=True)
class Preintegration:
    """Motions between scans that follow each other and have readings all the way.

    first: (K,) int64, the earlier scan of each; the later one is the next
    seconds: (K,) float64, s; motions: of the IMU, see `kernels.preintegration`; bias: (6,), which they are without
    offset: s, time of the IMU less that of the scans; by_offset: (K, 9), of the motions, per second more of it
    """

    first: np.ndarray
    seconds: np.ndarray
    motions: ImuMotions
    bias: np.ndarray
    offset: float
    by_offset: np.ndarray

    def __len__(self) -> int:
        return len(self.first)


def preintegrate(
    readings: ImuReadings, times: Times, bias: np.ndarray, offset: float = 0.0, noise: ImuNoise = CONSUMER
) -> Preintegration:
    """The motions between moments (S,) s, of readings that are linear in between; without biases (6,), rad/s and m/s^2.

    offset: s, which the clock of the readings is ahead; noise: densities of the white noise
    bias: (6,) float64
    """
    before, here, after = (times + offset + way for way in (-_EITHER_WAY_S, 0.0, _EITHER_WAY_S))
    first = np.flatnonzero(_covered(readings.times, before) & _covered(readings.times, after))
    low, motions, high = (
        _motions(readings, moments, first, np.asarray(bias, float), noise)
        for moments in (before, here, after)
    )
    turn = geometry.from_rotation_translation(np.swapaxes(low.rotation, -1, -2) @ high.rotation, np.zeros(3))
    change = [geometry.log(turn)[:, :3], high.velocity - low.velocity, high.position - low.position]
    return Preintegration(
        first=first,
        seconds=np.diff(times)[first],
        motions=motions,
        bias=np.asarray(bias, float),
        offset=offset,
        by_offset=np.concatenate(change, axis=1) / (2 * _EITHER_WAY_S),
    )


def _motions(
    readings: ImuReadings, times: np.ndarray, first: np.ndarray, bias: np.ndarray, noise: ImuNoise
) -> ImuMotions:
    """Those of the intervals that begin with the moments `first` of all."""
    inside = (readings.times > times[0]) & (readings.times < times[-1])
    moments = np.union1d(readings.times[inside], times)
    values = np.concatenate([readings.rates, readings.forces], axis=1)
    at = np.stack([np.interp(moments, readings.times, column) for column in values.T], axis=1)
    middle = 0.5 * (at[1:] + at[:-1])
    place = np.searchsorted(moments, times)
    begins, ends = place[first], place[first + 1]
    # intervals without readings are left out, so that what is handed on lies one after another
    steps_of = [np.arange(begin, end) for begin, end in zip(begins, ends, strict=True)]
    taken = np.concatenate([np.zeros(0, np.int64), *steps_of])
    steps = ImuSteps(
        seconds=np.diff(moments)[taken],
        rate=np.ascontiguousarray(middle[taken, :3]),
        force=np.ascontiguousarray(middle[taken, 3:]),
    )
    starts = np.concatenate([[0], np.cumsum(ends - begins)]).astype(np.int64)
    return kernel.preintegrate(steps, starts, bias, noise)


def _covered(readings: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(S - 1,) bool: the intervals between moments (S,) in which no two readings are too far apart."""
    if len(readings) < 2:
        return np.zeros(len(times) - 1, bool)
    gaps = np.flatnonzero(np.diff(readings) > MOST_APART_S)
    gap_begin = np.concatenate([[-np.inf], readings[gaps], [readings[-1]]])
    gap_end = np.concatenate([[readings[0]], readings[gaps + 1], [np.inf]])
    # the first gap that ends after the start of the interval
    at = np.searchsorted(gap_end, times[:-1], side="right")
    return np.asarray(gap_begin[np.minimum(at, len(gap_begin) - 1)] >= times[1:])


def covariance(measured: Preintegration) -> np.ndarray:
    """(K, 9, 9), of [rotation | velocity | position]: noise, and what a MEMS is off beyond a constant bias."""
    seconds, motions = measured.seconds, measured.motions
    trace = np.trace(motions.rotation, axis1=1, axis2=2)
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    total = motions.covariance.copy()
    slow = np.zeros((len(seconds), 3, 3))
    slow[:, 0, 0] = np.square(_SCALE * angle)
    slow[:, 1, 1] = np.square(_SLOW_FORCE * seconds)
    slow[:, 1, 2] = slow[:, 2, 1] = 0.5 * _SLOW_FORCE**2 * seconds**3
    slow[:, 2, 2] = 0.25 * _SLOW_FORCE**2 * seconds**4
    return np.asarray(total + np.einsum("kab,xy->kaxby", slow, np.eye(3)).reshape(-1, 9, 9))
