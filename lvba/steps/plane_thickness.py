"""How thick planes of the map are, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.blocks.decoded_scans import ScanPoints
from lvba.blocks.pieces import Pieces
from lvba.blocks.regions import region_cloud
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.products import map_quality
from lvba.products.map_quality import Cubes
from lvba.progress import Progress, silent
from lvba.steps.outcomes import Accepted

MOST_POINTS = 3_000_000
"""Of more points in a part, every second, third, ... of each scan is looked at: a plane of fewer points is as thick."""


@dataclass(frozen=True)
class PlaneChange:
    """Sums over cubes that are planar before, after, or both, and that both maps have points enough in.

    before, after: of the thicknesses, m; squares: of the squared changes, m^2; cubes: how many these are
    planar_before, planar_after: how many cubes are planar
    """

    before: float
    after: float
    squares: float
    cubes: int
    planar_before: int
    planar_after: int


def measure(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    points: Pieces[ScanPoints],
    accepted: Accepted,
    survey: Survey,
    progress: Progress = silent,
) -> PlaneChange:
    """In a part's region, of the map at the rough and at the resulting scan poses."""
    core = cores[part].core_scans
    every = max(1, round((core[1] - core[0]) * survey.points_per_scan / MOST_POINTS))
    # never two clouds at a time
    before, after = (
        map_quality.planar_cubes(
            region_cloud(dataset, cores, part, points, poses, survey.reach_m, progress, every=every)
        )
        for poses in (dataset.scans.world_from_sensor, accepted.world_from_scan)
    )
    return compare(before, after)


def compare(before: Cubes, after: Cubes) -> PlaneChange:
    """Thickness in the cubes that are planar in either map, which favors neither.

    Those planar before alone would favor the map before, those planar after alone the one after.
    """
    _, here, there = np.intersect1d(before.key, after.key, assume_unique=True, return_indices=True)
    either = before.planar[here] | after.planar[there]
    thickness = before.thickness[here][either], after.thickness[there][either]
    return PlaneChange(
        before=float(thickness[0].sum()),
        after=float(thickness[1].sum()),
        squares=float(np.square(thickness[1] - thickness[0]).sum()),
        cubes=int(either.sum()),
        planar_before=int(before.planar.sum()),
        planar_after=int(after.planar.sum()),
    )


def facts(changes: Sequence[PlaneChange]) -> dict[str, float | int] | None:
    """The `planes` part of report.json, from all regions of space; None where nothing is planar."""
    cubes = sum(each.cubes for each in changes)
    if not cubes:
        return None
    before, after = (sum(getattr(each, name) for each in changes) / cubes for name in ("before", "after"))
    spread = sum(each.squares for each in changes) / cubes - (after - before) ** 2
    return {
        "thickness_before_m": before,
        "thickness_after_m": after,
        "thickness_change_error_m": float(np.sqrt(max(spread, 0.0) / max(cubes - 1, 1))),
        "count_before": sum(each.planar_before for each in changes),
        "count_after": sum(each.planar_after for each in changes),
    }
