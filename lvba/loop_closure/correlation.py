"""Rough alignments of two patches of surfels, by correlation: all shifts at once, for a few turns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from lvba import geometry
from lvba.arrays import Pose, Vectors
from lvba.loop_closure.submap import Patch

_MOST_TURNS = 64
_TURNS_PER_SHIFT = 2
_LEAST_STEP_DEG = 3.0
_MOST_CELLS = 1 << 21
"""Cells of the grid in which patches are compared: it is made coarser where there would be more."""


@dataclass(frozen=True)
class Starts:
    """P rough alignments, best first.

    a_from_b: (P, 4, 4); score: (P,), correlation, 1 for the best possible
    """

    a_from_b: np.ndarray
    score: np.ndarray


def search(
    a: Patch, b: Patch, a_from_b: Pose, reach_m: float, reach_deg: float, cell: float, count: int
) -> Starts:
    """The best alignments within reach_m and reach_deg of a_from_b (4, 4), at most `count`.

    cell: m, of the grid in which surfels are compared.
    Surfels count by direction: what many of them share, such as the ground's normal, tells little (whitening).
    """
    shifts, turns = _grid(a, b, a_from_b, reach_m, cell), _turns(reach_deg)
    white = whitening(np.concatenate([a.normal, b.normal @ a_from_b[:3, :3].T]))
    spectrum = np.conj(fft.rfftn(shifts.fill(a.center, a.normal @ white), axes=(1, 2, 3)))
    peaks: list[tuple[float, np.ndarray, np.ndarray]] = []
    for turn in turns:
        pose = a_from_b @ geometry.exp(np.concatenate([turn, np.zeros(3)]))
        moved = b.moved(pose)
        other = fft.rfftn(shifts.fill(moved.center, moved.normal @ white), axes=(1, 2, 3))
        correlation = fft.irfftn((spectrum * other).sum(0), s=shifts.shape)
        for shift, score in shifts.peaks(correlation, reach_m, count):
            peaks.append((score, shift, shifts.undone(shift) @ pose))
    return _best(peaks, shifts.cell, count)


def _best(peaks: list[tuple[float, np.ndarray, np.ndarray]], cell: float, count: int) -> Starts:
    """The highest, no more than `_TURNS_PER_SHIFT` of them at about the same shift."""
    kept: list[int] = []
    for index in np.argsort([-score for score, _, _ in peaks], kind="stable").tolist():
        same = [k for k in kept if np.abs(peaks[k][1] - peaks[index][1]).max() < 1.5 * cell]
        if len(same) < _TURNS_PER_SHIFT:
            kept.append(index)
        if len(kept) == count:
            break
    poses = np.array([peaks[k][2] for k in kept]).reshape(-1, 4, 4)
    return Starts(poses, np.array([peaks[k][0] for k in kept]))


@dataclass(frozen=True)
class _Shifts:
    """A grid over both patches, large enough that none wraps around onto the other side.

    low: (3,) m, lowest corner; shape: cells; cell: m
    """

    low: np.ndarray
    shape: tuple[int, int, int]
    cell: float

    def fill(self, center: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """(3, *shape): mean of the vectors (K, 3) in each cell."""
        at = np.floor((center - self.low) / self.cell).astype(np.int64)
        inside = np.all((at >= 0) & (at < self.shape), axis=1)
        flat = np.ravel_multi_index(at[inside].T, self.shape)
        taken, which, count = np.unique(flat, return_inverse=True, return_counts=True)
        grid = np.zeros((3, *self.shape))
        for k in range(3):
            grid[k].reshape(-1)[taken] = np.bincount(which, vector[inside, k], len(taken)) / count
        return grid

    def undone(self, shift: np.ndarray) -> np.ndarray:
        """(4, 4), the motion that a peak at a shift (3,) asks for."""
        return geometry.from_rotation_translation(np.eye(3), -shift)

    def peaks(self, correlation: np.ndarray, reach: float, count: int) -> list[tuple[np.ndarray, float]]:
        """Shifts (3,), m, and correlation of the highest peaks within reach."""
        steps = [fft.fftfreq(n, 1 / n) * self.cell for n in self.shape]
        near = [np.flatnonzero(np.abs(s) <= reach + self.cell) for s in steps]
        steps = [s[index] for s, index in zip(steps, near, strict=True)]
        far = np.sqrt(sum(s**2 for s in np.meshgrid(*steps, indexing="ij", sparse=True)))
        inside = correlation[np.ix_(*near)]
        top = (inside >= _highest_about(correlation, near)) & (far <= reach + self.cell)
        where = np.argwhere(top)
        value = inside[top]
        best = np.argsort(-value, kind="stable")[:count]
        return [
            (np.array([steps[k][w[k]] for k in range(3)]), float(v)) for w, v in zip(where[best], value[best])
        ]


def _highest_about(values: np.ndarray, places: Sequence[np.ndarray]) -> np.ndarray:
    """The highest of values (X, Y, Z) in the 3 x 3 x 3 cells about each place; the grid continues at its other side.

    places: of each axis. Only they are looked at: most shifts of a large grid are out of reach.
    """
    for axis, index in enumerate(places):
        before, here, after = (values.take(index + step, axis, mode="wrap") for step in (-1, 0, 1))
        values = np.maximum(np.maximum(before, here), after)
    return values


def _grid(a: Patch, b: Patch, a_from_b: np.ndarray, reach: float, cell: float) -> _Shifts:
    both = np.concatenate([a.center, b.moved(a_from_b).center])
    low, high = both.min(0) - reach - 2 * cell, both.max(0) + reach + 2 * cell
    while np.prod(np.ceil((high - low) / cell)) > _MOST_CELLS:
        cell *= 1.25
    x, y, z = (fft.next_fast_len(int(n), real=True) for n in np.ceil((high - low) / cell))
    return _Shifts(low, (x, y, z), cell)


def _turns(reach_deg: float) -> np.ndarray:
    """Rotation vectors (T, 3), rad, evenly within a ball; the first is zero."""
    step = _LEAST_STEP_DEG
    while True:
        ticks = np.arange(-np.ceil(reach_deg / step), np.ceil(reach_deg / step) + 1) * step
        grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
        size = np.linalg.norm(grid, axis=1)
        grid = grid[size <= reach_deg + 1e-9]
        if len(grid) <= _MOST_TURNS:
            order = np.argsort(np.linalg.norm(grid, axis=1), kind="stable")
            return np.asarray(np.radians(grid[order]))
        step *= 1.1


def whitening(normal: Vectors) -> np.ndarray:
    """(3, 3), symmetric: normals times it have the same spread in all directions."""
    values, vectors = np.linalg.eigh(normal.T @ normal / max(len(normal), 1))
    scale = 1 / np.sqrt(np.maximum(values, 0.02 * values[-1]))
    return np.asarray((vectors * scale) @ vectors.T)
