"""Readings of an IMU, in SI units."""

from dataclasses import dataclass, field, replace

import numpy as np

GRAVITY = 9.81
"""m/s^2; on Earth 9.78 to 9.83."""
_NEAR = 0.2
"""Part that the median force may be off gravity: much of a recording is no free fall and no launch."""
MOST_APART_S = 0.05
"""Between two readings; what happened in a longer gap is not known."""


@dataclass(frozen=True)
class ImuReadings:
    """Readings in the order of their times.

    times: (N,) float64, s, strictly ascending, on the clock of the scans
    rates: (N, 3) float64, rad/s; forces: (N, 3) float64, what the accelerometer feels: m/s^2; both in the IMU's axes
    """

    times: np.ndarray
    rates: np.ndarray
    forces: np.ndarray

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True)
class Imu:
    """An IMU that was recorded with scans.

    readings: as the driver has them; scan_times: (S,) float64, s, stamps of the scans, on the same clock
    scan_from_imu: (4, 4) float64, m, its extrinsic as far as known
    """

    readings: ImuReadings
    scan_times: np.ndarray
    scan_from_imu: np.ndarray = field(default_factory=lambda: np.eye(4))


def ordered(times: np.ndarray, rates: np.ndarray, forces: np.ndarray) -> ImuReadings:
    """Readings of any order by their times; without those that are not finite, and of equal times all but the first.

    times: (N,) float64, s; rates, forces: (N, 3) float64
    """
    finite = np.isfinite(times) & np.isfinite(rates).all(1) & np.isfinite(forces).all(1)
    keep = np.flatnonzero(finite)
    keep = keep[np.argsort(times[keep], kind="stable")]
    keep = keep[np.diff(times[keep], prepend=-np.inf) > 0]
    return ImuReadings(times[keep], rates[keep], forces[keep])


def in_si_units(readings: ImuReadings) -> ImuReadings | None:
    """The readings with forces in m/s^2, of drivers that give them so or in g; None: their size is that of neither."""
    if not len(readings):
        return None
    norm = float(np.median(np.linalg.norm(readings.forces, axis=1)))
    for unit in (1.0, GRAVITY):
        if abs(norm * unit / GRAVITY - 1.0) < _NEAR:
            return replace(readings, forces=readings.forces * unit)
    return None
