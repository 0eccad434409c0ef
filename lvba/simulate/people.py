"""People who walk about while a recording is made: boxes with stripes, seen by the camera and met by the LiDAR."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lvba.arrays import Vectors
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import RayCaster

_SIZE = np.array([0.5, 0.4, 1.75])
_ASIDE_M = (1.0, 3.5)
"""How far beside the path they walk."""
_AHEAD_M = 4.0
_WALK_M, _PERIOD_S = 2.0, (4.0, 9.0)
"""They go to and fro by so much, in so long."""
_STRIPES_PER_M = 4.0
_HELD_M = 1.5
"""How high above the ground the body is where nothing is below it."""


class Met(NamedTuple):
    """What rays meet first of all people. Arrays of one entry per ray."""

    distance: np.ndarray
    """(M,) float64, in lengths of the ray's direction; inf: nobody."""
    person: np.ndarray
    """(M,) int64"""
    normal: np.ndarray
    """(M, 3), scene frame, unit length."""
    color: np.ndarray
    """(M, 3), radiance."""


@dataclass(frozen=True)
class People:
    """Where each is over time; P people, scene frame.

    home, walk: (P, 3), m: the middle of the body in the middle of its walk, and how far it goes
    period, phase: (P,), s and rad; color: (P, 3), radiance
    """

    home: np.ndarray
    walk: np.ndarray
    period: np.ndarray
    phase: np.ndarray
    color: np.ndarray

    def __len__(self) -> int:
        return len(self.home)

    def center(self, moment: float) -> np.ndarray:
        """(P, 3), m, scene frame, at so many seconds since the start of the motion."""
        part = np.sin(2 * np.pi * moment / self.period + self.phase)
        return np.asarray(self.home + part[:, None] * self.walk)

    def meet(self, moment: float, origins: np.ndarray, directions: Vectors) -> Met:
        """Whom rays meet at a moment (s since the start of the motion).

        origins: (3,) or (M, 3) float64, m; directions: (M, 3); scene frame
        """
        count = len(directions)
        met = Met(np.full(count, np.inf), np.zeros(count, int), np.zeros((count, 3)), np.zeros((count, 3)))
        for number, center in enumerate(self.center(moment)):
            self._meet_one(number, np.broadcast_to(origins, (count, 3)) - center, directions, met)
        return met

    def _meet_one(self, number: int, origins: np.ndarray, directions: np.ndarray, met: Met) -> None:
        """Enters into `found` where this one is nearer. origins: relative to the middle of the body"""
        along = np.einsum("ij,ij->i", origins, directions) / np.einsum("ij,ij->i", directions, directions)
        apart = origins - along[:, None] * directions
        near = np.flatnonzero((along < 0) & (np.einsum("ij,ij->i", apart, apart) < (_SIZE @ _SIZE) / 4))
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / directions[near]
            planes = np.stack([(-_SIZE / 2 - origins[near]) * inverse, (_SIZE / 2 - origins[near]) * inverse])
        entry = np.nanmin(planes, axis=0)
        first, last = entry.max(axis=1), np.nanmax(planes, axis=0).min(axis=1)
        hit = (first > 0) & (first < last) & (first < met.distance[near])
        rays, axis = near[hit], entry[hit].argmax(axis=1)
        met.distance[rays] = first[hit]
        met.person[rays] = number
        met.normal[rays] = np.eye(3)[axis]
        place = origins[rays] + first[hit, None] * directions[rays]
        stripe = 0.75 + 0.25 * np.sign(np.sin(2 * np.pi * _STRIPES_PER_M * place[:, 2]))
        met.color[rays] = self.color[number] * (stripe * (1 - 0.15 * axis))[:, None]


def beside(motion: Motion, caster: RayCaster, count: int, rng: np.random.Generator) -> People:
    """So many people beside and ahead of the path of a motion, on what is below it, each walking to and fro."""
    moments = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / max(count, 1) * motion.duration
    poses = motion.poses(moments)
    aside = rng.choice([-1, 1], count) * rng.uniform(*_ASIDE_M, count)
    home = poses[:, :3, 3] + _AHEAD_M * poses[:, :3, 0] + aside[:, None] * poses[:, :3, 1]
    home[:, 2] = poses[:, 2, 3]
    below, _ = caster.cast(home, np.tile([0.0, 0.0, -1.0], (count, 1)))
    home[:, 2] += _SIZE[2] / 2 - np.where(np.isfinite(below), below, _HELD_M)
    heading = rng.uniform(0, 2 * np.pi, count)
    walk = _WALK_M * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    period, phase = rng.uniform(*_PERIOD_S, count), rng.uniform(0, 2 * np.pi, count)
    return People(home, walk, period, phase, rng.uniform(0.15, 0.8, (count, 3)))
