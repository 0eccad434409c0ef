"""Clocks, gaps and jumps: what disturbs the times and the rough poses of a simulated recording."""

import numpy as np

from lvba import geometry
from lvba.arrays import Times, Vectors
from lvba.simulate.disturbances import Disturbances

_JUMP_M, _JUMP_DEG = 1.0, 2.0


def stamp_errors(times: Times, disturb: Disturbances, rng: np.random.Generator) -> np.ndarray:
    """(I,) s by which the stamps of images (I,), s, are too late."""
    duration = max(float(times[-1] - times[0]), 1e-9)
    drift = disturb.clock_drift * (times - times[0]) / duration
    return np.asarray(drift + disturb.stamp_jitter * rng.standard_normal(len(times)))


def with_gap(times: Times, gap: float) -> np.ndarray:
    """(S,) s, the same first and last, as many, and none during `gap` (s) in the middle."""
    first, last = float(times[0]), float(times[-1])
    part = (last - first - gap) / (last - first)
    middle = (first + last) / 2
    before = first + (times - first) * part
    return np.where(times < middle, before, before + gap)


def jumps(
    times: Times, other: Times, path: Vectors, disturb: Disturbances, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4, 4) and (M, 4, 4): by what the rough poses at (N,) and (M,) s have jumped until then, on the left.

    path: (N, 3), m, where the sensor is at the (N,) times: a jump turns the poses after it about the place where it is
    """
    count, span = round(disturb.jumps), float(times[-1] - times[0])
    when = np.sort(times[0] + span * rng.uniform(0.1, 0.9, count))
    moved = [np.eye(4)]
    for place in path[np.searchsorted(times, when)]:
        there = geometry.from_rotation_translation(np.eye(3), place)
        tangent = rng.normal(size=6)
        tangent[:3] *= np.radians(_JUMP_DEG) / np.linalg.norm(tangent[:3])
        tangent[3:] *= _JUMP_M / np.linalg.norm(tangent[3:])
        # the first to act on a pose is its own last jump, at a place that the jumps before it move
        moved.append(moved[-1] @ there @ geometry.exp(tangent) @ geometry.inverse(there))
    steps = np.array(moved)
    return steps[np.searchsorted(when, times)], steps[np.searchsorted(when, other)]
