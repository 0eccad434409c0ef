"""The results that steps hand to each other."""

from dataclasses import dataclass, field

import numpy as np

from lvba.camera import Camera
from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.covariance import Covariance
from lvba.lidar.plane import PlanePoints, Planes
from lvba.loop_closure.rough_poses import RoughError
from lvba.products.map_quality import EntropyBlocks
from lvba.steps.acceptance import Verdict
from lvba.steps.pose_fusion import Fused
from lvba.visual import refine as visual_refine
from lvba.visual.radiometry import NONE, Radiometry
from lvba.visual.result import VisualResult
from lvba.visual.tuning import Tuning


@dataclass(frozen=True)
class LidarStage:
    """What the LiDAR stage found; nothing where it could not be solved.

    rough_error: of rough poses that were too far off to start from; None: they were not
    confirmed: (K,) int64, scans after which the motion is not as before and after, but surfaces confirm the refined one
    planes_off: (6, 6) float64, by errors of ranges that stay in the points, as `RangeErrors.planes_off`; None: not
        known
    """

    result: LidarResult | None
    problem: str = ""
    rough_error: RoughError | None = None
    confirmed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    planes_off: np.ndarray | None = None


@dataclass(frozen=True)
class ScanPoses:
    """The scan poses that everything after uses.

    world_from_scan: (S, 4, 4) float64
    entropy_rough, entropy_refined: mean map entropy of what was compared, nats
    map_blocks: the map entropy of the poses in use, by block of space
    """

    world_from_scan: np.ndarray
    verdict: Verdict
    entropy_rough: float
    entropy_refined: float
    map_blocks: EntropyBlocks

    @property
    def entropy(self) -> float:
        """Mean map entropy of the poses in use, nats."""
        return self.map_blocks.mean


@dataclass(frozen=True)
class MapPlanes:
    """The planes at the scan poses in use that some images are refined over.

    world_from_scan: (n, 4, 4) of the scans; keyframes: (k,) int64, indices among the images
    planes, points: None: those that the LiDAR stage solved with
    uncertainty: of the scan poses; None: not known
    problem: why there are no planes; empty: there are
    """

    world_from_scan: np.ndarray
    keyframes: np.ndarray
    planes: Planes | None
    points: PlanePoints | None
    uncertainty: Covariance | None
    problem: str = ""


@dataclass(frozen=True)
class VisualStage:
    """What the visual stage found; nothing where there are no images or it could not be solved.

    tuning: what the finest level was solved with; None: of all parts together, or not solved
    over_fused: the same cameras solved further over planes at fused scan poses; None: not solved
    """

    result: VisualResult | None
    problem: str = ""
    tuning: Tuning | None = None
    over_fused: VisualResult | None = None


@dataclass(frozen=True)
class VisualLevel:
    """What the visual stage found down to one pyramid level; nothing where it could not be solved."""

    solution: visual_refine.Coarser | None
    problem: str = ""


@dataclass(frozen=True)
class FusionStage:
    """Where both sensors have the scans; nothing where only one of them knows."""

    result: Fused | None
    problem: str = ""


@dataclass(frozen=True)
class Accepted:
    """The state that is the result.

    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4) float64; log_exposure: (I,) float64
    camera: of the raw images, as the camera poses suppose it; None: there are none
    turns: (I, 3) float64, rad, of the cameras while their rows are read, as of `VisualResult`
    """

    world_from_scan: np.ndarray
    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    camera: Camera | None
    scans: Verdict
    cameras: Verdict
    exposures: Verdict
    fusion: Verdict
    """Whether the scan poses are those that the cameras had a part in."""
    state: str
    """Which of the judged states this is."""
    remark: str = ""
    radiometry: Radiometry = NONE
    """Of the images, as the exposures suppose it."""
    turns: np.ndarray | None = None
    white_balance: np.ndarray | None = None
    """(I, 3) float64, log of how much brighter colors are than the exposures say; None: all alike."""


def scan_covariance(lidar: LidarStage, scans: ScanPoses) -> Covariance | None:
    """The covariances of the scan poses in use; None where these are the input's."""
    if lidar.result is None or not scans.verdict.accepted:
        return None
    return lidar.result.whole_covariance
