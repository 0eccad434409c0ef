"""Points without a usable position are dropped where files are read, so that nobody else has to look."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from lvba.dataset import Scan
from lvba.errors import InputError

logger = logging.getLogger(__name__)

MAX_COORDINATE = 1e5
"""m; a coordinate beyond it is no measurement (no LiDAR reaches 100 km) and would drown all others in float32."""
NO_RETURN = 1e-3
"""m; a point whose coordinates are all less is no measurement: drivers write zeros where a beam did not come back."""


def keep(path: str | Path, points: np.ndarray, intensity: np.ndarray | None, time: np.ndarray | None) -> Scan:
    """The scan of the points that have a finite position, and not that of the origin.

    points: (N, 3) float32, m; intensity: (N,) float32 or float64, in the format's unit; time: (N,) float64, s; or None
    Raises: InputError if there is none.
    """
    with np.errstate(invalid="ignore"):
        largest = np.abs(points).max(axis=1)
        good = (largest <= MAX_COORDINATE) & (largest >= NO_RETURN)  # not so for NaN
    return _kept(path, Scan(np.require(points, requirements=["C", "W"]), intensity, time), good)


def without_no_returns(path: str | Path, scan: Scan, sensor_position: np.ndarray) -> Scan:
    """The scan without the points that lie where the sensor is: zeros of its driver, taken to the scan frame.

    sensor_position: (3,) float64, m, in the scan frame
    Raises: InputError if no point is left.
    """
    if not sensor_position.any():
        return scan  # `keep` has dropped them
    off = np.abs(scan.points - sensor_position.astype(np.float32)).max(axis=1)
    return _kept(path, scan, off >= NO_RETURN)


def _kept(path: str | Path, scan: Scan, good: np.ndarray) -> Scan:
    """The scan of the points for which `good`, (N,) bool, is true."""
    dropped = int(len(scan) - np.count_nonzero(good))
    if not dropped:
        return scan
    if dropped == len(scan):
        raise InputError(
            path,
            f"none of its {dropped} points has a finite position other than the sensor's own",
            "remove the file",
        )
    logger.info("%s: left out %d points without a finite position, or at the sensor's own", path, dropped)
    return replace(scan.of_points(good), dropped=scan.dropped + dropped)
