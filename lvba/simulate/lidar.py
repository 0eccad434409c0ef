"""LiDAR scans: where the beams go, and what a sensor makes of what they hit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lvba.arrays import Vectors
from lvba.simulate.disturbances import NONE, Disturbances
from lvba.simulate.people import People
from lvba.simulate.world import RayCaster, World

RANGE_NOISE_M = 0.02
_MIN_RANGE_M = 0.3
_MAX_RANGE_M = 80.0
_RINGS = 32
_RING_ANGLES_DEG = (-25.0, 20.0)
_ROSETTE_ANGLE_DEG = 35.0
_ROSETTE_TURNS = (36.5, -23.3)
_DEPTH_TANGENTS = (0.55, 0.42)
_DROPOUTS = 0.01
_MIXED = 0.05
"""Part of the points at an edge that lie between its near and far side."""
_EDGE_M = 0.2
_OFF_MIRROR_M = 0.01
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


def depth_camera(count: int, rng: np.random.Generator) -> np.ndarray:
    """(about count, 3) unit directions of the pixels of a depth image, x forward; row after row from the top.

    Rows begin anywhere within a pixel, so no scan repeats the one before.
    """
    rows = max(round(np.sqrt(count * _DEPTH_TANGENTS[1] / _DEPTH_TANGENTS[0])), 1)
    columns = max(round(count / rows), 1)
    left = _DEPTH_TANGENTS[0] * (1 - 2 * (np.arange(columns) + rng.uniform()) / columns)
    up = _DEPTH_TANGENTS[1] * (1 - 2 * (np.arange(rows) + rng.uniform()) / rows)
    beams = np.stack([np.ones(rows * columns), np.tile(left, rows), np.repeat(up, columns)], axis=-1)
    return np.asarray(beams / np.linalg.norm(beams, axis=1, keepdims=True))


SWEEP_S = 0.1
"""How long a scan takes."""


def row_times(directions: Vectors, readout: float) -> np.ndarray:
    """(N,) s at which a depth camera that reads its rows in `readout` (s) sees its beams (N, 3); the middle one: 0."""
    return np.asarray(
        (0.5 - (directions[:, 2] / directions[:, 0] + _DEPTH_TANGENTS[1]) / (2 * _DEPTH_TANGENTS[1]))
        * readout
    )


def beam_times(pattern: str, count: int) -> np.ndarray:
    """(count,) s at which the beams of a scan of a pattern leave, relative to its end, which is its stamp."""
    if pattern == "spinning":
        columns = max(count // _RINGS, 1)
        return np.tile((np.arange(columns) + 1) / columns - 1, _RINGS)[:count] * SWEEP_S
    return ((np.arange(count) + 1) / count - 1) * SWEEP_S


PATTERNS: dict[str, Callable[[int, np.random.Generator], np.ndarray]] = {
    "spinning": spinning,
    "non_repetitive": non_repetitive,
    "depth_camera": depth_camera,
}


def _directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    across = np.cos(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=-1)


@dataclass(frozen=True)
class Surroundings:
    """What beams can meet."""

    world: World
    caster: RayCaster
    people: People | None = None
    mirror: np.ndarray | None = None
    """(Q,) bool: rectangles that reflect beams."""
    leafy: np.ndarray | None = None
    """(Q,) bool: rectangles that beams go into."""


class _Echoes(NamedTuple):
    """What beams met; one entry per beam."""

    distance: np.ndarray
    surface: np.ndarray
    """Number of the rectangle; -1: nothing, -2 and below: a person."""
    cosine: np.ndarray
    """Of the angle of incidence, 0 to 1."""
    brightness: np.ndarray
    """Mean radiance of the surface."""


def scan(
    around: Surroundings,
    scene_from_lidar: np.ndarray,
    directions: Vectors,
    rng: np.random.Generator,
    disturb: Disturbances = NONE,
    moment: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points (N, 3) float32, m, LiDAR frame, intensities (N,) float32, and the numbers (N,) of the beams of one scan.

    scene_from_lidar: (4, 4) float64, or (M, 4, 4) where the sensor moves; points are relative to where it was at each
    beam
    directions: (M, 3) unit vectors, LiDAR frame, neighbors in a row; beams without echo are left out
    moment: s since the start of the motion, which tells where people are
    """
    aimed = _raised(directions, disturb.elevation_bias)
    if scene_from_lidar.ndim == 2:
        rays = aimed @ scene_from_lidar[:3, :3].T
    else:
        rays = np.einsum("nij,nj->ni", scene_from_lidar[:, :3, :3], aimed)
    echoes = _echoes(around, scene_from_lidar[..., :3, 3], rays, moment)
    heard = (echoes.surface != -1) & (echoes.cosine > _MIN_COSINE) & (rng.random(len(rays)) >= _DROPOUTS)
    heard &= (echoes.distance > _MIN_RANGE_M) & (echoes.distance < _MAX_RANGE_M)
    distance = np.where(heard, echoes.distance, 0.0)
    distance = _mix_at_edges(distance, np.where(heard, echoes.surface, -1), rng)
    distance = distance + rng.normal(0, RANGE_NOISE_M, len(rays))
    distance = _measured(distance, directions, echoes, disturb)
    # draws of their own, so that a clean scan does not depend on what may be added to it
    distance = _by_chance(distance, echoes, around.leafy, disturb, rng.spawn(1)[0])
    intensity = 100 * echoes.brightness * echoes.cosine
    points = directions * distance[:, None]
    return points[heard].astype(np.float32), intensity[heard].astype(np.float32), np.flatnonzero(heard)


