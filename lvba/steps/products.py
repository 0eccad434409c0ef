"""The steps that make the map and the pictures of the result."""

import dataclasses

import numpy as np

from lvba.dataset import Dataset, Scan
from lvba.io import dataset as recordings
from lvba.products import map_error, map_file, pictures
from lvba.products.cloud import Cloud, thin
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_file import MapConfig, PointMap
from lvba.products.pictures import Pictures
from lvba.products.recorded_images import views_of
from lvba.progress import Progress, silent
from lvba.steps.acceptance import ROUGH
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import Accepted
from lvba.steps.uncertainty import Expected


def color_map(
    dataset: Dataset,
    accepted: Accepted,
    expected: Expected,
    config: MapConfig,
    progress: Progress = silent,
) -> PointMap:
    """The map that users keep, in the dataset's world frame, with the expected error of each point."""
    found = colored_map(dataset, accepted, config, progress)
    return map_error.with_error(found, accepted.world_from_scan, expected.scans)


def colored_map(
    dataset: Dataset,
    accepted: Accepted,
    config: MapConfig,
    progress: Progress = silent,
    gain: float | None = None,
) -> PointMap:
    """The map without errors, in the dataset's world frame; without images it shows intensity.

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
        cloud.scan_of(kept),
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
