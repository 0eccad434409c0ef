"""How thick planes of the map are, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.products import map_quality
from lvba.products.cloud import assemble
from lvba.products.map_quality import Cubes
from lvba.progress import Progress, silent
from lvba.steps.outcomes import Accepted

MOST_POINTS = 3_000_000
"""Of more points, every second, third, ... of each scan is looked at: a plane of fewer points is as thick."""


@dataclass(frozen=True)
class PlaneChange:
    """Sums over cubes that are planar before, after, or both, and that both maps have points enough in.

    before, after: of the thicknesses, m; cubes: how many these are
    planar_before, planar_after: how many cubes are planar
    """

    before: float
    after: float
    cubes: int
    planar_before: int
    planar_after: int


def measure(dataset: Dataset, accepted: Accepted, progress: Progress = silent) -> PlaneChange:
    """Of the map at the rough and at the resulting scan poses."""
    every = stride(dataset)

    def cubes(world_from_scan: np.ndarray) -> Cubes:
        cloud = assemble(
            lambda index: recordings.load_scan(dataset, index).points[::every],
            world_from_scan,
            dataset.scans.times,
            progress,
        )
        return map_quality.planar_cubes(cloud)

    return compare(cubes(dataset.scans.world_from_sensor), cubes(accepted.world_from_scan))


def stride(dataset: Dataset, samples: int = 4) -> int:
    """Every how many-th point of each scan is looked at, so that there are at most about MOST_POINTS; 1: all."""
    scans = len(dataset.scan_paths)
    some = np.unique(np.linspace(0, scans - 1, samples).astype(int))
    points = scans * float(np.mean([len(recordings.load_scan(dataset, int(index))) for index in some]))
    return max(1, round(points / MOST_POINTS))


def compare(before: Cubes, after: Cubes) -> PlaneChange:
    """Thickness in the cubes that are planar in either map, which favors neither.

    Those planar before alone would favor the map before, those planar after alone the one after.
    """
    _, here, there = np.intersect1d(before.key, after.key, assume_unique=True, return_indices=True)
    either = before.planar[here] | after.planar[there]
    return PlaneChange(
        float(before.thickness[here][either].sum()),
        float(after.thickness[there][either].sum()),
        int(either.sum()),
        int(before.planar.sum()),
        int(after.planar.sum()),
    )


def facts(found: Sequence[PlaneChange]) -> dict[str, float | int] | None:
    """The `planes` part of report.json, from all regions of space; None where nothing is planar."""
    cubes = sum(each.cubes for each in found)
    if not cubes:
        return None
    return {
        "thickness_before_m": sum(each.before for each in found) / cubes,
        "thickness_after_m": sum(each.after for each in found) / cubes,
        "count_before": sum(each.planar_before for each in found),
        "count_after": sum(each.planar_after for each in found),
    }
