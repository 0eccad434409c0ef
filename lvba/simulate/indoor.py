"""Indoor scenes: rooms along a corridor, and a corridor that never ends."""

from itertools import pairwise

import numpy as np

from lvba.simulate import trajectories
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import Builder, World

_WALL_M = 0.1
_DOOR_M = (1.0, 2.1)
_FRAMES_PER_ROOM = 23
_CORRIDOR_M_PER_FRAME = 0.5


def rooms(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """A walk along a corridor and through doors into rooms; walls of 10 cm seen from both sides.

    length: m, of the path; None: the scene's own
    """
    visits = int(np.clip(round(frames / _FRAMES_PER_ROOM), 1, 12))
    world, plan = Builder(rng, bare=0.35), _Plan(rng, visits)
    walk = plan.walk()
    motion = trajectories.along(walk, 1.0, rng, rounding=0.25)
    _shell(world, plan)
    for room in plan.rooms:
        _furnish(world, room, plan, motion)
    return world.build(), motion


class _Room:
    """One room: its box in x and y, the side of the corridor (-1, 1), and the middle of its door."""

    def __init__(self, x0: float, x1: float, inner: float, outer: float, door: float) -> None:
        self.x0, self.x1, self.inner, self.outer, self.door = x0, x1, inner, outer, door
        self.side = 1.0 if outer > 0 else -1.0


class _Plan:
    """The ground plan: a corridor along x, two rows of rooms."""

    def __init__(self, rng: np.random.Generator, visits: int) -> None:
        self.rng, self.visits = rng, visits
        self.half_width, self.height = rng.uniform(0.85, 1.1), rng.uniform(2.5, 2.9)
        self.depth = {side: rng.uniform(3.8, 4.8) for side in (-1, 1)}
        per_side = max(1, int(np.ceil(visits / 2)) + (visits > 2))
        widths = {side: rng.uniform(3.6, 5.0, per_side) for side in (-1, 1)}
        self.length = float(max(widths[-1].sum(), widths[1].sum()))
        self.rooms: list[_Room] = []
        for side in (-1, 1):
            ends = np.r_[0, np.cumsum(widths[side] * self.length / widths[side].sum())]
            for x0, x1 in pairwise(ends):
                inner, outer = side * self.half_width, side * (self.half_width + self.depth[side])
                self.rooms.append(_Room(x0, x1, inner, outer, rng.uniform(x0 + 0.9, x1 - 0.9)))

    def walk(self) -> np.ndarray:
        """(C, 3) corners of a walk into `visits` rooms from one end of the corridor, and back to its start."""
        eye = 1.45
        order = sorted(self.rng.permutation(len(self.rooms))[: self.visits], key=lambda r: self.rooms[r].door)
        corners: list[tuple[float, float]] = [(0.7, 0.0)]
        for index in order:
            room = self.rooms[index]
            corners += [(room.door, 0.0), (room.door, room.inner + 0.55 * room.side)]
            corners += self._round(room)
            corners += [(room.door, room.inner + 0.55 * room.side), (room.door, 0.0)]
        corners += [(self.length - 0.8, 0.0), (self.length - 0.8, 0.15), (0.7, 0.1)]
        return np.array([(x, y, eye) for x, y in corners])

    def _round(self, room: _Room) -> list[tuple[float, float]]:
        """A loop inside a room, from its door around its middle."""
        middle = 0.5 * (room.x0 + room.x1), 0.5 * (room.inner + room.outer) + 0.15 * room.side
        reach = 0.5 * (room.x1 - room.x0) - 1.1, 0.5 * abs(room.outer - room.inner) - 1.15
        turn = self.rng.choice([-1.0, 1.0])
        angles = -room.side * np.pi / 2 + turn * np.linspace(0.5, 2 * np.pi - 0.5, 9)
        return [(middle[0] + reach[0] * np.cos(a), middle[1] + reach[1] * np.sin(a)) for a in angles]


def _shell(world: Builder, plan: _Plan) -> None:
    """Floor, ceiling and walls."""
    low, high = -plan.half_width - plan.depth[-1], plan.half_width + plan.depth[1]
    for z in (0.0, plan.height):
        world.rectangle((-0.5, low - 0.5, z), (plan.length + 1, 0, 0), (0, high - low + 1, 0))
    for end in (0.0, plan.length):
        _wall(world, plan, (end, low), (end, high))
    for y in (low, high):
        _wall(world, plan, (0.0, y), (plan.length, y))
    for room in plan.rooms:
        if room.x0 > 0:
            _wall(world, plan, (room.x0, room.inner), (room.x0, room.outer))
        _door_wall(world, plan, room)


def _wall(
    world: Builder, plan: _Plan, first: tuple[float, float], second: tuple[float, float], low: float = 0.0
) -> None:
    """An upright slab between two points of the plan, from `low` to the ceiling."""
    along = np.subtract(second, first)
    middle = np.add(first, second) / 2
    size = (float(np.linalg.norm(along)), _WALL_M, plan.height - low)
    world.box(
        (float(middle[0]), float(middle[1]), (plan.height + low) / 2),
        size,
        float(np.arctan2(along[1], along[0])),
    )


def _door_wall(world: Builder, plan: _Plan, room: _Room) -> None:
    """The wall between corridor and room, with a door opening and a frame that stands out on both sides."""
    half, top = _DOOR_M[0] / 2, _DOOR_M[1]
    _wall(world, plan, (room.x0, room.inner), (room.door - half, room.inner))
    _wall(world, plan, (room.door + half, room.inner), (room.x1, room.inner))
    _wall(world, plan, (room.door - half, room.inner), (room.door + half, room.inner), top)
    out = world.rng.uniform(0.02, 0.045)
    for x in (room.door - half - 0.03, room.door + half + 0.03):
        world.box((x, room.inner, top / 2), (0.08, _WALL_M + 2 * out, top))
    # a little less far out than the posts: no two faces share a plane where they overlap
    world.box((room.door, room.inner, top + 0.03), (_DOOR_M[0] + 0.12, _WALL_M + 1.7 * out, 0.08))


def _furnish(world: Builder, room: _Room, plan: _Plan, motion: Motion) -> None:
    """Cupboards, tables and posters at the walls, out of the way."""
    rng = world.rng
    path = motion.position(np.linspace(0, motion.duration, 4000))[:, :2]
    for _ in range(rng.integers(4, 8)):
        size = rng.uniform([0.5, 0.35, 0.4], [1.3, 0.6, 2.0])
        yaw = rng.uniform(-0.15, 0.15)
        spot = _at_a_wall(rng, room, size)
        reach = 0.5 * float(np.hypot(size[0], size[1]))
        door = np.hypot(spot[0] - room.door, spot[1] - room.inner)
        if np.linalg.norm(path - spot, axis=1).min() > reach + 0.35 and door > reach + 0.6:
            world.box((*spot, size[2] / 2), (size[0], size[1], size[2]), yaw)
    face = room.outer - room.side * _WALL_M / 2
    for _ in range(2):
        out = rng.uniform(0.015, 0.05)
        x = rng.uniform(room.x0 + 0.7, room.x1 - 0.7)
        world.box((x, face - room.side * out / 2, rng.uniform(1.3, 1.7)), (rng.uniform(0.5, 1), out, 0.7))
    y = room.inner + rng.uniform(0.35, 0.65) * (room.outer - room.inner)
    world.box((room.x0 + _WALL_M / 2 + 0.015, y, 1.5), (0.03, 0.8, 0.6))


def _at_a_wall(rng: np.random.Generator, room: _Room, size: np.ndarray) -> np.ndarray:
    """(2,): a place where a box of that size stands at the outer wall or a side wall."""
    y_low, y_high = sorted((room.inner, room.outer))
    gap = 0.12 + 0.5 * float(np.hypot(size[0], size[1]))
    x = rng.uniform(room.x0 + gap, room.x1 - gap)
    if rng.random() < 0.5:
        return np.array([x, room.outer - room.side * (0.15 + 0.5 * size[1])])
    return np.array([rng.choice([room.x0 + gap, room.x1 - gap]), rng.uniform(y_low + gap, y_high - gap)])


def corridor(rng: np.random.Generator, frames: int, length: float | None) -> tuple[World, Motion]:
    """Two walls, floor and ceiling without end: nothing but texture tells how far one went.

    length: m, of the path; None: the scene's own
    """
    length = _CORRIDOR_M_PER_FRAME * frames if length is None else length
    half, height, beyond = rng.uniform(1.1, 1.5), rng.uniform(2.5, 3.0), 500.0
    x = np.linspace(0, length, max(int(10 * length), 50))
    weave = 0.25 * np.sin(x / 4 + rng.uniform(0, 6))
    line = np.stack([x, weave, np.full(len(x), 1.4)], axis=-1)
    yaw = np.arctan(np.gradient(weave, x)) + 0.5 * np.sin(x / 5 + rng.uniform(0, 6))
    motion = trajectories.over_time(line, yaw, 1.0, rng, sway=1.0)
    world = Builder(rng)
    for z in (0.0, height):
        world.rectangle((-beyond, -half, z), (length + 2 * beyond, 0, 0), (0, 2 * half, 0))
    for y in (-half, half):
        world.rectangle((-beyond, y, 0), (length + 2 * beyond, 0, 0), (0, 0, height))
    return world.build(), motion
