"""Points without a usable position are dropped where files are read, so that nobody else has to look."""

import logging
from pathlib import Path

import numpy as np

from lvba.dataset import Scan
from lvba.errors import InputError

logger = logging.getLogger(__name__)

MAX_COORDINATE = 1e5
"""m; a coordinate beyond it is no measurement (no LiDAR reaches 100 km) and would drown all others in float32."""


def keep(path: str | Path, points: np.ndarray, intensity: np.ndarray | None, time: np.ndarray | None) -> Scan:
    """The scan of the points that have a finite position.

    points: (N, 3) float32, m; intensity: (N,) float32 or float64, in the format's unit; time: (N,) float64, s; or None
    Raises: InputError if there is none.
    """
    dropped = 0
    with np.errstate(invalid="ignore"):
        if not np.abs(points).max() <= MAX_COORDINATE:  # also for NaN
            good = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
            dropped = int(len(points) - np.count_nonzero(good))
            points = points[good]
            intensity = None if intensity is None else intensity[good]
            time = None if time is None else time[good]
    if dropped and not len(points):
        raise InputError(path, f"none of its {dropped} points has a finite position", "remove the file")
    if dropped:
        logger.info("%s: left out %d points without a finite position", path, dropped)
    return Scan(np.require(points, requirements=["C", "W"]), intensity, time, dropped)