def _raised(directions: np.ndarray, angle_deg: float) -> np.ndarray:
    """Unit vectors (M, 3) turned up from the plane across z by an angle."""
    if not angle_deg:
        return directions
    across = np.hypot(directions[:, 0], directions[:, 1])
    elevation = np.arctan2(directions[:, 2], across) + np.radians(angle_deg)
    return _directions(np.arctan2(directions[:, 1], directions[:, 0]), elevation)


def _echoes(around: Surroundings, center: np.ndarray, rays: np.ndarray, moment: float) -> _Echoes:
    world = around.world
    distance, quad = around.caster.cast(center, rays)
    cosine = np.abs(np.einsum("ij,ij->i", rays, world.normal[quad]))
    echoes = _Echoes(distance, quad, cosine, world.color[quad].mean(axis=1))
    if around.mirror is not None:
        echoes = _reflected(around, center, rays, echoes)
    if around.people is not None:
        met = around.people.meet(moment, center, rays)
        nearer = met.distance < echoes.distance
        on_them = np.abs(np.einsum("ij,ij->i", rays, met.normal))
        echoes = _Echoes(
            np.where(nearer, met.distance, echoes.distance),
            np.where(nearer, -2 - met.person, echoes.surface),
            np.where(nearer, on_them, echoes.cosine),
            np.where(nearer, met.color.mean(axis=1), echoes.brightness),
        )
    return echoes


def _reflected(around: Surroundings, center: np.ndarray, rays: np.ndarray, direct: _Echoes) -> _Echoes:
    """Beams that meet a mirror continue from there, and come back the same way: longer, along their first direction."""
    assert around.mirror is not None
    world = around.world
    [hit] = np.nonzero(_on(around.mirror, direct.surface))
    normal = world.normal[direct.surface[hit]]
    place = np.broadcast_to(center, rays.shape)[hit] + direct.distance[hit, None] * rays[hit]
    onward = rays[hit] - 2 * np.einsum("ij,ij->i", rays[hit], normal)[:, None] * normal
    more, quad = around.caster.cast(place + _OFF_MIRROR_M * onward, onward)
    distance, surface, cosine, brightness = (column.copy() for column in direct)
    distance[hit] += _OFF_MIRROR_M + more
    surface[hit] = quad
    cosine[hit] = np.abs(np.einsum("ij,ij->i", onward, world.normal[quad]))
    brightness[hit] = world.color[quad].mean(axis=1)
    return _Echoes(distance, surface, cosine, brightness)


def _measured(
    distance: np.ndarray, directions: np.ndarray, echoes: _Echoes, disturb: Disturbances
) -> np.ndarray:
    """Distances (M,) with what is systematically wrong of them."""
    factor = 1.0 + disturb.range_scale
    if disturb.depth_distortion:
        ahead = np.maximum(directions[:, 0], np.sqrt(0.5))
        factor = factor + disturb.depth_distortion * (1 / ahead**2 - 1)
    bias = disturb.intensity_bias * (echoes.brightness - 0.5) + disturb.incidence_bias * (1 - echoes.cosine)
    return np.asarray(distance * factor + bias)


def _on(chosen: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """(M,) bool: beams that met one of some surfaces. chosen: (R,) bool; surface: (M,) int, as `_Echoes.surface`"""
    met = surface >= 0
    met[met] = chosen[surface[met]]
    return met


def _by_chance(
    distance: np.ndarray,
    echoes: _Echoes,
    leafy: np.ndarray | None,
    disturb: Disturbances,
    rng: np.random.Generator,
) -> np.ndarray:
    """Distances (M,) with what differs from beam to beam."""
    count = len(distance)
    if disturb.range_noise:
        distance = distance + rng.normal(0, disturb.range_noise, count)
    if leafy is not None:
        distance = distance + _on(leafy, echoes.surface) * rng.exponential(disturb.foliage, count)
    if disturb.rain:
        drop = rng.random(count) < disturb.rain
        distance = np.where(drop, distance * rng.uniform(0.05, 1.0, count), distance)
    return distance


def _mix_at_edges(distance: np.ndarray, quad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Distances (M,) where a few beams at edges end between the surfaces that they and their neighbor hit."""
    other, other_quad = np.roll(distance, 1), np.roll(quad, 1)
    edge = (quad != -1) & (other_quad != -1) & (quad != other_quad) & (np.abs(distance - other) > _EDGE_M)
    mixed = edge & (rng.random(len(distance)) < _MIXED)
    part = rng.random(len(distance))
    return np.where(mixed, distance + part * (other - distance), distance)
