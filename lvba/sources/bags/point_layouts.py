"""The layouts in which drivers of LiDARs publish points, and where in a sweep each puts its stamp.

Sources: the drivers livox_ros_driver2, ouster-ros, velodyne_pointcloud, HesaiLidar_General_ROS and rslidar_sdk.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from lvba.errors import InputError
from lvba.sources.source import RawScan


class PointLayout(StrEnum):
    """A driver's way to publish a scan."""

    LIVOX_CUSTOM_1 = "livox-custom-1"
    """CustomMsg of livox_ros_driver."""
    LIVOX_CUSTOM_2 = "livox-custom-2"
    """CustomMsg of livox_ros_driver2."""
    LIVOX_CLOUD = "livox-cloud"
    """PointCloud2; times are ns since 1970, as float64."""
    OUSTER = "ouster"
    """PointCloud2; times are ns from the stamp."""
    VELODYNE = "velodyne"
    """PointCloud2; the stamp is the end of the sweep, times are s from it: negative."""
    HESAI = "hesai"
    """PointCloud2; times are s since 1970."""
    ROBOSENSE = "robosense"
    """PointCloud2; times are s since 1970."""


CUSTOM = {
    PointLayout.LIVOX_CUSTOM_1: "livox_ros_driver/msg/CustomMsg",
    PointLayout.LIVOX_CUSTOM_2: "livox_ros_driver2/msg/CustomMsg",
}
"""The layouts that are no PointCloud2, and their type of message."""


def _kind(size: int, *fields: tuple[str, str, int]) -> np.dtype[Any]:
    names, formats, offsets = zip(*fields, strict=True)
    return np.dtype(
        {"names": names, "formats": [f"<{each}" for each in formats], "offsets": offsets, "itemsize": size}
    )


_XYZ = ("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8)
_KINDS = {
    PointLayout.LIVOX_CLOUD: _kind(
        26, *_XYZ, ("intensity", "f4", 12), ("tag", "u1", 16), ("line", "u1", 17), ("timestamp", "f8", 18)
    ),
    PointLayout.OUSTER: _kind(
        48,
        *_XYZ,
        ("intensity", "f4", 16),
        ("t", "u4", 20),
        ("reflectivity", "u2", 24),
        ("ring", "u2", 26),
        ("ambient", "u2", 28),
        ("range", "u4", 32),
    ),
    PointLayout.VELODYNE: _kind(22, *_XYZ, ("intensity", "f4", 12), ("ring", "u2", 16), ("time", "f4", 18)),
    PointLayout.HESAI: _kind(48, *_XYZ, ("intensity", "f4", 16), ("timestamp", "f8", 24), ("ring", "u2", 32)),
    PointLayout.ROBOSENSE: _kind(
        26, *_XYZ, ("intensity", "f4", 12), ("ring", "u2", 16), ("timestamp", "f8", 18)
    ),
}


_LONGEST = 10**9
"""ns: no sweep takes a second."""


@dataclass(frozen=True)
class Published:
    """A scan as a driver publishes it. stamp: ns; table: (N,) structured, a row for each point"""

    stamp: int
    table: np.ndarray


def published(scan: RawScan, layout: PointLayout) -> Published:
    """What the driver would publish of a scan whose stamp is its begin and whose times are ns from it."""
    table = np.zeros(len(scan.points), _KINDS[layout])
    for axis, name in enumerate("xyz"):
        table[name] = scan.points[:, axis]
    if scan.intensity is not None:
        table["intensity"] = scan.intensity
    if scan.rows is not None:
        table["line" if layout is PointLayout.LIVOX_CLOUD else "ring"] = scan.rows
    offsets = offsets_ns(scan)
    stamp = scan.stamp
    if layout is PointLayout.LIVOX_CLOUD:
        table["timestamp"] = stamp + offsets
    elif layout is PointLayout.OUSTER:
        table["t"] = offsets
        table["range"] = np.linalg.norm(scan.points, axis=1) * 1000
    elif layout is PointLayout.VELODYNE:
        end = int(offsets.max(initial=0))
        stamp += end
        table["time"] = (offsets - end) * 1e-9
    else:
        table["timestamp"] = (stamp + offsets) * 1e-9
    return Published(stamp, table)


def offsets_ns(scan: RawScan) -> np.ndarray:
    """(N,) int64, ns from the stamp; zeros where the scan has no times.

    Raises InputError: its times are not ns from its begin.
    """
    if scan.times is None:
        return np.zeros(len(scan.points), np.int64)
    offsets = np.asarray(np.rint(scan.times), np.int64)
    if not 0 <= offsets.min(initial=0) <= offsets.max(initial=0) < _LONGEST or (
        scan.times.any() and not offsets.any()
    ):
        raise InputError(
            f"field {scan.time_field}",
            "does not hold ns from the start of the scan",
            "convert its times first",
        )
    return offsets
