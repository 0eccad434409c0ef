"""The scenes by name: what stands where, and how one moves through it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lvba.errors import InputError
from lvba.simulate import blocks, cabinet, indoor, outdoor, site, stairs
from lvba.simulate.trajectories import Motion
from lvba.simulate.world import World


@dataclass(frozen=True)
class Scene:
    """A world and a motion through it, both in the scene frame."""

    world: World
    motion: Motion


SCENES: dict[str, Callable[[np.random.Generator, int, float | None], tuple[World, Motion]]] = {
    "courtyard": outdoor.courtyard,
    "rooms": indoor.rooms,
    "street": outdoor.street,
    "corridor": indoor.corridor,
    "plane": outdoor.plane,
    "block": blocks.block,
    "terrace": blocks.terrace,
    "cabinet": cabinet.cabinet,
    "site": site.site,
    "staircase": stairs.staircase,
}


def build(name: str, rng: np.random.Generator, frames: int, length: float | None) -> Scene:
    """The scene of that name, different for every state of `rng`.

    frames: how many will be taken: longer recordings go further; length: m, of a street, corridor, flight or way around
    Raises: InputError if there is no such scene.
    """
    if name not in SCENES:
        raise InputError("scene", f"there is no scene {name[:40]!r}", f"take one of {', '.join(SCENES)}")
    return Scene(*SCENES[name](rng, frames, length))
