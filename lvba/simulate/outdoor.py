"""Outdoor scenes: a courtyard walked around, a street driven through, a field flown over."""

import numpy as np

from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

_EYE_M = 1.5
_STREET_M_PER_FRAME = 3.0
_FIELD_M_PER_FRAME = 0.8


def courtyard(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A loop in a yard between facades, back to its start; planes of many directions.

    length: m, of the path; None: the scene's own
    """
    half_x, half_y = rng.uniform(11, 13.5), rng.uniform(13.5, 16.5)
    angle = np.linspace(0, 2 * np.pi * 1.03, 2000) + rng.uniform(0, 2 * np.pi)
    wobble = 1 + 0.06 * np.sin(3 * angle + rng.uniform(0, 2 * np.pi))
    radius_x, radius_y = half_x - rng.uniform(4.2, 5.2), half_y - rng.uniform(4.5, 5.5)
    line = np.stack(
        [radius_x * wobble * np.cos(angle), radius_y * wobble * np.sin(angle), np.full(2000, _EYE_M)], axis=-1
    )
    tangent = np.unwrap(np.arctan2(np.gradient(line[:, 1]), np.gradient(line[:, 0])))
    # outwards and inwards in turn
    yaw = tangent + 0.55 * np.sin(3 * angle + rng.uniform(0, 2 * np.pi)) + rng.uniform(-0.3, 0.3)
    motion = trajectories.over_time(line, yaw, 1.0, rng, sway=1.0)

    world = Builder(rng)
    world.rectangle((-25, -28, 0), (50, 0, 0), (0, 56, 0))
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    corners += rng.uniform(-1.2, 1.2, (4, 2))
    for first, second in zip(corners, np.roll(corners, -1, axis=0)):
        _facade(world, first, second, rng.uniform(7, 10))
    _clutter(world, line[:, :2], half_x, half_y)
    return world.build(), motion


def _facade(world: Builder, first: np.ndarray, second: np.ndarray, height: float) -> None:
    """A wall with window frames that stand out, awnings and pillars; the yard lies to the left."""
    rng, along = world.rng, second - first
    length = float(np.linalg.norm(along))
    along = along / length
    inward = np.array([-along[1], along[0]])
    yaw = float(np.arctan2(along[1], along[0]))
    world.rectangle((*first, 0), (*(along * length), 0), (0, 0, height))
    at = rng.uniform(1.5, 3)
    while at < length - 1.5:
        depth = rng.uniform(0.1, 0.4)
        middle = first + at * along + 0.5 * depth * inward
        world.box((*middle, rng.uniform(1.6, 2.2)), (rng.uniform(0.9, 1.6), depth, 1.4), yaw)
        if rng.random() < 0.4:
            corner = (*(first + (at - 1) * along), 3.4)
            world.rectangle(corner, (*(2 * along), 0), (*(1.4 * inward), -rng.uniform(0.3, 0.9)))
        if rng.random() < 0.4:
            world.box((*(first + (at + 1.4) * along + 1.3 * inward), 1.7), (0.4, 0.4, 3.4), yaw + 0.4)
        at += rng.uniform(2.5, 4.0)


def _clutter(world: Builder, path: np.ndarray, half_x: float, half_y: float) -> None:
    """Boxes (some tilted) and ramps, none of them on the path."""
    rng, placed = world.rng, 0
    for _ in range(400):
        if placed == 22:
            break
        spot = rng.uniform([-half_x + 1, -half_y + 1], [half_x - 1, half_y - 1])
        size = rng.uniform([0.5, 0.5, 0.5], [2.2, 2.0, 2.4])
        reach = 0.5 * float(np.linalg.norm(size))
        if np.linalg.norm(path - spot, axis=1).min() < reach + 1.1:
            continue
        yaw = rng.uniform(0, np.pi)
        tilt = rng.uniform(-0.35, 0.35) if placed % 3 == 0 else 0.0
        world.box((*spot, 0.5 * size[2] - 0.05), (size[0], size[1], size[2]), yaw, tilt)
        placed += 1


def street(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A drive between houses; 3 m of street for every frame unless `length` (m) is given."""
    length = _STREET_M_PER_FRAME * frames if length is None else length
    x = np.linspace(0, length, max(int(8 * length), 50))
    weave = 0.5 * np.sin(x / 11 + rng.uniform(0, 6)) + 0.3 * np.sin(x / 23 + rng.uniform(0, 6))
    line = np.stack([x, weave, np.full(len(x), 1.7)], axis=-1)
    yaw = np.arctan(np.gradient(weave, x)) + rng.uniform(-0.1, 0.1)
    motion = trajectories.over_time(line, yaw, 3.0, rng, sway=0.5)

    world = Builder(rng)
    world.rectangle((-60, -40, 0), (length + 160, 0, 0), (0, 80, 0))
    for side in (-1, 1):
        at = -50 + rng.uniform(0, 5)
        while at < length + 70:
            width = rng.uniform(6, 14)
            _house(world, at, width, side)
            at += width + (rng.uniform(1, 4) if rng.random() < 0.3 else 0.0)
    _cross_wall(world, length + 95)
    _cross_wall(world, -58)
    return world.build(), motion


def _house(world: Builder, at: float, width: float, side: int) -> None:
    """A house with a set-back of its own, windows, and what stands before it."""
    rng = world.rng
    front = side * (6.5 + rng.uniform(0, 2.5))
    height, depth = rng.uniform(6, 12), 8.0
    world.box((at + width / 2, front + side * depth / 2, height / 2), (width, depth, height))
    for window in np.arange(at + 1.2, at + width - 1.2, rng.uniform(2.2, 3.2)):
        relief = rng.uniform(0.1, 0.5)
        world.box((window, front - side * relief / 2, rng.uniform(1.4, 2.4)), (1.2, relief, 1.5))
        world.box((window, front - side * relief / 2, rng.uniform(4.2, 5)), (1.2, relief, 1.5))
    if rng.random() < 0.6:
        center = (at + rng.uniform(2, width - 2), side * rng.uniform(3.9, 4.6), 0.75)
        world.box(center, (rng.uniform(2, 4.2), rng.uniform(1.5, 1.8), 1.5), rng.uniform(-0.12, 0.12))
    if rng.random() < 0.6:
        world.box((at, side * rng.uniform(4.6, 5.6), 3.0), (0.25, 0.25, 6.0), rng.uniform(0, 1.5))


def _cross_wall(world: Builder, x: float) -> None:
    world.rectangle((x, -40, 0), (0, 80, 0), (0, 0, 14))


def plane(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A flight over flat ground, looking down at a slant; nothing else is to be seen.

    length: m, of the path; None: the scene's own
    """
    length = _FIELD_M_PER_FRAME * frames if length is None else length
    x = np.linspace(-0.5 * length, 0.5 * length, max(int(8 * length), 50))
    weave = 0.06 * length * np.sin(x / (0.2 * length) + rng.uniform(0, 6))
    line = np.stack([x, weave, 10 + 1.0 * np.sin(x / (0.15 * length) + rng.uniform(0, 6))], axis=-1)
    yaw = 0.5 * np.sin(x / (0.25 * length) + rng.uniform(0, 6))
    motion = trajectories.over_time(line, yaw, 1.6, rng, sway=1.0, pitch=rng.uniform(1.05, 1.45))
    world = Builder(rng)
    size = length + 400
    world.rectangle((-size / 2, -size / 2, 0), (size, 0, 0), (0, size, 0))
    return world.build(), motion
