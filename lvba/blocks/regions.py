"""Regions of space that parts own, the points in them, and how crisp the map is there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.blocks import lidar_block
from lvba.blocks.lidar_block import Regions
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.products import map_quality
from lvba.products.cloud import Cloud
from lvba.products.evaluate import Scores
from lvba.products.map_quality import EntropyBlocks, EntropyConfig
from lvba.progress import Progress, silent
from lvba.steps import plane_thickness, scan_acceptance
from lvba.steps.acceptance import GateConfig
from lvba.steps.outcomes import Accepted, FusionStage, LidarStage, ScanPoses


def regions(dataset: Dataset, cores: Sequence[Part], world_from_scan: np.ndarray) -> Regions:
    """Which part owns which piece of space, at scan poses (S, 4, 4)."""
    sensors = (world_from_scan @ np.append(dataset.sensor_position_scan, 1.0))[:, :3]
    owner = np.concatenate([np.full(core.core_scans[1] - core.core_scans[0], core.number) for core in cores])
    return Regions(sensors, owner)


@dataclass(frozen=True)
class RegionEntropy:
    """The entropies of map points in one region, at the rough and at the refined poses."""

    rough: EntropyBlocks
    refined: EntropyBlocks


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
    scans = lidar_block.candidates(owned, part, reach)
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
    before = map_quality.entropy_blocks(
        region_cloud(dataset, cores, part, rough, survey.reach_m, progress), config
    )
    if lidar.result is None:
        return RegionEntropy(before, before)
    refined = lidar.result.world_from_scan
    after = region_cloud(dataset, cores, part, refined, survey.reach_m, progress)
    return RegionEntropy(before, map_quality.entropy_blocks(after, config))


def fused_entropy(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    fused: FusionStage,
    survey: Survey,
    config: EntropyConfig,
    progress: Progress = silent,
) -> EntropyBlocks | None:
    """The entropies of map points in a part's region, at the scans that cameras moved; None: there are none."""
    if fused.result is None:
        return None
    poses = fused.result.world_from_scan
    return map_quality.entropy_blocks(
        region_cloud(dataset, cores, part, poses, survey.reach_m, progress), config
    )


def thickness(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    accepted: Accepted,
    survey: Survey,
    progress: Progress = silent,
) -> plane_thickness.PlaneChange:
    """How thick planes in a part's region are, before and after."""
    # never two clouds at a time
    before, after = (
        map_quality.planar_cubes(region_cloud(dataset, cores, part, poses, survey.reach_m, progress))
        for poses in (dataset.scans.world_from_sensor, accepted.world_from_scan)
    )
    return plane_thickness.compare(before, after)


def judge_fusion(
    scans: ScanPoses, fused: FusionStage, found: Sequence[EntropyBlocks | None], config: GateConfig
) -> ScanPoses:
    """As `scan_acceptance.judge_fusion`, from what all regions say."""
    if fused.result is None:
        return scan_acceptance.not_fused(scans, fused)
    after = map_quality.blocks_together([each for each in found if each is not None])
    return scan_acceptance.decide_fusion(scans, fused.result.world_from_scan, after, config)


def judge_scans(
    dataset: Dataset,
    lidar: LidarStage,
    found: Sequence[RegionEntropy],
    scores: Mapping[str, Scores],
    config: GateConfig,
) -> ScanPoses:
    """As `scan_acceptance.judge_lidar`, from what all regions say; scores: over the images of all parts."""
    rough = dataset.scans.world_from_sensor
    before, after = (
        map_quality.blocks_together(each) for each in zip(*((r.rough, r.refined) for r in found), strict=True)
    )
    if lidar.result is None:
        return scan_acceptance.keep_rough(rough, before, lidar.problem)
    return scan_acceptance.decide(rough, lidar.result.world_from_scan, before, after, scores, config)
