"""Parts that were solved on their own, put together: a pose graph over all scans, tied in the overlaps and by loops."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar.loops import Loop
from lvba.lidar.pose_graph import PoseGraphConfig


@dataclass(frozen=True)
class PartPoses:
    """What one part says about its scans.

    scans: (n,) int64, ascending, indices of its scans in the whole
    world_from_scan: (n, 4, 4) float64, refined in the part, or rough where it could not be solved; its world frame may be
        off that of others by any rigid motion
    step_covariance: (n - 1, 6, 6) float64, of the relative pose of each scan and the next in the part, rad and m, local
        tangent [rotation | translation] at the later scan; that of the odometry where the part could not be solved
    """

    scans: np.ndarray
    world_from_scan: np.ndarray
    step_covariance: np.ndarray


@dataclass(frozen=True)
class Seam:
    """Two parts that share scans.

    first, second: the parts; scans: how many they share; length: m, of the path through these
    jump_m, jump_deg: rigid motion between the two parts' poses of the shared scans before merging
    apart_m, apart_deg: root mean squares of what is left between these when the rigid motion is taken out
    left_m, left_deg: largest difference of the step from one shared scan to the next in the merged trajectory and in
        either part
    """

    first: int
    second: int
    scans: int
    length: float
    jump_m: float
    jump_deg: float
    apart_m: float
    apart_deg: float
    left_m: float
    left_deg: float


@dataclass(frozen=True)
class LoopRow:
    """What became of a loop between two parts.

    first, second: parts; first_scan, second_scan: scans in the whole, -1 where none was found
    used: whether it is in the merged trajectory; reason: why, or why not
    before_m, before_deg: by how much it was missed before merging; after_m, after_deg: afterwards
    overlap: part of what could be seen in both that agrees; residual: m, typical distance of surfaces
    """

    first: int
    second: int
    first_scan: int
    second_scan: int
    used: bool
    reason: str
    before_m: float
    before_deg: float
    after_m: float
    after_deg: float
    overlap: float
    residual: float


@dataclass(frozen=True)
class MergedScans:
    """One trajectory of all parts.

    world_from_scan: (S, 4, 4) float64, world frame of the first part, first pose unchanged
    parts_of_scan: (S,) int64, how many parts hold each scan
    seams, loops: one row each
    cost_before, cost_after: squared errors over variances of the edges that are used
    """

    world_from_scan: np.ndarray
    parts_of_scan: np.ndarray
    seams: tuple[Seam, ...]
    loops: tuple[LoopRow, ...]
    cost_before: float
    cost_after: float
    converged: bool


def merge(
    parts: tuple[PartPoses, ...],
    loops: tuple[Loop, ...] = (),
    *,
    config: PoseGraphConfig | None = None,
) -> MergedScans:
    """All scans in one world frame.

    Raises DegenerateProblemError: the parts do not overlap.
    """
    raise NotImplementedError
