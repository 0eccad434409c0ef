"""The facts of a run in parts: what each part held, how they fitted, and what the joint rounds did."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.steps import report_data
from lvba.steps.joint_cameras import MergedCameras
from lvba.steps.joint_scans import JointScans, MergedStage
from lvba.steps.outcomes import Accepted
from lvba.steps.seams import SeamWalls


def collect(
    dataset: Dataset,
    cores: Sequence[Part],
    merged: MergedStage,
    joint: JointScans,
    cameras: MergedCameras,
    walls: Sequence[SeamWalls],
    accepted: Accepted,
) -> dict[str, Any]:
    """The `merge` part of report.json."""
    history = () if cameras.cameras is None else cameras.cameras.history
    facts = {
        "parts": [_part(dataset, part) for part in cores],
        "seams": _seams(merged, cameras, walls),
        "loops": [dataclasses.asdict(loop) for loop in merged.merged.loops],
        "scan_rounds": [dataclasses.asdict(entry) for entry in joint.rounds],
        "image_rounds": [dataclasses.asdict(entry) for entry in history],
        "poses": _accounted(cores, accepted),
    }
    return dict(report_data.plain(facts))


def _part(dataset: Dataset, part: Part) -> dict[str, Any]:
    times = dataset.scans.times
    return {
        "number": part.number,
        "scans": part.scans,
        "core_scans": part.core_scans,
        "images": part.images,
        "core_images": part.core_images,
        "seconds": float(times[part.scans[1] - 1] - times[part.scans[0]]),
    }


def _seams(merged: MergedStage, cameras: MergedCameras, walls: Sequence[SeamWalls]) -> list[dict[str, Any]]:
    """One row for each two parts that share frames."""
    images = {(seam.first, seam.second): seam for seam in cameras.seams}
    across = {(wall.first, wall.second): wall for wall in walls}
    rows = []
    for seam in merged.merged.seams:
        row = dataclasses.asdict(seam)
        other = images.get((seam.first, seam.second))
        if other is not None:
            row |= {
                "images": other.images,
                "camera_offset_m": other.offset_before_m,
                "camera_offset_deg": other.offset_before_deg,
                "exposure_ratio": other.exposure_ratio,
                "exposure_spread_percent": other.spread_percent,
            }
        wall = across.get((seam.first, seam.second))
        if wall is not None:
            row |= {"wall_rough_m": wall.rough, "wall_m": wall.refined, "wall_one_side_m": wall.single}
        rows.append(row)
    return rows


def _accounted(cores: Sequence[Part], accepted: Accepted) -> dict[str, int]:
    """How many scans and images there are, and how many belong to exactly one core and have a finite pose."""
    counts = {}
    for name, poses, ranges in (
        ("scans", accepted.world_from_scan, [part.core_scans for part in cores]),
        ("images", accepted.world_from_camera, [part.core_images for part in cores]),
    ):
        owners = np.zeros(len(poses), int)
        for low, high in ranges:
            owners[low:high] += 1
        counts[name] = len(poses)
        counts[f"{name}_accounted_for"] = int(np.sum((owners == 1) & np.isfinite(poses).all((1, 2))))
    return counts
