"""The stages behind the refinement: states are judged, one becomes the result, and map and pictures are made of it."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lvba import gate
from lvba.dataset import Dataset, Scan
from lvba.gate import CARRIED, EXPOSED, ROUGH, VISUAL, GateConfig, Verdict
from lvba.io import dataset as recordings
from lvba.products import evaluate as evaluation
from lvba.products import map_file, pictures
from lvba.products.cloud import Cloud, thin
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_file import MapConfig, PointMap
from lvba.products.pictures import Pictures
from lvba.progress import Progress, silent
from lvba.recorded_images import views_of
from lvba.stages import ScanPoses, VisualStage, carry_cameras, cloud_of


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


def evaluate(
    dataset: Dataset,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of the input and of what each stage made of it, by name (see `lvba.gate`); empty without images.

    Of states that are neither input nor result there are only the figures that decide; the others are NaN.
    """
    if not dataset.image_paths:
        return {}
    states = judged_states(dataset, scans, fused, visual, progress)
    entropies = {ROUGH: scans.entropy_rough}
    if scans.verdict.accepted:
        entropies[CARRIED] = scans.entropy_refined
    if fused.verdict.accepted:
        entropies[VISUAL] = fused.entropy_refined
    between = {CARRIED, EXPOSED} if VISUAL in states else set()
    scores = evaluation.evaluate(states, config, entropies=entropies, brief=between, progress=progress)
    if choose(scores, visual, gates)[0] in between:
        scores = evaluation.evaluate(states, config, entropies=entropies, progress=progress)
    return scores


def judged_states(
    dataset: Dataset, scans: ScanPoses, fused: ScanPoses, visual: VisualStage, progress: Progress = silent
) -> dict[str, State]:
    """Cloud and views of each state that is judged, by name."""
    clouds = {ROUGH: cloud_of(dataset, dataset.scans.world_from_sensor, progress)}
    clouds[CARRIED] = clouds[EXPOSED] = (
        cloud_of(dataset, scans.world_from_scan, progress) if scans.verdict.accepted else clouds[ROUGH]
    )
    clouds[VISUAL] = (
        cloud_of(dataset, fused.world_from_scan, progress) if fused.verdict.accepted else clouds[CARRIED]
    )
    base = views_of(dataset)
    return {
        name: State(
            clouds[name],
            dataclasses.replace(base, world_from_camera=poses, log_exposure=log_exposure),
        )
        for name, (poses, log_exposure) in camera_states(dataset, scans, visual).items()
    }


def camera_states(
    dataset: Dataset, scans: ScanPoses, visual: VisualStage
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World_from_camera (I, 4, 4) and log exposure (I,) of each state that is judged, by name."""
    equal = np.zeros(len(dataset.image_paths))
    carried = carry_cameras(dataset, scans.world_from_scan)
    states = {ROUGH: (dataset.images.world_from_sensor, equal), CARRIED: (carried, equal)}
    if visual.result is not None:
        states[EXPOSED] = (carried, visual.result.log_exposure)
        states[VISUAL] = (visual.result.world_from_camera, visual.result.log_exposure)
    return states


def choose(
    scores: Mapping[str, Scores], visual: VisualStage, config: GateConfig
) -> tuple[str, Verdict, Verdict]:
    """The state that what the visual stage found is used in, with the verdicts on its camera poses and exposures."""
    cameras = exposures = Verdict(False, f"input kept: {visual.problem}")
    if visual.result is not None:
        cameras, exposures = gate.judge_cameras(dict(scores), config)
    return VISUAL if cameras.accepted else EXPOSED if exposures.accepted else CARRIED, cameras, exposures


def decide(
    dataset: Dataset,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    scores: Mapping[str, Scores],
    config: GateConfig,
) -> Accepted:
    """The state that predicts the images best, never worse than the input."""
    states = camera_states(dataset, scans, visual)
    chosen, cameras, exposures = choose(scores, visual, config)
    remark = ""
    if scores:
        verdict = gate.judge_all(scores[ROUGH], scores[chosen], config)
        if not verdict.accepted:
            rough = dataset.scans.world_from_sensor
            return Accepted(rough, *states[ROUGH], verdict, verdict, verdict, verdict, ROUGH)
        remark = verdict.reason
    with_cameras = fused.verdict
    if with_cameras.accepted and chosen != VISUAL:
        with_cameras = Verdict(False, "scans stay where the LiDAR has them: the cameras were not accepted")
    used = fused if with_cameras.accepted else scans
    return Accepted(
        used.world_from_scan,
        *states[chosen],
        scans.verdict,
        cameras,
        exposures,
        with_cameras,
        chosen,
        remark,
    )


def color_map(
    dataset: Dataset,
    accepted: Accepted,
    config: MapConfig,
    progress: Progress = silent,
    gain: float | None = None,
) -> PointMap:
    """The map that users keep, in the dataset's world frame; without images it shows intensity.

    gain: the exposure it is shown at; None: the typical one
    """
    cloud = cloud_of(dataset, accepted.world_from_scan, progress)
    if not dataset.image_paths:
        return _map_of_intensity(dataset, cloud, config)
    views = dataclasses.replace(
        views_of(dataset), world_from_camera=accepted.world_from_camera, log_exposure=accepted.log_exposure
    )
    return map_file.build(cloud, views, config, progress, gain)


def _map_of_intensity(dataset: Dataset, cloud: Cloud, config: MapConfig) -> PointMap:
    """The thinned cloud, gray by intensity (1st to 99th percentile), all one gray where the scans have none."""
    voxel = max(config.voxel_m, 0.0)
    kept = thin(cloud.points_world, voxel)
    intensity = np.concatenate(
        [_intensities(recordings.load_scan(dataset, i)) for i in range(len(dataset.scans))]
    )
    shown = intensity[kept]
    known = shown[np.isfinite(shown)]
    low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 0.0)
    gray = np.full(len(kept), map_file.UNCOLORED, np.uint8)
    if high > low:
        scaled = np.nan_to_num((shown - low) / (high - low), nan=0.5)
        gray = np.rint(255 * np.clip(scaled, 0, 1)).astype(np.uint8)
    none = np.zeros(len(kept))
    return PointMap(
        cloud.points_world[kept],
        np.repeat(gray[:, None], 3, axis=1),
        none.astype(np.uint8),
        none.astype(np.float32),
        voxel,
    )


def _intensities(scan: Scan) -> np.ndarray:
    """Of the points that `cloud_of` keeps, in the same order; NaN where the file has none."""
    finite = np.isfinite(scan.points).all(1)
    values = np.full(len(scan), np.nan, np.float32) if scan.intensity is None else scan.intensity
    return values[finite]


def make_pictures(
    dataset: Dataset, accepted: Accepted, scores: dict[str, Scores], config: EvaluateConfig
) -> Pictures | None:
    """Photographs beside renderings from the input and from the result; none where there are no images."""
    if not scores:
        return None
    views = views_of(dataset)
    final = dataclasses.replace(
        views, world_from_camera=accepted.world_from_camera, log_exposure=accepted.log_exposure
    )
    return pictures.make(
        State(cloud_of(dataset, dataset.scans.world_from_sensor), views),
        State(cloud_of(dataset, accepted.world_from_scan), final),
        {"rough": scores[ROUGH], "refined": scores[accepted.state]},
        config.render,
    )
