"""What the scans say of the points of a map, for formats that keep it: when, by which scan, and how strong the echo was.

Points of a map are points of scans, moved by the scan's pose (and corrected for errors of the scans), and carry the
scan's number: so the point of a scan that a map point was is the nearest one.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.arrays import Times
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.io import ply, result_folder
from lvba.lidar.scan_errors import ScanErrors
from lvba.parallel import in_order
from lvba.progress import Progress, silent

logger = logging.getLogger(__name__)

_SAME_M = 2e-3
"""A map point and the point of the scan that it is lie nearer than this: both are rounded to float32."""
_UNIX_FROM, _UNIX_TO = 1.0e9, 4.0e9
_UNIX_OF_GPS, _ADJUSTED = 315_964_800.0, 1.0e9
_LEAP_DAYS = np.array([1_136_073_600.0, 1_230_768_000.0, 1_341_100_800.0, 1_435_708_800.0, 1_483_228_800.0])
"""Unix times from which GPS is one more second ahead of UTC; 13 s before the first."""
_ABSOLUTE_S = 5.0
"""Times of points this near to that of their scan are seconds of the same clock."""


@dataclass(frozen=True)
class Measured:
    """Of the N points of a map, in its order.

    gps_time: (N,) float64, s: adjusted standard GPS time (`adjusted`), else of a clock of the recording's own
    intensity: (N,) uint16, as in the scans; of 0..1 there, as part of 65535; 0 where not known
    source: (N,) uint16, number of the scan, from 1; 0 where not known
    """

    gps_time: np.ndarray
    intensity: np.ndarray
    source: np.ndarray
    adjusted: bool


def of_map(
    result: Path, open_recording: Callable[[Path], Dataset], progress: Progress = silent
) -> Measured | None:
    """What the recording's scans say of the points of a result's map; None where the map does not know its scans.

    Raises: InputError if the result or its recording cannot be read, or does not fit.
    """
    if "scan" not in (next(ply.read_ply_chunks(result / result_folder.MAP)).dtype.names or ()):
        return None
    dataset = open_recording(result)
    poses = result_folder.read_scans(result, dataset)
    lidar = (result_folder.read_report(result) or {}).get("lidar") or {}
    errors = ScanErrors.of_facts(lidar)
    columns = ply.read_ply(result / result_folder.MAP)
    scan = columns["scan"].astype(np.int64)
    points = np.stack([columns[name] for name in "xyz"], axis=1).astype(float) - dataset.origin
    order = np.argsort(scan, kind="stable")
    start = np.searchsorted(scan[order], np.arange(len(poses) + 1))
    time, intensity = poses.times[scan], np.zeros(len(scan), np.float32)

    def look_up(index: int) -> None:
        mine = order[start[index] : start[index + 1]]
        if not len(mine):
            return
        scan = recordings.load_scan(dataset, index)
        own = scan.points if errors is None else errors.points(scan, index, float(poses.times[index]))
        moved = geometry.transform_points(poses.world_from_sensor[index], own)
        distance, nearest = cKDTree(moved).query(points[mine], distance_upper_bound=_SAME_M)
        known = np.isfinite(distance)
        mine, nearest = mine[known], nearest[known]
        if scan.intensity is not None:
            intensity[mine] = np.nan_to_num(scan.intensity[nearest])
        if scan.time is not None and np.abs(scan.time - poses.times[index]).max() < _ABSOLUTE_S:
            time[mine] = scan.time[nearest]

    for done, _ in enumerate(in_order(look_up, range(len(poses)))):
        progress("scans", done + 1, len(poses))
    adjusted = bool(poses.times[0] >= _UNIX_FROM and poses.times[-1] < _UNIX_TO)
    source = np.where(scan < np.iinfo(np.uint16).max, scan + 1, 0).astype(np.uint16)
    return Measured(adjusted_gps_time(time) if adjusted else time, as_uint16(intensity), source, adjusted)


def adjusted_gps_time(unix: Times) -> np.ndarray:
    """Adjusted standard GPS times, s, of Unix times (UTC), s: GPS time less 10^9."""
    leap = 13 + np.searchsorted(_LEAP_DAYS, unix, side="right")
    return unix - _UNIX_OF_GPS + leap - _ADJUSTED


def as_uint16(intensity: np.ndarray) -> np.ndarray:
    """Intensities as whole numbers: as they are, or, where none is above 1 and some lie between, as part of 65535.

    intensity: (N,) float32 or float64
    """
    if len(intensity) and intensity.max() <= 1 and (intensity != np.rint(intensity)).any():
        intensity = intensity * 65535
    return np.asarray(np.clip(np.rint(intensity), 0, 65535).astype(np.uint16))
