"""Regions of space that parts own, the points in them, and how crisp the map is there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba import gate, geometry
from lvba.dataset import Dataset
from lvba.gate import GateConfig
from lvba.io import dataset as recordings
from lvba.lidar import share
from lvba.lidar.share import Regions
from lvba.parts.survey import Survey
from lvba.products import map_quality
from lvba.products.cloud import Cloud
from lvba.products.map_quality import EntropyConfig
from lvba.progress import Progress, silent
from lvba.split import Part
from lvba.stages import FusionStage, LidarStage, ScanPoses, not_fused


def regions(dataset: Dataset, cores: Sequence[Part], world_from_scan: np.ndarray) -> Regions:
    """Which part owns which piece of space, at scan poses (S, 4, 4)."""
    sensors = (world_from_scan @ np.append(dataset.sensor_position_scan, 1.0))[:, :3]
    owner = np.concatenate([np.full(core.core_scans[1] - core.core_scans[0], core.number) for core in cores])
    return Regions(sensors, owner)


@dataclass(frozen=True)
class RegionEntropy:
    """Sum and number of the entropies of map points in one region, nats, at the rough and at the refined poses."""

    rough: tuple[float, int]
    refined: tuple[float, int]


def region_cloud(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    world_from_scan: np.ndarray,
    reach: float,
    progress: Progress = silent,
) -> Cloud:
    """The points (of any scan) that lie in a part's region, world frame, in scan order."""
    owned = regions(dataset, cores, world_from_scan)
    scans = share.candidates(owned, part, reach)
    kept, counts = [], []
    for done, scan in enumerate(scans):
        progress("collecting points", done, len(scans))
        points = recordings.load_scan(dataset, int(scan)).points
        world = geometry.transform_points(world_from_scan[scan], points.astype(float)).astype(np.float32)
        mine = world[in_region(world, owned, part)]
        kept.append(mine)
        counts.append(len(mine))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points_world = np.concatenate([np.zeros((0, 3), np.float32), *kept])
    return Cloud(points_world, offsets, dataset.scans.times[scans])


_OWNED_CELL_M = 2.0


def in_region(points_world: np.ndarray, owned: Regions, part: int) -> np.ndarray:
    """Which points (N, 3) lie in cells that the part owns, (N,) bool."""
    cell = np.floor(points_world / np.float32(_OWNED_CELL_M)).astype(np.int64)
    key = (cell[:, 0] * (1 << 21) + cell[:, 1]) * (1 << 21) + cell[:, 2]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    mine = owned.of((cell[first] + 0.5) * _OWNED_CELL_M) == part
    return np.asarray(mine[inverse.ravel()])


def judge_region(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    lidar: LidarStage,
    survey: Survey,
    config: EntropyConfig,
    progress: Progress = silent,
) -> RegionEntropy:
    """How crisp the map is in a part's region, before and after."""
    rough = dataset.scans.world_from_sensor
    before = _entropy(region_cloud(dataset, cores, part, rough, survey.reach_m, progress), config)
    if lidar.result is None:
        return RegionEntropy(before, before)
    refined = lidar.result.world_from_scan
    return RegionEntropy(
        before, _entropy(region_cloud(dataset, cores, part, refined, survey.reach_m, progress), config)
    )


def fused_entropy(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    fused: FusionStage,
    survey: Survey,
    config: EntropyConfig,
    progress: Progress = silent,
) -> tuple[float, int]:
    """Sum and number of the entropies of map points in a part's region, nats, at the scans that cameras moved."""
    if fused.result is None:
        return 0.0, 0
    poses = fused.result.world_from_scan
    return _entropy(region_cloud(dataset, cores, part, poses, survey.reach_m, progress), config)


def judge_fusion(
    scans: ScanPoses, fused: FusionStage, found: Sequence[tuple[float, int]], config: GateConfig
) -> ScanPoses:
    """As `stages.judge_fusion`, from what all regions say."""
    if fused.result is None:
        return not_fused(scans, fused)
    after = sum(total for total, _ in found) / max(sum(count for _, count in found), 1)
    verdict = gate.judge_fusion(scans.entropy_rough, scans.entropy_refined, after, config)
    poses = fused.result.world_from_scan if verdict.accepted else scans.world_from_scan
    return ScanPoses(poses, verdict, scans.entropy_refined, after)


def _entropy(cloud: Cloud, config: EntropyConfig) -> tuple[float, int]:
    centers = map_quality.voxel_means(cloud.points_world, config.voxel_m)
    values = map_quality.point_entropies(centers, config.radius_m, config.min_neighbors)
    finite = values[np.isfinite(values)]
    return float(finite.sum()), len(finite)


def judge_scans(
    dataset: Dataset, lidar: LidarStage, found: Sequence[RegionEntropy], config: GateConfig
) -> ScanPoses:
    """The refined scan poses where they make a crisper map, else the input's."""
    before, after = (
        sum(pair[0] for pair in pairs) / max(sum(pair[1] for pair in pairs), 1)
        for pairs in ([each.rough for each in found], [each.refined for each in found])
    )
    rough = dataset.scans.world_from_sensor
    if lidar.result is None:
        return ScanPoses(rough, gate.Verdict(False, f"input poses kept: {lidar.problem}"), before, before)
    verdict = gate.judge_scans(before, after, config)
    return ScanPoses(lidar.result.world_from_scan if verdict.accepted else rough, verdict, before, after)
