"""The step that measures walls across the seam of two parts."""

from dataclasses import dataclass

import numpy as np

from lvba.blocks import split
from lvba.blocks.decoded_scans import ScanPoints, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.products import map_quality
from lvba.products.cloud import Cloud
from lvba.progress import Progress, silent
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import Accepted


@dataclass(frozen=True)
class SeamWalls:
    """How thick walls are across a seam, m, standard deviations over what the scans on both sides see as planes.

    rough, refined: both sides together, at the rough and at the refined poses; single: of either side by itself, refined,
    the thinner they can be; NaN where there is no wall
    """

    first: int
    second: int
    rough: float
    refined: float
    single: float


_SCANS_BY_SEAM = 8


def seam_frames(dataset: Dataset, left: Part, right: Part) -> Dataset:
    """The scans on both sides of a seam, as many on either."""
    border = right.core_scans[0]
    low = max(border - _SCANS_BY_SEAM, left.core_scans[0])
    high = min(border + _SCANS_BY_SEAM, right.core_scans[1])
    return split.subset(dataset, np.arange(low, high), np.zeros(0, np.int64))


def measure_seam(
    frames: Dataset,
    left: Part,
    right: Part,
    points: Pieces[ScanPoints],
    accepted: Accepted,
    progress: Progress = silent,
) -> SeamWalls:
    """The walls across one seam. frames: of `seam_frames`; points: of both cores."""
    border = right.core_scans[0]
    low = max(border - _SCANS_BY_SEAM, left.core_scans[0])
    poses = accepted.world_from_scan[low : low + len(frames.scans)]
    read = ScanReader(points, low)
    rough = cloud_of(frames, frames.scans.world_from_sensor, progress, read)
    refined = cloud_of(frames, poses, progress, read)
    sides = [_scans_of(refined, slice(0, border - low)), _scans_of(refined, slice(border - low, len(poses)))]
    rows = map_quality.plane_thickness({"rough": rough, "refined": refined, "a": sides[0], "b": sides[1]})
    single = [rows[name]["in_refined"] for name in ("a", "b")]
    return SeamWalls(
        left.number,
        right.number,
        rows["rough"]["in_refined"],
        rows["refined"]["own"],
        float(np.mean(single)),
    )


def _scans_of(cloud: Cloud, which: slice) -> Cloud:
    bounds = cloud.scan_offsets[which.start : which.stop + 1]
    return Cloud(cloud.points_world[bounds[0] : bounds[-1]], bounds - bounds[0], cloud.scan_times[which])
