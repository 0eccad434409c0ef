"""Scenes that test closing of loops: around a block and back to the start, and back through a street like the first."""

import numpy as np

from lvba import geometry
from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

_BLOCK_M_PER_FRAME = 2.0
_TERRACE_M_PER_FRAME = 1.5
_EYE_M = 1.7
_AGAIN_M = 8.0
"""How far the drive around the block continues past its start."""

_HALF_LANE_M, _PERIOD_M, _DEPTH_M, _HEIGHT_M = 3.0, 6.0, 2.5, 6.0
LANE_SPACING_M = 2 * (_HALF_LANE_M + _DEPTH_M)
"""From one lane of the terrace to the next, m: beyond it, all is repeated."""
_BEYOND_M = 60.0


def block(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A drive between houses around a block, back to its start and a little further.

    length: m, of the path; None: the scene's own
    """
    around = max(_BLOCK_M_PER_FRAME * frames if length is None else length, 80.0)
    half_x, half_y = 0.29 * around / 2, 0.21 * around / 2
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    begin = np.array([0.0, -half_y])
    end = begin + np.array([_AGAIN_M, 0])
    line = np.column_stack([[begin, *corners[1:], corners[0], end], np.full(6, _EYE_M)])
    motion = trajectories.along(line, 3.0, rng, rounding=2.5, sway=0.5)

    world = Builder(rng)
    reach = np.array([half_x, half_y]) + 40
    world.rectangle((*-reach, 0), (2 * reach[0], 0, 0), (0, 2 * reach[1], 0))
    for first, second in zip(corners, np.roll(corners, -1, axis=0)):
        along = (second - first) / np.linalg.norm(second - first)
        outward = np.array([along[1], -along[0]])
        _row(world, first - 20 * along, second + 20 * along, outward, depth=8.0)
        # those inside stop short of each other
        _row(world, first + 7 * along, second - 7 * along, -outward, depth=0.4 * half_y)
    return world.build(), motion


def _row(world: Builder, first: np.ndarray, second: np.ndarray, away: np.ndarray, depth: float) -> None:
    """Houses of all sorts along a street from first to second (2,), on its side towards `away` (2,)."""
    rng, along = world.rng, second - first
    length = float(np.linalg.norm(along))
    along = along / length
    yaw = float(np.arctan2(along[1], along[0]))
    at = 0.0
    while at < length - 3:
        width = min(rng.uniform(6, 14), length - at)
        front, height = 6.0 + rng.uniform(0, 2.0), rng.uniform(6, 12)
        middle = first + (at + width / 2) * along + (front + depth / 2) * away
        world.box((*middle, height / 2), (width, depth, height), yaw)
        for window in np.arange(at + 1.2, at + width - 1.2, rng.uniform(2.2, 3.2)):
            relief = rng.uniform(0.1, 0.5)
            for low in (1.9, 4.6):
                spot = first + window * along + (front - relief / 2) * away
                world.box((*spot, low), (1.2, relief, 1.5), yaw)
        if rng.random() < 0.5:
            parked = first + (at + width / 2) * along + rng.uniform(3.9, 4.4) * away
            world.box((*parked, 0.75), (rng.uniform(2, 4.2), 1.6, 1.5), yaw + rng.uniform(-0.12, 0.12))
        at += width + (rng.uniform(1, 4) if rng.random() < 0.3 else 0.0)


def terrace(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """Out through one lane and back through the next; all houses of all lanes are alike, down to their texture.

    The end is beside the start, a lane away, and looks exactly like it: nothing of one lane is seen from the other.
    length: m, of the path; None: the scene's own
    """
    travel = max(_TERRACE_M_PER_FRAME * frames if length is None else length, 60.0)
    far = 0.5 * (travel - LANE_SPACING_M)
    corners = [(0.0, 0.0), (far, 0.0), (far, LANE_SPACING_M), (0.0, LANE_SPACING_M)]
    motion = trajectories.along(
        np.array([(x, y, _EYE_M) for x, y in corners]), 3.0, rng, rounding=1.5, sway=0.5
    )
    world = Builder(rng)
    first = -np.ceil(_BEYOND_M / _PERIOD_M) * _PERIOD_M
    last = far + _BEYOND_M
    world.rectangle(
        (first - 20, -40, 0), (last - first + 40, 0, 0), (0, 80 + LANE_SPACING_M, 0), style=world.style()
    )
    house = len(world)
    _alike(world)
    one = slice(house, len(world))
    for lane in range(2):
        middle = lane * LANE_SPACING_M
        for x in np.arange(first, last, _PERIOD_M):
            for turned in (False, True):
                passage = turned != bool(lane) and abs(x + _PERIOD_M / 2 - far) < 1.2 * _PERIOD_M
                if not passage:
                    world.repeat(one, _placed(float(x), middle, turned))
    return world.without(one), motion


def _placed(x: float, middle: float, left: bool) -> np.ndarray:
    """scene_from_house, (4, 4): a house to the left or to the right of a lane."""
    turn = np.array([0, 0, np.pi if left else 0.0, 0, 0, 0])
    place = (x + (_PERIOD_M if left else 0.0), middle, 0.0)
    return np.asarray(geometry.from_rotation_translation(np.eye(3), np.array(place)) @ geometry.exp(turn))


def _alike(world: Builder) -> None:
    """The house that all others are copies of: 0 to its width in x, to the right of a lane along x."""
    front = -_HALF_LANE_M
    world.box((_PERIOD_M / 2, front - _DEPTH_M / 2, _HEIGHT_M / 2), (_PERIOD_M, _DEPTH_M, _HEIGHT_M))
    world.box((1.6, front + 0.5, 1.3), (2.2, 1.0, 2.6))
    world.box((4.4, front + 0.15, 1.6), (1.2, 0.3, 1.5))
    for x in (1.6, 4.4):
        world.box((x, front + 0.15, 4.6), (1.2, 0.3, 1.5))
