"""What is systematically wrong with the scans of a recording, and where their points belong."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.arrays import Indices
from lvba.dataset import Scan
from lvba.lidar.range_errors import RangeErrors
from lvba.lidar.scan_motion import MotionLeft


@dataclass(frozen=True)
class ScanErrors:
    """ranges: of the sensor; motion: left in scans; None: not measured"""

    ranges: RangeErrors | None
    motion: MotionLeft | None

    @property
    def corrected(self) -> bool:
        """Whether points are moved."""
        return any(each is not None and each.corrected for each in (self.ranges, self.motion))

    @property
    def planes_off(self) -> np.ndarray | None:
        """(6, 6) float64, as `RangeErrors.planes_off`; None: not known."""
        return None if self.ranges is None else self.ranges.planes_off

    def own_covariance(self, scans: Indices) -> np.ndarray:
        """(n, 6, 6) float64, local tangent, rad and m: what the motion taken out of some scans (n,) int64 adds to that of
        each pose by itself, because it is uncertain; (0, 6, 6): nothing."""
        known = None if self.motion is None else self.motion.pose_covariance
        return np.zeros((0, 6, 6)) if known is None or not len(known) else np.asarray(known[scans])

    @property
    def shared_covariance(self) -> np.ndarray:
        """(6, 6) float64, local tangent, rad and m: what errors that stay in the points of all scans add to that of their
        poses. Neighbors are off alike, with the map about them."""
        turn, shift = (0.0, 0.0) if self.ranges is None else self.ranges.poses_off
        return np.diag(np.repeat(np.square([turn, shift]) / 3, 3))

    def cosines(self, scan: Scan) -> np.ndarray | None:
        """(N,) float64, of the angles of incidence of its points; None: nothing depends on them."""
        return None if self.ranges is None else self.ranges.cosines(scan.points)

    def points(self, scan: Scan, index: int, stamp: float, cosine: np.ndarray | None = None) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong. index: its number; stamp: s

        cosine: (N,) float64, as `cosines` has them; None: found here
        """
        ranges = self.ranges
        points = scan.points if ranges is None else ranges.points(scan.points, cosine, scan.intensity)
        return points if self.motion is None else self.motion.points(points, scan.time, index, stamp)

    @staticmethod
    def of_facts(lidar: Mapping[str, Any]) -> "ScanErrors | None":
        """As report.json has them in `lidar`; None where points stay as they are."""
        errors = ScanErrors(
            RangeErrors.of_facts(lidar.get("range_errors")), MotionLeft.of_facts(lidar.get("motion_left"))
        )
        return errors if errors.corrected else None
