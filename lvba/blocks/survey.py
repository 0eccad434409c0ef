"""What all parts of a recording must agree on before any of them is solved."""

from dataclasses import dataclass

import numpy as np

from lvba.blocks.split import Frames, Load
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.lidar import density
from lvba.lidar.config import STAGES, LidarConfig, Stage
from lvba.lidar.scan import gather
from lvba.visual import image, keyframes
from lvba.visual.keyframes import KeyframeConfig

_SAMPLED_SCANS = 16
_OF_SAMPLED = 4
"""Every so many-th of these tells how many points a scan has."""


@dataclass(frozen=True)
class Survey:
    """Found once, from some scans and the rough poses.

    range_m: median distance of points from the LiDAR; reach_m: further than that is one in a thousand
    points_per_scan: mean number, of those that are solved with; every: every so many-th point of a scan is one of these
    keyframes: (K,) int64, images that the visual part solves for
    lidar: settings; stages: with cells as fine as the scans allow
    """

    range_m: float
    reach_m: float
    points_per_scan: float
    every: int
    keyframes: np.ndarray
    lidar: LidarConfig
    stages: tuple[Stage, ...] = STAGES


def survey(dataset: Dataset, lidar: LidarConfig, frames: KeyframeConfig) -> Survey:
    """The survey of a recording."""
    chosen = sampled(dataset)
    scans = recordings.load_scans(dataset, chosen)
    count, middle, furthest = _sizes(dataset, scans)
    every = Load(_points_per_scan(scans[::_OF_SAMPLED]), 0.0).every
    return Survey(
        range_m=middle,
        reach_m=furthest,
        points_per_scan=count / every,
        every=every,
        keyframes=keyframes.select(dataset.images.times, dataset.images.world_from_sensor, middle, frames),
        lidar=lidar,
        stages=density.adapted(lidar.stages, gather([each[::every] for each in scans]), lidar.dense_points),
    )


def load_of(dataset: Dataset) -> Load:
    """How much memory the recording's frames take, from a few scans."""
    few = recordings.load_scans(dataset, sampled(dataset)[::_OF_SAMPLED])
    measured = image.measuring_camera(dataset.camera)
    pixels = measured.width * measured.height if dataset.image_paths else 0
    count, middle, reach = _sizes(dataset, few)
    return Load(count, float(pixels), reach, middle)


def _sizes(dataset: Dataset, scans: list[np.ndarray]) -> tuple[float, float, float]:
    """Mean number of points of scans, and how far the middle one and all but few are from the sensor, m."""
    distance = np.concatenate(
        [np.linalg.norm(points - dataset.sensor_position_scan, axis=1) for points in scans]
    )
    distance = distance[np.isfinite(distance)]
    middle, furthest = (
        (float(q) for q in np.quantile(distance, [0.5, 0.999])) if len(distance) else (1.0, 1.0)
    )
    return _points_per_scan(scans), middle, furthest


def _points_per_scan(scans: list[np.ndarray]) -> float:
    return float(np.mean([len(points) for points in scans]))


def sampled(dataset: Dataset) -> list[int]:
    """A few scans all over the recording."""
    last = len(dataset.scan_paths) - 1
    return [int(scan) for scan in np.unique(np.linspace(0, last, _SAMPLED_SCANS).astype(int))]


def keyframes_of(survey: Survey, frames: Frames) -> np.ndarray:
    """The keyframes among some images, as indices into these, (k,) int64."""
    return np.flatnonzero(np.isin(frames.images, survey.keyframes))
