"""Planes of cells fitted anew to the points near them in all cells, and how uneven what lies there is."""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.point_cluster import eigen3
from lvba.kernels.voxel import cell_of, morton

TURNS = 3
"""Fits: each gathers points by the plane of the one before."""
ALONG = 0.8
"""Least cosine between the normals of two planes whose points may lie on one surface: floor and wall are none."""
PATCH_POINTS = 40.0
"""Points of a patch that the surface's height is read off: their mean is known to a sixth of their noise."""
PATCH_MIN_M = 0.02
"""m, least edge of a patch: an image's patch covers as much."""
MOST_PATCHES = 64
"""Along one side of a plane."""
FEWEST = 5
"""Points of a patch whose height counts."""
MOST_POINTS = 100_000
"""Points looked at for one plane, about; of more, a regular part: their noise is far below what poses are known to."""
_FREEDOM = 3
"""Parameters of a plane."""
_TINY = 1e-300


class CellPoints(NamedTuple):
    """The points of C cells: cell c owns entries starts[c] to starts[c + 1], one for each scan in it, ascending; entry e
    owns order[first[e]] to order[first[e + 1]], indices of points.

    key: (C,) int64, Morton codes, ascending; starts: (C + 1,) int64; scan: (E,) int32; first: (E + 1,) int64; order: (M,)
    int32
    """

    key: np.ndarray
    starts: np.ndarray
    scan: np.ndarray
    first: np.ndarray
    order: np.ndarray


class LabeledPoints(NamedTuple):
    """The points of the map. world: (M, 3) float32, m; plane: (M,) int32, the plane that each lies on, -1: none"""

    world: np.ndarray
    plane: np.ndarray


class RoughPlanes(NamedTuple):
    """K planes, the cells that they are in, plane k in cells[starts[k]:starts[k + 1]], and how much a point of each scan
    counts on them: plane k has observations offsets[k] to offsets[k + 1], ascending in scan.

    center: (K, 3) float64, m; axes: (K, 3, 3) float64, columns: normal, then two along the plane; gate: (K,) float64, m,
    how far points of it may be off; starts: (K + 1,) int64; cells: int64; offsets: (K + 1,) int64; scan: (O,) int32;
    weight: (O,) float64
    """

    center: np.ndarray
    axes: np.ndarray
    gate: np.ndarray
    starts: np.ndarray
    cells: np.ndarray
    offsets: np.ndarray
    scan: np.ndarray
    weight: np.ndarray


class Refits(NamedTuple):
    """K planes, world frame. center: (K, 3) float64, m; eigenvalues: (K, 3) float64, m^2, ascending, 0: no points;
    eigenvectors: (K, 3, 3) float64, unit, rows, the first along the old normal; height: (K,) float64, m, root mean square
    of the heights of patches, less what noise makes; over_noise: (K,) float64, their squares over those that noise makes,
    NaN: too few patches to tell
    """

    center: np.ndarray
    eigenvalues: np.ndarray
    eigenvectors: np.ndarray
    height: np.ndarray
    over_noise: np.ndarray


