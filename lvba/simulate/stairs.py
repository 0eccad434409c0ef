"""A stairwell: two flights for each storey, climbed to the top and down again; surfaces are near and many."""

import numpy as np

from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

_FRAMES_PER_STOREY = 45
_MOST_STOREYS = 8
_TREADS = 8
_EYE_M = 1.45
_SLAB_M = 0.25
_SPEED = 0.7
_ROUND_M = 0.4
"""How far onto a landing one goes before one turns to the next flight."""
_INTO_WALL_M = 0.05
"""How far slabs and steps go into the walls: no two faces share a plane."""


def staircase(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A walk up a stairwell and down again, by landings, doors and windows.

    length: m, of the path; not used: the number of frames decides how many storeys are climbed
    """
    well = _Well(rng, int(np.clip(round(frames / _FRAMES_PER_STOREY), 1, _MOST_STOREYS)))
    world = Builder(rng, bare=0.35)
    _shell(world, well)
    for half in range(2 * well.storeys):
        _flight(world, well, half)
    for half in range(2 * well.storeys + 1):
        _landing(world, well, half)
    up = _corners(well)
    return world.build(), trajectories.along(np.concatenate([up, up[-2::-1]]), _SPEED, rng, rounding=0.2)


class _Well:
    """The plan: flights along y, the even ones up at positive x, the odd ones back at negative x, landings at both ends.

    half: m, half the width of the well; gap: m, half of the space from flight to flight; low, high: m, y of the first
    and the last riser; depth: m, from wall to wall along y
    """

    def __init__(self, rng: np.random.Generator, storeys: int) -> None:
        self.storeys = storeys
        self.half, self.gap = rng.uniform(1.25, 1.5), rng.uniform(0.1, 0.25)
        self.tread, self.riser = rng.uniform(0.27, 0.3), rng.uniform(0.16, 0.18)
        self.low = rng.uniform(1.3, 1.6)
        self.high = self.low + _TREADS * self.tread
        self.depth = self.high + rng.uniform(1.25, 1.5)
        self.solid = bool(rng.random() < 0.5)
        """Whether a wall stands from flight to flight; else there are balustrades."""

    def level(self, half: int) -> float:
        """m, of the landing after so many flights."""
        return half * (_TREADS + 1) * self.riser

    def lane(self, half: int) -> float:
        """m, x of the middle of a flight."""
        return (1 if half % 2 == 0 else -1) * 0.5 * (self.half + self.gap)


def _corners(well: _Well) -> np.ndarray:
    """(C, 3): eyes of who climbs from the first landing to the last."""
    corners = [(well.lane(1), 0.6 * well.low, _EYE_M)]
    for half in range(2 * well.storeys):
        x, z = well.lane(half), well.level(half) + _EYE_M
        above, ends = well.level(half + 1) + _EYE_M, (well.low, well.high)
        (first, last), out = (ends, _ROUND_M) if half % 2 == 0 else (ends[::-1], -_ROUND_M)
        corners += [(x, first - out, z), (x, first, z), (x, last, above), (x, last + out, above)]
    corners.append((well.lane(1), 0.55 * well.low, well.level(2 * well.storeys) + _EYE_M))
    return np.array(corners)


def _shell(world: Builder, well: _Well) -> None:
    """Walls, ground, ceiling and what stands from flight to flight."""
    top = well.level(2 * well.storeys) + 2.6
    low = -_SLAB_M - 0.1
    for x in (-well.half, well.half):
        world.rectangle((x, 0, low), (0, well.depth, 0), (0, 0, top - low))
    for y in (0.0, well.depth):
        world.rectangle((-well.half, y, low), (2 * well.half, 0, 0), (0, 0, top - low))
    for z in (-_SLAB_M / 2, top):
        world.rectangle((-well.half, 0, z), (2 * well.half, 0, 0), (0, well.depth, 0))
    if well.solid:
        middle, long = 0.5 * (well.low + well.high), well.high - well.low - 0.1
        height = top - 2.6 + 1.0 - low
        world.box((0.0, middle, low + height / 2), (2 * well.gap, long, height))


def _flight(world: Builder, well: _Well, half: int) -> None:
    """Steps, and a balustrade beside them where no wall stands."""
    side = 1 if half % 2 == 0 else -1
    inner, outer = (
        side * (well.gap - (_INTO_WALL_M if well.solid else 0.0)),
        side * (well.half + _INTO_WALL_M),
    )
    x, width = 0.5 * (inner + outer), abs(outer - inner)
    style = world.style()
    for step in range(1, _TREADS + 1):
        along = (step - 0.5) * well.tread
        y = well.low + along if side > 0 else well.high - along
        top = well.level(half) + step * well.riser
        thick = well.riser + 0.15
        world.box((x, y, top - thick / 2), (width, well.tread, thick), style=style)
    if not well.solid:
        rise = well.level(half + 1) - well.level(half)
        run = well.high - well.low
        slope = side * np.arctan2(rise, run)
        z = well.level(half) + 0.5 * rise + 0.45
        world.box(
            (side * well.gap, 0.5 * (well.low + well.high), z), (0.05, np.hypot(rise, run), 0.8), tilt=slope
        )


def _landing(world: Builder, well: _Well, half: int) -> None:
    """A slab; a door or a window, a board and a box at its walls."""
    rng, level = world.rng, well.level(half)
    near, far = (-_INTO_WALL_M, well.low) if half % 2 == 0 else (well.high, well.depth + _INTO_WALL_M)
    size = (2 * (well.half + _INTO_WALL_M), far - near, _SLAB_M)
    world.box((0.0, 0.5 * (near + far), level - _SLAB_M / 2), size)
    wall, inward = (0.0, 1.0) if half % 2 == 0 else (well.depth, -1.0)
    out = rng.uniform(0.03, 0.08)
    if half % 2 == 0:
        _door(world, (rng.uniform(-0.5, 0.5), wall + inward * out / 2, level), out)
    else:
        world.box(
            (rng.uniform(-0.4, 0.4), wall + inward * out / 2, level + 1.5), (1.0, out, rng.uniform(0.8, 1.2))
        )
    for side in (-1, 1):
        thick = rng.uniform(0.02, 0.06)
        y = rng.uniform(near + 0.45, far - 0.45)
        world.box((side * (well.half - thick / 2), y, level + rng.uniform(1.2, 1.8)), (thick, 0.5, 0.7))
    height = rng.uniform(0.3, 0.8)
    corner = -np.sign(well.lane(half)) * (well.half - 0.2)
    world.box(
        (corner, wall + inward * 0.2, level + height / 2 - 0.01), (0.3, 0.3, height), rng.uniform(-0.2, 0.2)
    )


def _door(world: Builder, foot: tuple[float, float, float], out: float) -> None:
    """A door leaf and its frame, which stands out by `out` m."""
    x, y, level = foot
    for post in (-0.5, 0.5):
        world.box((x + post, y, level + 1.02), (0.1, out, 2.04))
    world.box((x, y, level + 2.09), (1.1, 0.9 * out, 0.1))
    world.box((x, y, level + 1.0), (0.88, 0.4 * out, 1.98))
