"""LiDAR scans: where the beams go, and what a sensor makes of what they hit."""

from collections.abc import Callable

import numpy as np

from lvba.simulate.world import RayCaster, World

RANGE_NOISE_M = 0.02
_MIN_RANGE_M = 0.3
_MAX_RANGE_M = 80.0
_RINGS = 32
_RING_ANGLES_DEG = (-25.0, 20.0)
_ROSETTE_ANGLE_DEG = 35.0
_ROSETTE_TURNS = (36.5, -23.3)
_DROPOUTS = 0.01
_MIXED = 0.05
"""Part of the points at an edge that lie between its near and far side."""
_EDGE_M = 0.2
_MIN_COSINE = 0.03
"""Beams that graze a surface more than this do not come back."""


def spinning(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count or fewer, 3) unit directions of 32 rings over 360 degrees, x forward; ring after ring.

    The first azimuth is random, so no scan repeats the one before.
    """
    columns = max(count // _RINGS, 1)
    azimuth = rng.uniform(0, 2 * np.pi) + np.arange(columns) * 2 * np.pi / columns
    elevation = np.radians(np.linspace(*_RING_ANGLES_DEG, _RINGS))
    return _directions(np.tile(azimuth, _RINGS), np.repeat(elevation, columns))


def non_repetitive(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) unit directions of a rosette within 35 degrees around x, as two turning prisms make it."""
    time = np.arange(count) / count
    phase = rng.uniform(0, 2 * np.pi, 2)
    half = np.radians(_ROSETTE_ANGLE_DEG) / 2
    angles = [2 * np.pi * turns * time + start for turns, start in zip(_ROSETTE_TURNS, phase)]
    azimuth = half * (np.cos(angles[0]) + np.cos(angles[1]))
    elevation = half * (np.sin(angles[0]) + np.sin(angles[1]))
    return _directions(azimuth, elevation)


PATTERNS: dict[str, Callable[[int, np.random.Generator], np.ndarray]] = {
    "spinning": spinning,
    "non_repetitive": non_repetitive,
}


def _directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    across = np.cos(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=-1)


def scan(
    caster: RayCaster,
    world: World,
    scene_from_lidar: np.ndarray,
    directions: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """The points (N, 3) float32, m, LiDAR frame, and intensities (N,) float32 of one deskewed scan.

    directions: (M, 3) unit vectors, LiDAR frame, neighbors in a row; beams without echo are left out
    """
    rays = directions @ scene_from_lidar[:3, :3].T
    distance, quad = caster.cast(scene_from_lidar[:3, 3], rays)
    cosine = np.abs(np.einsum("ij,ij->i", rays, world.normal[quad]))
    heard = (quad >= 0) & (cosine > _MIN_COSINE) & (rng.random(len(rays)) >= _DROPOUTS)
    heard &= (distance > _MIN_RANGE_M) & (distance < _MAX_RANGE_M)
    distance = _mix_at_edges(np.where(heard, distance, 0.0), np.where(heard, quad, -1), rng)
    distance = distance + rng.normal(0, RANGE_NOISE_M, len(rays))
    intensity = 100 * world.color[quad].mean(axis=1) * cosine
    points = directions * distance[:, None]
    return points[heard].astype(np.float32), intensity[heard].astype(np.float32)


def _mix_at_edges(distance: np.ndarray, quad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Distances (M,) where a few beams at edges end between the surfaces that they and their neighbor hit."""
    other, other_quad = np.roll(distance, 1), np.roll(quad, 1)
    edge = (quad >= 0) & (other_quad >= 0) & (quad != other_quad) & (np.abs(distance - other) > _EDGE_M)
    mixed = edge & (rng.random(len(distance)) < _MIXED)
    part = rng.random(len(distance))
    return np.where(mixed, distance + part * (other - distance), distance)
