"""The planes of the finished map, and which of them each point lies on."""

import numpy as np

from lvba.arrays import Poses, Vector
from lvba.kernels import voxel as kernel
from lvba.lidar import plane_refit
from lvba.lidar.plane import PlanePoints, Planes, axes_of
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.scan import Scans
from lvba.lidar.voxel_map import Association, VoxelMap
from lvba.lidar.weights import Weights

GATE = 3.0
"""Furthest that a point may be from its plane, in standard deviations of such distances."""


def extract(
    points: Scans,
    grid: VoxelMap,
    association: Association,
    weights: Weights,
    world_from_scan: Poses,
    sensor_position: Vector,
) -> tuple[Planes, PlanePoints]:
    """The planes of an association, and every point with its plane."""
    features = association.features.with_weight(weights.weight)
    fits = fit(features, world_from_scan)
    planes = _planes(features, fits, weights, world_from_scan, sensor_position)
    feature = features.feature
    plane_of_pair = np.where(association.observation >= 0, feature[association.observation], np.int32(-1))
    gate = GATE * np.sqrt(np.maximum(fits.eigenvalues[:, 0], weights.sigma**2))

    def labeled(planes: Planes) -> PlanePoints:
        world, plane = kernel.label(
            points.points,
            points.offsets,
            np.ascontiguousarray(world_from_scan),
            grid.pair,
            grid.pair_starts,
            plane_of_pair.astype(np.int32),
            planes.center,
            planes.normal,
            gate,
        )
        return PlanePoints(world, plane, points.offsets)

    planes = plane_refit.refit(planes, labeled(planes), grid, association, weights, gate)
    return planes, labeled(planes)


def _planes(
    features: PlaneFeatures,
    fits: PlaneFits,
    weights: Weights,
    world_from_scan: np.ndarray,
    sensor_position: np.ndarray,
) -> Planes:
    feature = features.feature
    sensor = world_from_scan[:, :3, :3] @ sensor_position + world_from_scan[:, :3, 3]
    height = np.einsum("oi,oi->o", fits.normal[feature], sensor[features.scan] - fits.center[feature])
    up = np.bincount(feature, height * features.clusters.count, len(features)) >= 0
    normal = np.where(up[:, None], fits.normal, -fits.normal)
    count = np.bincount(feature, features.clusters.count, len(features))
    fraction = features.clusters.count * features.weight / np.maximum(fits.total, 1e-300)[feature]
    offset = np.bincount(feature, (fraction * weights.offset_sigma) ** 2, len(features))
    return Planes(
        center=fits.center,
        normal=normal,
        eigenvalues=fits.eigenvalues,
        axes=axes_of(fits.eigenvectors, normal),
        count=np.round(count).astype(np.int64),
        scans=np.diff(features.offsets).astype(np.int32),
        size=features.size,
        sigma_offset=np.sqrt(np.maximum(fits.eigenvalues[:, 0], 0.0) / np.maximum(fits.total, 1.0) + offset),
        unevenness=np.zeros(len(features)),
    )
