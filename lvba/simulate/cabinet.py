"""A thin box on a floor, walked round closely and from afar: its sides are often seen at a grazing angle."""

import numpy as np

from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

FLOOR = 0
"""The floor's rectangle in the world."""
SIDES = (3, 4, 5, 6)
"""The upright faces of the cabinet: two wide ones, two narrow ones."""
SIZE_M = (1.6, 0.1, 0.9)
"""Width, depth and height of the cabinet, which stands in the middle of the floor."""

_HALF_ROOM_M = (3.3, 2.9)
_HEIGHT_M = 2.6
_EYE_M = 1.45
_NEAR_M, _FAR_M = (1.9, 0.42), (2.3, 1.9)
"""Half axes of the rounds."""
_NEAR_TURN = 0.15
"""How far one turns from the way ahead to the cabinet in the near rounds."""
_PITCH = 0.5
"""How much one looks down, rad."""
FLOOR_STYLE = np.array([0.62, 0.36, 0.22, 0.5, 0.0])
CABINET_STYLE = np.array([0.24, 0.42, 0.62, 0.5, 0.0])
"""Mean radiance (red, green, blue), contrast, patches: floor and cabinet differ in hue wherever one looks."""


def cabinet(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A room with a thin cabinet in its middle; two rounds close to its sides, looking along them, one at a distance.

    length: m, of the path; None: the scene's own
    """
    world = Builder(rng)
    half_x, half_y = _HALF_ROOM_M
    world.rectangle((-half_x, -half_y, 0), (2 * half_x, 0, 0), (0, 2 * half_y, 0), FLOOR_STYLE)
    # a little into the floor: no two faces share a plane
    width, depth, height = SIZE_M
    world.box((0, 0, height / 2 - 0.005), (width, depth, height + 0.01), style=CABINET_STYLE)
    world.rectangle((-half_x, -half_y, _HEIGHT_M), (2 * half_x, 0, 0), (0, 2 * half_y, 0))
    for y in (-half_y, half_y):
        world.rectangle((-half_x, y, 0), (2 * half_x, 0, 0), (0, 0, _HEIGHT_M))
    for x in (-half_x, half_x):
        world.rectangle((x, -half_y, 0), (0, 2 * half_y, 0), (0, 0, _HEIGHT_M))
    _furnish(world)
    return world.build(), _rounds(rng)


def _furnish(world: Builder) -> None:
    """Cupboards and boards along the walls, so that scans hold in all directions."""
    rng, (half_x, half_y) = world.rng, _HALF_ROOM_M
    for side in (-1, 1):
        for x in (-2.2, -0.4, 1.7):
            size = rng.uniform([0.5, 0.3, 0.5], [1.1, 0.5, 2.0])
            y = side * (half_y - 0.05 - size[1] / 2)
            world.box((x + rng.uniform(-0.3, 0.3), y, size[2] / 2), tuple(size), rng.uniform(-0.1, 0.1))
        thick = rng.uniform(0.03, 0.08)
        world.box((side * (half_x - thick / 2), rng.uniform(-1, 1), rng.uniform(1.0, 1.5)), (thick, 1.1, 0.8))


def _rounds(rng: np.random.Generator) -> Motion:
    """Three rounds, counterclockwise; before the last one steps back and turns to the cabinet."""
    turn = np.linspace(0, 6.2 * np.pi, 4000) + rng.uniform(0, 2 * np.pi)
    away = np.clip((turn - turn[0] - 4.0 * np.pi) / (0.4 * np.pi), 0.0, 1.0)
    away = away * away * (3 - 2 * away)
    axes = [near + away * (far - near) for near, far in zip(_NEAR_M, _FAR_M, strict=True)]
    line = np.stack([axes[0] * np.cos(turn), axes[1] * np.sin(turn), np.full(len(turn), _EYE_M)], axis=-1)
    ahead = np.unwrap(np.arctan2(np.gradient(line[:, 1]), np.gradient(line[:, 0])))
    inward = np.unwrap(np.arctan2(-line[:, 1], -line[:, 0]))
    inward += 2 * np.pi * np.round((ahead[0] + np.pi / 2 - inward[0]) / (2 * np.pi))
    inside = _NEAR_TURN + away * (1 - _NEAR_TURN)
    yaw = (1 - inside) * ahead + inside * inward
    return trajectories.over_time(line, yaw, 0.8, rng, sway=1.0, pitch=_PITCH)
