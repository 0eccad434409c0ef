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
    def by_direction(self) -> tuple[float, float]:
        """As `RangeErrors.by_direction`."""
        return (0.0, 0.0) if self.ranges is None else self.ranges.by_direction

    def pose_covariance(self, scans: Indices) -> np.ndarray:
        """(n, 6, 6) float64, local tangent, rad and m: what errors in the points of some scans (n,) int64 add to that of
        their poses; (0, 6, 6): nothing."""
        motion = None if self.motion is None else self.motion.pose_covariance
        left = None if self.ranges is None else self.ranges.pose_covariance
        own = np.zeros((0, 6, 6)) if motion is None or not len(motion) else motion[scans]
        if left is None:
            return own
        return own + left if len(own) else np.tile(left, (len(scans), 1, 1))

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
