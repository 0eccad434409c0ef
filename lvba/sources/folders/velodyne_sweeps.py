"""Sweeps of KITTI's Velodyne HDL-64E in .bin files: points without times, which the azimuth gives.

Seen from above the sensor turns clockwise. A sweep begins behind the car, is in front of it in the middle, and ends
behind. Source: the curl functions of the kitti360Scripts (accumuLaser), which take a point at azimuth a from the pose of
the forward time to that of a / 360 degrees of a sweep before.
"""

from pathlib import Path

import numpy as np

from lvba.io import velodyne
from lvba.sources.folders.items import XYZ, Item
from lvba.sources.source import RawScan

FRAME = "velodyne"
TIME_FIELD = "offset_time"
"""ns from the stamp of the scan, as Livox names them."""
FIELDS = (*XYZ, "intensity float32", f"{TIME_FIELD} uint32")


def azimuth_times(points: np.ndarray, sweep_ns: int) -> np.ndarray:
    """ns from the start of the sweep at which the sensor looked at points, (N,) uint32.

    points: (N, 3) float32, m, x forward, y left; sweep_ns: ns of a turn
    """
    x, y = points[:, 0].astype(float), points[:, 1].astype(float)
    part = 0.5 * (1.0 - np.arctan2(y, x) / np.pi)
    return np.asarray(np.clip(np.round(part * sweep_ns), 0, sweep_ns), np.uint32)


def item(stream: str, path: Path, begin: int, sweep_ns: int) -> Item:
    """A sweep that is read when it is its turn. begin: ns, its stamp; sweep_ns: ns of a turn"""
    return Item(begin, stream, lambda: _read(path, begin, sweep_ns), str(path))


def _read(path: Path, begin: int, sweep_ns: int) -> RawScan:
    scan = velodyne.read_bin(path)
    return RawScan(
        stamp=begin,
        frame=FRAME,
        points=scan.points,
        intensity=scan.intensity,
        times=azimuth_times(scan.points, sweep_ns),
        time_field=TIME_FIELD,
    )
