"""Points of what moved: scans before and after see through them.

A point counts as moving where at least two scans taken a second or a few before or after see something behind it, and
more than twice as many as see something there. So do points of glass and drops of rain: what is seen through is no
surface that an image could be compared with.
"""

from collections.abc import Callable, Sequence

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Times, Vector
from lvba.kernels import range_images as kernels
from lvba.progress import Progress, silent
from lvba.trajectory import nearest_in_time

LOOKS_S = (2.0, 4.0, 1.0, 3.0, 0.5)
"""How long before and after a scan others look at its points: what walks is elsewhere, and poses still agree."""
MOST_OF_A_SCAN = 0.4
"""Where others see through more of a scan, its pose is wrong rather: then nothing is said of its points. In dense traffic
they saw through 17 % at most."""
_LEAST_CELL, _LARGEST_CELL = np.radians(0.4), np.radians(1.5)
_SPACINGS = 2.0
"""Cells are so many times as wide as points of a scan are apart: of the nine about a point most show something."""
_COARSE = 60
"""Cells along a face, 1.5 degrees: that show which directions a scan has points in."""
_ASKED_SCANS = 5
"""Of a part, that tell how far apart their points are."""


def moving_points(
    load: Callable[[int], np.ndarray],
    world_from_scan: Sequence[Poses],
    times: Times,
    sensor_position: Vector,
    scans: range,
    progress: Progress = silent,
) -> list[np.ndarray]:
    """Which points of some scans move, (N,) bool for each, at all of the given poses alike.

    load: gives the (N, 3) float32 points, m, of one of the S scans; world_from_scan: each (S, 4, 4); times: (S,), s,
    ascending; sensor_position: (3,), m, scan frame
    """
    sensor = np.asarray(sensor_position, np.float32)
    cells, images = cells_of_face([load(s) - sensor for s in _spread(scans)]), dict[int, np.ndarray]()
    masks = []
    for done, scan in enumerate(scans):
        progress("moving points", done, len(scans))
        others = looking(times, scan)
        for gone in [each for each in images if each < min(others, default=scan)]:
            del images[gone]
        for other in others:
            if other not in images:
                images[other] = kernels.range_image(load(other) - sensor, cells)
        points = np.ascontiguousarray(load(scan), np.float32)
        masks.append(np.zeros(len(points), bool))
        if not others:
            continue
        seen, looks = np.arange(len(points)), np.stack([images[k] for k in others])
        for poses in world_from_scan:
            image_from_points = _sensor_from_scan(poses, others, scan, sensor_position)
            seen = seen[kernels.seen_through(points[seen], looks, image_from_points)]
        if len(seen) <= MOST_OF_A_SCAN * len(points):
            masks[-1][seen] = True
    return masks


def looking(times: Times, scan: int) -> list[int]:
    """The scans that look at the points of one, each once. times: (S,), s, ascending"""
    wanted = [times[scan] + sign * after for after in LOOKS_S for sign in (-1.0, 1.0)]
    within = np.array([each for each in wanted if times[0] <= each <= times[-1]])
    nearest = nearest_in_time(times, within).tolist()
    return [each for each in dict.fromkeys(nearest) if each != scan]


def cells_of_face(scans: Sequence[np.ndarray]) -> int:
    """Cells along a face of range images, by the angles that points of scans (N, 3), m, from the sensor, are apart."""
    spacing = []
    for points in scans:
        filled = np.isfinite(kernels.range_image(np.ascontiguousarray(points, np.float32), _COARSE)).sum()
        if filled:
            spacing.append(np.sqrt(filled / len(points)) * _angle_of_cell(_COARSE))
    width = np.clip(_SPACINGS * np.median(spacing) if spacing else 0.0, _LEAST_CELL, _LARGEST_CELL)
    return int(np.ceil(_angle_of_cell(1) / width))


def _angle_of_cell(cells: int) -> float:
    """Edge, rad, of a square of the solid angle that a cell has on average."""
    return float(np.sqrt(4 * np.pi / 6) / cells)


def _spread(scans: range) -> list[int]:
    return [scans[int(k)] for k in np.unique(np.linspace(0, len(scans) - 1, _ASKED_SCANS).astype(int))]


def _sensor_from_scan(poses: Poses, others: Sequence[int], scan: int, sensor_position: Vector) -> np.ndarray:
    """(L, 3, 4) float32: from a scan's frame into those of other scans, moved to their sensors."""
    relative = geometry.inverse(poses[list(others)]) @ poses[scan]
    relative[:, :3, 3] -= sensor_position
    return np.ascontiguousarray(relative[:, :3], np.float32)
