"""The results that steps hand to each other."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.covariance import Covariance
from lvba.products.map_quality import EntropyBlocks
from lvba.steps.acceptance import Verdict
from lvba.steps.pose_fusion import Fused
from lvba.visual import refine as visual_refine
from lvba.visual.refine import VisualResult


@dataclass(frozen=True)
class LidarStage:
    """What the LiDAR stage found; nothing where it could not be solved."""

    result: LidarResult | None
    problem: str = ""


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
class VisualStage:
    """What the visual stage found; nothing where there are no images or it could not be solved."""

    result: VisualResult | None
    problem: str = ""


@dataclass(frozen=True)
class VisualLevel:
    """What the visual stage found down to one pyramid level; nothing where it could not be solved."""

    found: visual_refine.Coarser | None
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
    """

    world_from_scan: np.ndarray
    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    scans: Verdict
    cameras: Verdict
    exposures: Verdict
    fusion: Verdict
    """Whether the scan poses are those that the cameras had a part in."""
    state: str
    """Which of the judged states this is."""
    remark: str = ""


def scan_covariance(lidar: LidarStage, scans: ScanPoses) -> Covariance | None:
    """The covariances of the scan poses in use; None where these are the input's."""
    if lidar.result is None or not scans.verdict.accepted:
        return None
    found = lidar.result
    return Covariance(found.covariance, found.conditional_covariance, found.step_covariance)
