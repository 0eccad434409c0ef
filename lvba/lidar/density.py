"""How fine the cells may be: as fine as single scans still fill them, and as noise leaves planes in them."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lvba import distinct_rows, geometry
from lvba.lidar import voxel_map
from lvba.lidar.config import Stage
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.range_errors import directions
from lvba.lidar.scan import Scans, gather
from lvba.lidar.weights import weighted_quantile

_SAMPLED_SCANS = 10
_MOST_HALVINGS = 2
_NOISE_PER_EDGE = 0.125
"""Cells whose edge is shorter than eight standard deviations of the range go. They cut points of a wall off: what is left
in them looks thinner than the wall is, and stands against the true plane through larger cells. Rooms seen with a noise
of 3.6 cm end better without cells of 0.25 m (1.2 mm instead of 1.5), with 2.8 cm better with them (0.86 instead of 0.94);
with 5.4 cm the difference is 2 mm to 70."""
_FRONTAL = 0.5
"""Cosine of the incidence from which on a surface tells the noise of ranges: on the ground far away it hardly shows."""
_UNCLUTTERED = 0.25
"""Part of the points that lie on plain surfaces, at least: in a street with trees, cars and people, half of all cells of
a meter hold more than one surface, and seemed to be 6 to 7 cm thick where ranges were good to 2."""
_PLANE = voxel_map.PlaneTest()


def adapted(stages: tuple[Stage, ...], scans: Scans, dense_points: int) -> tuple[Stage, ...]:
    """The stages with finer cells added to each where the scans are dense enough for them, less those too fine for
    their noise.

    dense_points: fewest points of a single scan that a finer cell must hold; 0: never finer

    A depth camera over a desk puts hundreds of points of one scan into a cell of 0.25 m, and surfaces there are smaller
    than the cell; a spinning LiDAR in the open puts five there, and a finer cell would hold no plane at all. Where there
    are finer cells, nothing is looked for in those of several surfaces.
    """
    if not len(scans.points):
        return stages
    made = without_noisy(with_finer(stages, scans, dense_points), scans)
    return tuple(
        replace(new, mixed_cells=old.mixed_cells and new.sizes[0] >= old.sizes[0])
        for old, new in zip(stages, made, strict=True)
    )


def with_finer(stages: tuple[Stage, ...], scans: Scans, dense_points: int) -> tuple[Stage, ...]:
    """The stages with cells of half the size and half again, as long as single scans put so many points into them."""
    if dense_points == 0:
        return stages
    finest = min(stage.sizes[0] for stage in stages)
    halvings = 0
    while halvings < _MOST_HALVINGS and points_per_cell(scans, finest / 2 ** (halvings + 1)) >= dense_points:
        halvings += 1
    finer = [0.5 ** (halvings - k) for k in range(halvings)]
    if not finer:
        return stages
    return tuple(
        replace(
            stage,
            sizes=(*(stage.sizes[0] * factor for factor in finer), *stage.sizes),
            plane_test=replace(stage.plane_test, alone_up_to=stage.sizes[0]),
        )
        for stage in stages
    )


def points_per_cell(scans: Scans, size: float) -> float:
    """How many points of a scan share a cell of edge `size` (m) with a typical point: median over points, then scans."""
    medians = []
    for each in _sampled(scans):
        points = geometry.finite(each)
        if len(points):
            cell = distinct_rows.number(np.floor(points / np.float32(size)).astype(np.int64))
            medians.append(float(np.median(np.bincount(cell)[cell])))
    return float(np.median(medians)) if medians else 0.0


def _sampled(scans: Scans) -> Iterator[np.ndarray]:
    """The points (N, 3) of a few scans, evenly spread."""
    step = max(1, len(scans) // _SAMPLED_SCANS)
    for first, last in zip(scans.offsets[:-1:step], scans.offsets[1::step], strict=True):
        yield scans.points[first:last]


def without_noisy(stages: tuple[Stage, ...], scans: Scans) -> tuple[Stage, ...]:
    """The stages without the cells that are too fine for the noise of single scans; the largest of each stage stay.

    Larger cells have more clutter in them, which looks like noise: the noise is no larger than it is in any smaller cell,
    and what is fine enough for some cells is for all larger.
    """
    sizes = sorted({size for stage in stages for size in stage.sizes})
    noise, fine = math.inf, sizes[-1]
    for size in sizes:
        noise = min(noise, range_noise(scans, 2 * size))
        if noise <= _NOISE_PER_EDGE * size:
            fine = size
            break
    return tuple(
        replace(stage, sizes=tuple(s for s in stage.sizes[:-1] if s >= fine) + stage.sizes[-1:])
        for stage in stages
    )


def range_noise(scans: Scans, size: float) -> float:
    """m, standard deviation of ranges: how far points of a single scan are off planes in cells of edge `size` (m), along
    the beams from the scan's origin; of those on plain surfaces (`_UNCLUTTERED`); 0 where no plane is seen. No pose has a
    part in it."""
    planes = _planes_of_scans(gather(list(_sampled(scans))), size)
    beams, _ = directions(planes.center, np.zeros(3))
    cosine = np.abs(np.sum(beams * planes.normal, axis=1))
    small, middle = planes.eigenvalues[:, 0], planes.eigenvalues[:, 1]
    seen = (
        (cosine > _FRONTAL) & (middle >= (_PLANE.spread * size) ** 2) & (small < _PLANE.finest_ratio * middle)
    )
    if not seen.any():
        return 0.0
    count = planes.total[seen]
    variance = small[seen] * count / (count - 3) / cosine[seen] ** 2
    return math.sqrt(weighted_quantile(variance, count, _UNCLUTTERED))


def _planes_of_scans(scans: Scans, size: float) -> PlaneFits:
    """The best plane of each scan's points in each cell, scan frame."""
    alone = np.tile(np.eye(4), (len(scans), 1, 1))
    level = voxel_map.build(scans, alone, (size,)).levels[0]
    full = np.flatnonzero(level.clusters.count >= _PLANE.min_points)
    offsets, one = np.arange(len(full) + 1), np.ones(len(full))
    clusters = level.clusters.take(full)
    return fit(PlaneFeatures(offsets, level.scan[full], clusters, one, size * one), alone)