@kernel
def order_points(
    offsets: np.ndarray, pair: np.ndarray, pair_starts: np.ndarray, entry_of: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`first` (E + 1,) int64 and `order` (M,) int32 of `CellPoints`, of the wanted entries; others are empty.

    offsets: (S + 1,) int64, scan s owns points offsets[s] to offsets[s + 1]; pair: (M,) int32, the (cell, scan) pair of
    each among those of its scan, -1: none; pair_starts: (S + 1,) int64; entry_of: (E,) int64, the entry of each pair;
    wanted: (E,) bool
    """
    first = np.zeros(len(entry_of) + 1, np.int64)
    for s in range(len(offsets) - 1):
        for i in range(offsets[s], offsets[s + 1]):
            if pair[i] >= 0:
                e = entry_of[pair_starts[s] + pair[i]]
                first[e + 1] += wanted[e]
    for e in range(len(entry_of)):
        first[e + 1] += first[e]
    free = first[:-1].copy()
    order = np.empty(first[-1], np.int32)
    for s in range(len(offsets) - 1):
        for i in range(offsets[s], offsets[s + 1]):
            if pair[i] >= 0:
                e = entry_of[pair_starts[s] + pair[i]]
                if wanted[e]:
                    order[free[e]] = i
                    free[e] += 1
    return first, order


@kernel
def _cells_about(key: np.ndarray, own: np.ndarray) -> np.ndarray:
    """The cells `own` (N,) int64 and all that touch them, ascending, each once: (n,) int64, numbers among key (C,)."""
    places = cell_of(key[own])
    codes = np.empty(27 * len(own), np.int64)
    n = 0
    for c in range(len(own)):
        for step in range(27):
            x = places[c, 0] + step % 3 - 1
            y = places[c, 1] + step // 3 % 3 - 1
            z = places[c, 2] + step // 9 - 1
            if x >= 0 and y >= 0 and z >= 0:
                codes[n] = morton(x, y, z)
                n += 1
    codes = codes[:n]
    codes.sort()
    out = np.empty(n, np.int64)
    at, last = 0, np.int64(-1)
    for code in codes:
        if code == last:
            continue
        last = code
        cell = np.searchsorted(key, code)
        if cell < len(key) and key[cell] == code:
            out[at] = cell
            at += 1
    return out[:at]


class _Patches(NamedTuple):
    """A grid of patches over a plane. low: (2,) float64, m; edge: (2,) float64, m; used: (n0, n1) bool"""

    low: np.ndarray
    edge: np.ndarray
    used: np.ndarray


@kernel
def _own_points(
    points: LabeledPoints, near: CellPoints, own: np.ndarray, k: int, center: np.ndarray, axes: np.ndarray
) -> np.ndarray:
    """(n, 2) m, along its axes from its center: the points of plane k. own: (N,) int64, its cells; center: (3,), m; axes:
    (3, 3), columns"""
    most = 0
    for c in own:
        most += near.first[near.starts[c + 1]] - near.first[near.starts[c]]
    out, n = np.zeros((most, 2)), 0
    for c in own:
        for j in range(near.first[near.starts[c]], near.first[near.starts[c + 1]]):
            i = near.order[j]
            if points.plane[i] != k:
                continue
            for a in range(2):
                for b in range(3):
                    out[n, a] += axes[b, a + 1] * (points.world[i, b] - center[b])
            n += 1
    return out[:n]


@kernel
def _patches_of(own: np.ndarray) -> _Patches:
    """The patches that points (n, 2), of `_own_points`, lie in."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(own)):
        for a in range(2):
            low[a], high[a] = min(low[a], own[i, a]), max(high[a], own[i, a])
    size, sides = np.zeros(2), np.ones(2, np.int64)
    if len(own) > 0:
        area = max(high[0] - low[0], PATCH_MIN_M) * max(high[1] - low[1], PATCH_MIN_M)
        edge = max(np.sqrt(area * PATCH_POINTS / len(own)), PATCH_MIN_M)
        for a in range(2):
            sides[a] = min(max(int((high[a] - low[a]) / edge), 1), MOST_PATCHES)
            # a little wider, so that the furthest point is in the last patch
            size[a] = max((high[a] - low[a]) / sides[a], 1e-6) * (1.0 + 1e-9)
    used = np.zeros((sides[0], sides[1]), np.bool_)
    for i in range(len(own)):
        used[int((own[i, 0] - low[0]) / size[0]), int((own[i, 1] - low[1]) / size[1])] = True
    return _Patches(low, size, used)


@kernel
def _points_over(
    points: LabeledPoints, near: CellPoints, cells: np.ndarray, k: int, planes: RoughPlanes, patches: _Patches
) -> np.ndarray:
    """Points over the used patches, within twice the gate of plane k: (n, 4) float64: along its normal and its axes from
    its center, m, and weight. cells: (N,) int64, where they are looked for."""
    scans = planes.scan[planes.offsets[k] : planes.offsets[k + 1]]
    weights = planes.weight[planes.offsets[k] : planes.offsets[k + 1]]
    usual = weights.mean()
    most = 0
    for c in cells:
        most += near.first[near.starts[c + 1]] - near.first[near.starts[c]]
    step = max(most // MOST_POINTS, 1)
    out = np.empty((most // step + 1, 4))
    center, axes, n, turn = planes.center[k], planes.axes[k], 0, 0
    sides = patches.used.shape
    for c in cells:
        for e in range(near.starts[c], near.starts[c + 1]):
            at = np.searchsorted(scans, near.scan[e])
            weight = weights[at] if at < len(scans) and scans[at] == near.scan[e] else usual
            for j in range(near.first[e], near.first[e + 1]):
                turn += 1
                if turn % step != 0:
                    continue
                i = near.order[j]
                d0 = points.world[i, 0] - center[0]
                d1 = points.world[i, 1] - center[1]
                d2 = points.world[i, 2] - center[2]
                height = axes[0, 0] * d0 + axes[1, 0] * d1 + axes[2, 0] * d2
                if abs(height) > 2.0 * planes.gate[k]:
                    continue
                u = axes[0, 1] * d0 + axes[1, 1] * d1 + axes[2, 1] * d2
                v = axes[0, 2] * d0 + axes[1, 2] * d1 + axes[2, 2] * d2
                at0, at1 = (u - patches.low[0]) / patches.edge[0], (v - patches.low[1]) / patches.edge[1]
                if at0 < 0.0 or at1 < 0.0 or at0 >= sides[0] or at1 >= sides[1]:
                    continue
                if not patches.used[int(at0), int(at1)]:
                    continue
                other = points.plane[i]
                if other >= 0 and other != k:
                    normal = planes.axes[other]
                    same = axes[0, 0] * normal[0, 0] + axes[1, 0] * normal[1, 0] + axes[2, 0] * normal[2, 0]
                    if same < ALONG:
                        continue
                out[n, 0], out[n, 1], out[n, 2], out[n, 3] = height, u, v, weight
                n += 1
    return out[:n]


@kernel(inline=True)
def off_plane(point: np.ndarray, plane: np.ndarray) -> float:
    """m, how far a point is off a plane, towards its normal.

    point: (3 or more,) float64, m; plane: (6,) float64, a point on it, m, and its unit normal
    """
    away = 0.0
    for a in range(3):
        away += plane[3 + a] * (point[a] - plane[a])
    return away


@kernel
def _fit(over: np.ndarray, gate: float, plane: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> float:
    """The plane of the points (n, 4) within `gate` of a plane, which it replaces; returns their weight.

    plane: (6,) float64, in and out, a point on it and its unit normal; values: (3,) float64, m^2, out; vectors: (3, 3)
    float64, rows, out; gate: m
    """
    total, mean, scatter = 0.0, np.zeros(3), np.zeros(6)
    for turn in range(2):
        for i in range(len(over)):
            if abs(off_plane(over[i], plane)) > gate:
                continue
            w = over[i, 3]
            if turn == 0:
                total += w
                for a in range(3):
                    mean[a] += w * over[i, a]
            else:
                x, y, z = over[i, 0] - mean[0], over[i, 1] - mean[1], over[i, 2] - mean[2]
                scatter[0] += w * x * x
                scatter[1] += w * x * y
                scatter[2] += w * x * z
                scatter[3] += w * y * y
                scatter[4] += w * y * z
                scatter[5] += w * z * z
        if total <= 0.0:
            return 0.0
        if turn == 0:
            mean /= total
    scatter /= total
    eigen3(scatter, values, vectors)
    sign = 1.0 if vectors[0, 0] >= 0.0 else -1.0
    for a in range(3):
        plane[a], plane[3 + a] = mean[a], sign * vectors[0, a]
    return total


@kernel
def _heights(over: np.ndarray, gate: float, plane: np.ndarray, patches: _Patches) -> tuple[float, float]:
    """`height` and `over_noise` of `Refits` for the plane (6,), by points (n, 4) within the gate, m, of it."""
    sides = patches.used.shape
    sums = np.zeros((sides[0] * sides[1], 3))
    for i in range(len(over)):
        away = off_plane(over[i], plane)
        if abs(away) > gate:
            continue
        at0 = int((over[i, 1] - patches.low[0]) / patches.edge[0])
        at1 = int((over[i, 2] - patches.low[1]) / patches.edge[1])
        own = sums[at0 * sides[1] + at1]
        own[0] += 1.0
        own[1] += away
        own[2] += away * away
    used, points, free, within, heights = 0, 0.0, 0.0, 0.0, 0.0
    for p in range(len(sums)):
        count = sums[p, 0]
        if count < FEWEST:
            continue
        used += 1
        points += count
        free += count - 1.0
        squares = sums[p, 1] * sums[p, 1] / count
        within += sums[p, 2] - squares
        heights += squares
    if used <= _FREEDOM:
        return 0.0, np.nan
    noise = within / free * (used - _FREEDOM)
    return np.sqrt(max(heights - noise, 0.0) / points), heights / max(noise, _TINY)


@parallel_kernel
def refit(points: LabeledPoints, near: CellPoints, planes: RoughPlanes) -> Refits:
    """Each plane fitted to all points over its patches, in its cells and those that touch them."""
    count = len(planes.center)
    center, values = planes.center.copy(), np.zeros((count, 3))
    vectors, height, over_noise = np.zeros((count, 3, 3)), np.zeros(count), np.full(count, np.nan)
    for k in prange(count):
        own = planes.cells[planes.starts[k] : planes.starts[k + 1]]
        axes, gate = planes.axes[k], planes.gate[k]
        patches = _patches_of(_own_points(points, near, own, k, planes.center[k], axes))
        over = _points_over(points, near, _cells_about(near.key, own), k, planes, patches)
        plane, own_values, own_vectors = np.zeros(6), np.zeros(3), np.zeros((3, 3))
        plane[3] = 1.0
        total = 0.0
        for _ in range(TURNS):
            total = _fit(over, gate, plane, own_values, own_vectors)
        if total <= 0.0:
            continue
        height[k], over_noise[k] = _heights(over, gate, plane, patches)
        values[k] = own_values
        for a in range(3):
            center[k, a] += axes[a, 0] * plane[0] + axes[a, 1] * plane[1] + axes[a, 2] * plane[2]
            # from the plane's own axes to those of the world
            vectors[k, 0, a] = axes[a, 0] * plane[3] + axes[a, 1] * plane[4] + axes[a, 2] * plane[5]
            for row in range(1, 3):
                vectors[k, row, a] = (
                    axes[a, 0] * own_vectors[row, 0]
                    + axes[a, 1] * own_vectors[row, 1]
                    + axes[a, 2] * own_vectors[row, 2]
                )
    return Refits(center, values, vectors, height, over_noise)
