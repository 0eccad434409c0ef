"""Poses and positions of KITTI's GNSS and IMU unit (OXTS RT3003): one text file of 30 numbers a time.

0 latitude, 1 longitude (degrees), 2 altitude (m), 3 roll, 4 pitch, 5 yaw (rad; 0: east, counter-clockwise), ...
Source: Geiger et al. 2013, "Vision meets Robotics: The KITTI Dataset", and dataformat.txt of its raw data.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.errors import InputError
from lvba.io import files
from lvba.sources.folders import tables
from lvba.sources.source import GnssFix

_EARTH_RADIUS_M = 6378137.0
_COUNT = 30


def read(path: Path) -> np.ndarray:
    """(30,) float64 of one file.

    Raises: InputError if there are not as many finite numbers, or the first are no place on earth.
    """
    row = tables.numbers(
        path, files.read_text(path, 64 * 1024).split(), _COUNT, f"{_COUNT} numbers of the OXTS"
    )
    if abs(row[0]) >= 89 or abs(row[1]) > 360 or abs(row[2]) > 1e5:
        raise InputError(path, f"latitude {row[0]:g}, longitude {row[1]:g} are no place", "copy it again")
    return row


def poses(rows: np.ndarray) -> np.ndarray:
    """World from IMU (x forward, y left, z up), (N, 4, 4): x east, y north, z up from the first position.

    Positions are Mercator coordinates at the scale of the first latitude, as the benchmark makes them.
    rows: (N, 30) float64, of `read`
    """
    scale = np.cos(np.radians(rows[0, 0]))
    east = scale * _EARTH_RADIUS_M * np.radians(rows[:, 1])
    north = scale * _EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + np.radians(rows[:, 0]) / 2))
    positions = np.stack([east, north, rows[:, 2]], axis=1)
    rotations = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    return geometry.from_rotation_translation(rotations, positions - positions[0])


def fix(row: np.ndarray, stamp: int) -> GnssFix:
    """The position of one file. row: (30,) float64, of `read`; stamp: ns"""
    return GnssFix(
        stamp=stamp,
        frame="imu",
        latitude=float(row[0]),
        longitude=float(row[1]),
        altitude=float(row[2]),
        covariance=None,
        status=0,
    )
