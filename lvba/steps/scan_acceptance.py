"""The steps that judge scan poses: refined ones against the rough ones, and those that learned from the cameras.

What recordings in parts share with whole ones is here; how these gather it is in `lvba.blocks.regions`.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from lvba.dataset import Dataset
from lvba.products import evaluate, map_quality
from lvba.products.cloud import Cloud
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_quality import EntropyBlocks, EntropyConfig
from lvba.products.recorded_images import views_of
from lvba.progress import Progress, silent
from lvba.steps import acceptance
from lvba.steps.acceptance import CARRIED, ROUGH, GateConfig, Verdict
from lvba.steps.lidar import carry_cameras, cloud_of
from lvba.steps.outcomes import FusionStage, LidarStage, ScanPoses


def judge_lidar(
    dataset: Dataset,
    lidar: LidarStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> ScanPoses:
    """The refined scan poses where map and images together speak for them, else the input's."""
    rough = dataset.scans.world_from_sensor
    before = cloud_of(dataset, rough, progress)
    before_blocks = map_quality.entropy_blocks(before, config.entropy)
    if lidar.result is None:
        return keep_rough(rough, before_blocks, lidar.problem)
    after = cloud_of(dataset, lidar.result.world_from_scan, progress)
    after_blocks = map_quality.entropy_blocks(after, config.entropy)
    scores: Mapping[str, Scores] = {}
    if asks_images(before_blocks, after_blocks, gates):
        images = asked_images(len(dataset.image_paths))
        scores = compare(dataset, lidar.result.world_from_scan, before, after, images, config, progress)
    return decide(rough, lidar.result.world_from_scan, before_blocks, after_blocks, scores, gates)


def keep_rough(rough: np.ndarray, blocks: EntropyBlocks, problem: str) -> ScanPoses:
    """The rough scan poses, because there are no refined ones."""
    verdict = Verdict(False, f"input poses kept: {problem}")
    return ScanPoses(rough, verdict, blocks.mean, blocks.mean, blocks)


def asks_images(before: EntropyBlocks, after: EntropyBlocks, gates: GateConfig) -> bool:
    """Whether it is for the images to say if refined scan poses are accepted."""
    entropy = acceptance.entropy_figure(map_quality.entropy_change(before, after), gates)
    return gates.enabled and acceptance.may_be_crisper(entropy, gates)


def asked_images(count: int) -> np.ndarray:
    """The images (J,) int32, of so many, that say whether they contradict refined scans."""
    if not count:
        return np.zeros(0, np.int32)
    return evaluate.judged_images(count, np.zeros(0, np.int32), acceptance.SCAN_IMAGES)


def compare(
    dataset: Dataset,
    world_from_scan: np.ndarray,
    before: Cloud,
    after: Cloud,
    images: np.ndarray,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of ROUGH and CARRIED over some images (J,): other scans, cameras carried along; none without images.

    world_from_scan: (S, 4, 4), refined; before, after: the clouds at rough and refined poses
    Only leave-one-out figures are known, and no map entropy.
    """
    if not len(images):
        return {}
    views = views_of(dataset)
    carried = dataclasses.replace(views, world_from_camera=carry_cameras(dataset, world_from_scan))
    states = {ROUGH: State(before, views), CARRIED: State(after, carried)}
    unknown = dict.fromkeys(states, float("nan"))
    return evaluate.evaluate(
        states, config, entropies=unknown, brief=tuple(states), images=images, progress=progress
    )


def decide(
    rough: np.ndarray,
    refined: np.ndarray,
    before: EntropyBlocks,
    after: EntropyBlocks,
    scores: Mapping[str, Scores],
    gates: GateConfig,
) -> ScanPoses:
    """The scan poses in use. rough, refined: (S, 4, 4); scores: of `compare`"""
    entropy = acceptance.entropy_figure(map_quality.entropy_change(before, after), gates)
    images = acceptance.image_figures(scores[ROUGH], scores[CARRIED], gates) if scores else ()
    verdict = acceptance.judge_scans(entropy, images, gates)
    poses, blocks = (refined, after) if verdict.accepted else (rough, before)
    return ScanPoses(poses, verdict, before.mean, after.mean, blocks)


def judge_fusion(
    dataset: Dataset,
    scans: ScanPoses,
    fused: FusionStage,
    entropy: EntropyConfig,
    config: GateConfig,
    progress: Progress = silent,
) -> ScanPoses:
    """The fused scan poses where the map is as crisp with them, else those before; `entropy_rough` is of the latter.

    The images are asked later, with the cameras that are in use.
    """
    if fused.result is None:
        return not_fused(scans, fused)
    cloud = cloud_of(dataset, fused.result.world_from_scan, progress)
    return decide_fusion(
        scans, fused.result.world_from_scan, map_quality.entropy_blocks(cloud, entropy), config
    )


def decide_fusion(
    scans: ScanPoses, world_from_scan: np.ndarray, after: EntropyBlocks, config: GateConfig
) -> ScanPoses:
    """The same, from the map entropy at the fused scan poses (S, 4, 4)."""
    change = map_quality.entropy_change(scans.map_blocks, after)
    verdict = acceptance.judge_fusion(
        rough_gain(scans), acceptance.entropy_figure(change, config), (), config
    )
    poses, blocks = (
        (world_from_scan, after) if verdict.accepted else (scans.world_from_scan, scans.map_blocks)
    )
    return ScanPoses(poses, verdict, change.before, change.after, blocks)


def rough_gain(scans: ScanPoses) -> float:
    """The map entropy that the scan poses in use have gained over the input, nats."""
    return scans.entropy_rough - scans.entropy


def not_fused(scans: ScanPoses, fused: FusionStage) -> ScanPoses:
    """The scan poses as they were, because there are none that cameras had a part in."""
    verdict = Verdict(False, f"scans stay where the LiDAR has them: {fused.problem}")
    return ScanPoses(scans.world_from_scan, verdict, scans.entropy, scans.entropy, scans.map_blocks)
