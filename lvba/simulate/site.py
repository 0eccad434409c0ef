"""A compact site: houses and open squares within 100 m by 100 m, whose lanes are walked over and over."""

import numpy as np

from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

_HALF_M = 50.0
_LANES_M = np.linspace(-40.0, 40.0, 5)
_HOUSE_M = (10.5, 13.0)
"""Between lanes 20 m apart, these leave 7 m and more to walk in."""
_M_PER_FRAME = 0.5


def site(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A walk along the lanes of a site, each again as soon as none was walked less often: loops everywhere.

    length: m, of the path; None: half a meter for every frame
    """
    length = _M_PER_FRAME * frames if length is None else length
    corners = np.array(_walk(rng, length))
    motion = trajectories.along(corners, 1.4, rng, rounding=1.5)
    world = Builder(rng)
    world.rectangle((-_HALF_M, -_HALF_M, 0), (2 * _HALF_M, 0, 0), (0, 2 * _HALF_M, 0))
    for x in (-_HALF_M, _HALF_M):
        world.rectangle((x, -_HALF_M, 0), (0, 2 * _HALF_M, 0), (0, 0, rng.uniform(5, 9)))
        world.rectangle((-_HALF_M, x, 0), (2 * _HALF_M, 0, 0), (0, 0, rng.uniform(5, 9)))
    middles = 0.5 * (_LANES_M[1:] + _LANES_M[:-1])
    for number, (x, y) in enumerate((x, y) for x in middles for y in middles):
        (_square if number % 3 == 1 else _house)(world, x, y)
    return world.build(), motion


def _walk(rng: np.random.Generator, length: float) -> list[tuple[float, float, float]]:
    """Crossings one after another, over at least `length` m; never straight back, and towards where one was least."""
    last = len(_LANES_M) - 1
    here, before = (0, 0), (-1, -1)
    walked: dict[frozenset[tuple[int, int]], int] = {}
    crossed = np.zeros((last + 1, last + 1), int)
    corners, way = [here], 0.0
    while way < length:
        i, j = here
        near = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        near = [at for at in near if at != before and min(at) >= 0 and max(at) <= last]
        rng.shuffle(near)
        there = min(
            ((int(a), int(b)) for a, b in near),
            key=lambda at: (walked.get(frozenset((here, at)), 0), crossed[at]),
        )
        lane = frozenset((here, there))
        walked[lane] = walked.get(lane, 0) + 1
        crossed[there] += 1
        way += float(_LANES_M[1] - _LANES_M[0])
        before, here = here, there
        corners.append(here)
    sides = rng.uniform(-1.2, 1.2, (len(corners), 2))
    return [
        (float(_LANES_M[i] + a), float(_LANES_M[j] + b), 1.5)
        for (i, j), (a, b) in zip(corners, sides, strict=True)
    ]


def _house(world: Builder, x: float, y: float) -> None:
    """A house with windows that stand out on all sides."""
    rng = world.rng
    width, depth = rng.uniform(*_HOUSE_M, 2)
    height, yaw = rng.uniform(4, 9), rng.uniform(-0.05, 0.05)
    world.box((x, y, height / 2), (width, depth, height), yaw)
    for side in (-1, 1):
        for at in np.arange(-4.0, 4.1, rng.uniform(2.4, 3.4)):
            relief, level = rng.uniform(0.2, 0.6), rng.uniform(1.4, 2.4)
            world.box((x + at, y + side * depth / 2, level), (1.2, relief, 1.5), yaw)
            world.box((x + side * width / 2, y + at, level), (relief, 1.2, 1.5), yaw)


def _square(world: Builder, x: float, y: float) -> None:
    """An open square with boxes, some of them tilted."""
    rng = world.rng
    for number in range(6):
        size = rng.uniform([0.6, 0.6, 0.6], [2.4, 2.4, 2.6])
        spot = np.array([x, y]) + rng.uniform(-5, 5, 2)
        tilt = rng.uniform(-0.3, 0.3) if number % 3 == 0 else 0.0
        world.box((*spot, 0.5 * size[2] - 0.05), tuple(size), rng.uniform(0, np.pi), tilt)
