"""Planes fitted anew to all points near them, whichever cell these are in, and how uneven the surfaces are.

The face of a cell that cuts a surface at a small angle cuts through the noise of its points, too: those above go to one
cell, those below to the next, and both planes are tilted and off by up to half a standard deviation of a point, however
many points there are. Source: ours; the cells are those of BALM2.
"""

from dataclasses import replace

import numpy as np

from lvba.kernels import plane_refit as kernels
from lvba.kernels.plane_refit import CellPoints, LabeledPoints, RoughPlanes
from lvba.lidar.plane import PlanePoints, Planes, axes_of
from lvba.lidar.voxel_map import Association, VoxelMap
from lvba.lidar.weights import Weights

SIGNIFICANT = 3.0
"""Squared heights of patches over those that noise makes, from which on a surface is not flat."""
OUTLYING = 3.0
"""A plane this many times as uneven as half of them is two surfaces in one layer of noise, a picture and its wall. What
all planes have, such as the errors of a depth camera, is no second surface."""


def refit(
    planes: Planes,
    points: PlanePoints,
    grid: VoxelMap,
    association: Association,
    weights: Weights,
    gate: np.ndarray,
) -> Planes:
    """The planes by all points within `gate` of them, over where their own points lie, and their unevenness.

    planes: of the association, each with its own points in `points`; weights: of its observations
    gate: (K,) float64, m
    """
    if not len(planes):
        return planes
    rough = _rough(planes, grid, association, gate, weights)
    near = _points_by_cell(points, grid)
    fits = kernels.refit(LabeledPoints(points.points_world, points.plane), near, rough)
    eigenvalues, axes = fits.eigenvalues, axes_of(fits.eigenvectors, fits.eigenvectors[:, 0])
    none = eigenvalues[:, 1] <= 0
    eigenvalues[none], axes[none] = planes.eigenvalues[none], planes.axes[none]
    return replace(
        planes,
        center=fits.center,
        normal=axes[:, :, 0].copy(),
        eigenvalues=eigenvalues,
        axes=axes,
        sigma_offset=_sigma_offset(planes, eigenvalues),
        unevenness=_unevenness(fits.height, fits.over_noise, gate),
    )


def _sigma_offset(planes: Planes, eigenvalues: np.ndarray) -> np.ndarray:
    """(K,) m, by the thickness that planes have now and the points of their own cells, as neighbors use the others."""
    grown = (eigenvalues[:, 0] - planes.eigenvalues[:, 0]) / np.maximum(planes.count, 1)
    variance = np.maximum(planes.sigma_offset**2 + grown, 0.5 * planes.sigma_offset**2)
    return np.asarray(np.sqrt(variance))


def _unevenness(height: np.ndarray, over_noise: np.ndarray, gate: np.ndarray) -> np.ndarray:
    """(K,) m; where a plane is two surfaces, either is anywhere in the layer that its points are from."""
    judged = np.isfinite(over_noise)
    typical = float(np.median(height[judged])) if judged.any() else 0.0
    mixed = judged & (over_noise > SIGNIFICANT) & (height > OUTLYING * typical)
    return np.where(mixed, gate, height)


def _rough(
    planes: Planes, grid: VoxelMap, association: Association, gate: np.ndarray, weights: Weights
) -> RoughPlanes:
    """The planes with the finest cells that their observations are from, and the weights of these."""
    level, features, observation = grid.levels[0], association.features, association.observation
    on = np.flatnonzero(observation >= 0)
    plane = features.feature[observation[on]].astype(np.int64)
    cells = len(level.key)
    both = np.unique(plane * cells + level.cell[level.entry_of[on]])
    return RoughPlanes(
        center=planes.center,
        axes=np.ascontiguousarray(planes.axes),
        gate=gate,
        starts=np.searchsorted(both // cells, np.arange(len(planes) + 1)).astype(np.int64),
        cells=both % cells,
        offsets=features.offsets,
        scan=features.scan,
        weight=weights.weight,
    )


def _points_by_cell(points: PlanePoints, grid: VoxelMap) -> CellPoints:
    """All points by finest cell and scan."""
    level = grid.levels[0]
    all_of_them = np.ones(len(level.scan), bool)
    first, order = kernels.order_points(
        points.scan_offsets, grid.pair, grid.pair_starts, level.entry_of, all_of_them
    )
    return CellPoints(level.key, level.starts, level.scan, first, order)
