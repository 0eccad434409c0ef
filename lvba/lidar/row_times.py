"""Times of a depth camera's points, by the rows of the depth image that their files still follow.

Many depth cameras read one row after the other, as rolling shutters do, and none gives its points times: at 50 degrees a
second a Kinect's scan is bent by more than one degree. Source: Ringaby, Forssen: Scan Rectification for Structured Light
Range Sensors with Rolling Shutters, ICCV 2011.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Times, Vector, Vectors
from lvba.lidar.range_errors import Beams

_NOMINAL_S = 1 / 30
"""From the first to the last row of a depth camera of 30 images a second: what is measured is the part of it."""
_IN_ORDER = 0.9
"""Part of the variance of the points' places in their file that their rows explain: rows follow each other. Points in the
order of columns, of another pattern or of none have less than half."""
_SAME_WAY = 0.98
"""Cosine of the angle between the directions of rows in two scans of one camera, at least."""
_NEAR_AXIS = 0.996
"""Cosine within which an axis of the scan frame is taken for the direction of rows."""
_OUTLIERS = 0.005
_FEWEST_POINTS = 100


@dataclass(frozen=True)
class RowClock:
    """When points were measured that a depth camera reads row by row; the middle row at the stamp.

    All in the scan frame. position: (3,) m, where beams begin; ahead, down: (3,), unit, where the camera looks, and from
    the first row to the last; first, last: tangents of the angles to these rows; sweep: s, nominal, between them
    """

    position: np.ndarray
    ahead: np.ndarray
    down: np.ndarray
    first: float
    last: float
    sweep: float

    @property
    def begin(self) -> float:
        """Seconds from the stamp of the first row."""
        return -self.sweep / 2

    def from_stamp(self, points: Vectors, time: Times | None, stamp: float) -> np.ndarray:
        """(N,) s from the stamp, of points (N, 3) m, scan frame; neither times in the file nor `stamp` (s) matter."""
        beam = np.asarray(points, float) - self.position
        depth = beam @ self.ahead
        row = beam @ self.down / np.where(depth > 0, depth, np.inf)
        part = (np.clip(row, self.first, self.last) - self.first) / (self.last - self.first)
        return np.where(depth > 0, (part - 0.5) * self.sweep, 0.0)


def find_rows(scans: Sequence[np.ndarray], beams: Beams, axes: np.ndarray) -> RowClock | None:
    """By the order of the points (N, 3) m of some scans in their files; None: they are not in the order of rows.

    axes: (3, 3) float64, columns: the sensor's own, in the scan frame
    """
    if beams.axis is None or not beams.narrow:
        return None
    ways = [way for each in scans if (way := _down(each, beams.position, beams.axis)) is not None]
    if not ways or 2 * len(ways) < len(scans):
        return None
    mean = np.mean(ways, axis=0)
    down = mean / max(float(np.linalg.norm(mean)), 1e-9)
    if np.mean(np.array(ways) @ down > _SAME_WAY) < _IN_ORDER:
        return None
    along = axes.T @ down
    nearest = int(np.argmax(np.abs(along)))
    if abs(along[nearest]) > _NEAR_AXIS:
        down = np.sign(along[nearest]) * axes[:, nearest]
    rows = np.concatenate([_tangents(each, beams.position, beams.axis) @ down for each in scans])
    first, last = (float(each) for each in np.quantile(rows, [_OUTLIERS, 1 - _OUTLIERS]))
    return RowClock(
        position=beams.position,
        ahead=beams.axis,
        down=np.asarray(down),
        first=first,
        last=last,
        sweep=_NOMINAL_S,
    )


def _tangents(points: Vectors, position: Vector, ahead: Vector) -> np.ndarray:
    """(n, 3): where the beams of points (N, 3) ahead meet the plane at distance 1."""
    beam = np.asarray(points, float) - position
    depth = beam @ ahead
    in_front = depth > 0
    return np.asarray(beam[in_front] / depth[in_front, None] - ahead)


def _down(points: Vectors, position: Vector, ahead: Vector) -> np.ndarray | None:
    """(3,), unit: along which points follow each other in their file, across `ahead`; None: along no such direction."""
    tangents = _tangents(points, position, ahead)
    if len(tangents) < _FEWEST_POINTS:
        return None
    place = np.linspace(-1.0, 1.0, len(tangents))
    away = tangents - tangents.mean(axis=0)
    way = np.linalg.lstsq(away, place, rcond=1e-6)[0]
    left = place - away @ way
    if np.mean(left**2) > (1 - _IN_ORDER) * np.mean(place**2):
        return None
    return np.asarray(way / np.linalg.norm(way))
