"""Planes in cells that hold several surfaces, as the tread and the riser of a step: each point goes to one or to none."""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.plane_refit import CellPoints, off_plane
from lvba.kernels.point_cluster import add_squares, eigen3

MOST_PLANES = 3
"""Planes looked for in a cell: a corner has three."""
GATE = 3.0
"""Standard deviations that a point of a plane is off it at most."""
PARALLEL = 0.8
"""Cosine of two normals from which on points near both planes go to the nearer one; else they go to none."""
THICKEST = 1.2
"""Standard deviation of the points of a plane over that of points of a typical one, at most: a slice through leaves, of
the thickness of both gates, has 1.7."""
EXPLAINED = 0.75
"""Part of the points of a cell that lie on its planes, at least: else it holds clutter."""
THINNEST = 0.3
"""A plane is not taken for thinner than this part of the typical one."""
SPREAD = 0.1
"""Least standard deviation of a plane's points along its shorter side, over the cell's edge."""
_DRAWS = 60
_SIDES = 5
"""Parts of a cell along each edge, whose means the planes are drawn through: these have less noise than points have."""
_FEWEST_IN_PART = 3
_FITS = 5
_SEARCHED = 1024
"""Points of a cell among which planes are looked for, about; of more, a regular part."""
_LEAST_REST = 0.1
"""Part of a cell's points among which no further plane is looked for."""


class MixedTest(NamedTuple):
    """What counts as a plane. sigma: m, of a typical point about its plane; size: m, edge of a cell; min_points: fewest
    points; ratio: largest ratio of the smallest to the middle eigenvalue; max_tilt: rad, standard deviation of the normal
    """

    sigma: float
    size: float
    min_points: int
    ratio: float
    max_tilt: float


class Observations(NamedTuple):
    """Planes and the scans that see them, in the order of cells, then of planes, then of scans.

    plane: (O,) int64, MOST_PLANES times the cell and the plane's number in it, ascending; scan: (O,) int32; number:
    (O,) float64, of points; mean: (O, 3) float64, m, scan frame; scatter: (O, 6) float64, m^2, as of `PointClusters`
    """

    plane: np.ndarray
    scan: np.ndarray
    number: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray


@kernel
def _of_cell(
    near: CellPoints, points: np.ndarray, poses: np.ndarray, sensors: np.ndarray, c: int
) -> np.ndarray:
    """(n, 6) float64, m, world frame: the points of a cell, and where each was seen from."""
    low, high = near.starts[c], near.starts[c + 1]
    out = np.empty((near.first[high] - near.first[low], 6))
    n = 0
    for e in range(low, high):
        pose, sensor = poses[near.scan[e]], sensors[near.scan[e]]
        for j in range(near.first[e], near.first[e + 1]):
            p = points[near.order[j]]
            for a in range(3):
                out[n, a] = pose[a, 0] * p[0] + pose[a, 1] * p[1] + pose[a, 2] * p[2] + pose[a, 3]
                out[n, 3 + a] = sensor[a]
            n += 1
    return out


@kernel
def _fit(cell: np.ndarray, chosen: np.ndarray, plane: np.ndarray, values: np.ndarray) -> int:
    """The plane of the chosen points, plane (6,) and values (3,), m^2, out; returns their number.

    cell: (n, 6) float64; chosen: (n,) bool; a plane keeps the side of its normal
    """
    count, mean, scatter, vectors = 0, np.zeros(3), np.zeros(6), np.empty((3, 3))
    for i in range(len(cell)):
        if chosen[i]:
            count += 1
            for a in range(3):
                mean[a] += cell[i, a]
    if count < 4:
        return count
    mean /= count
    for i in range(len(cell)):
        if chosen[i]:
            x, y, z = cell[i, 0] - mean[0], cell[i, 1] - mean[1], cell[i, 2] - mean[2]
            add_squares(scatter, x, y, z)
    scatter /= count
    eigen3(scatter, values, vectors)
    same = vectors[0, 0] * plane[3] + vectors[0, 1] * plane[4] + vectors[0, 2] * plane[5]
    for a in range(3):
        plane[a], plane[3 + a] = mean[a], vectors[0, a] if same >= 0.0 else -vectors[0, a]
    return count


@kernel
def _parts(cell: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(m, 4) float64: points and mean, m, of the parts of a cell by its points that are left, (n,) bool."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(len(cell)):
        for a in range(3):
            low[a], high[a] = min(low[a], cell[i, a]), max(high[a], cell[i, a])
    edge = max(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / _SIDES * (1.0 + 1e-9) + 1e-9
    sums = np.zeros((_SIDES**3, 4))
    for i in range(len(cell)):
        if left[i]:
            part = 0
            for a in range(3):
                part = part * _SIDES + int((cell[i, a] - low[a]) / edge)
            sums[part, 0] += 1.0
            for a in range(3):
                sums[part, 1 + a] += cell[i, a]
    out, m = np.empty((_SIDES**3, 4)), 0
    for part in range(len(sums)):
        if sums[part, 0] >= _FEWEST_IN_PART:
            out[m, 0] = sums[part, 0]
            for a in range(3):
                out[m, 1 + a] = sums[part, 1 + a] / sums[part, 0]
            m += 1
    return out[:m]


@kernel(inline=True)
def _next(state: np.ndarray, below: int) -> int:
    """The next number of a linear congruential generator, state (1,) uint64 (Knuth, MMIX)."""
    state[0] = state[0] * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    return int((state[0] >> np.uint64(33)) % np.uint64(below))


@kernel
def _drawn(parts: np.ndarray, test: MixedTest, state: np.ndarray, plane: np.ndarray) -> bool:
    """The plane through the means of three parts that most points are near, plane (6,), out; False: there is none."""
    best, normal, one, other = 0.0, np.empty(3), np.empty(3), np.empty(3)
    for _ in range(_DRAWS):
        a, b, c = _next(state, len(parts)), _next(state, len(parts)), _next(state, len(parts))
        for k in range(3):
            one[k] = parts[b, 1 + k] - parts[a, 1 + k]
            other[k] = parts[c, 1 + k] - parts[a, 1 + k]
        for k in range(3):
            normal[k] = one[(k + 1) % 3] * other[(k + 2) % 3] - one[(k + 2) % 3] * other[(k + 1) % 3]
        area = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if area < (0.2 * test.size) ** 2:
            continue
        score = 0.0
        for m in range(len(parts)):
            away = 0.0
            for k in range(3):
                away += normal[k] * (parts[m, 1 + k] - parts[a, 1 + k])
            off = (away / (area * 2.0 * test.sigma)) ** 2
            if off < 1.0:
                score += parts[m, 0] * (1.0 - off)
        if score > best:
            best = score
            for k in range(3):
                plane[k], plane[3 + k] = parts[a, 1 + k], normal[k] / area
    return best > 0.0


@kernel
def _search(cell: np.ndarray, test: MixedTest, seed: int, planes: np.ndarray, values: np.ndarray) -> int:
    """Planes one after another, each of the points that those before it left; returns how many, 0: clutter.

    cell: (n, 6) float64; planes: (MOST_PLANES, 6) float64, out; values: (MOST_PLANES, 3) float64, m^2, out
    """
    n, count = len(cell), 0
    left, chosen = np.ones(n, np.bool_), np.zeros(n, np.bool_)
    state = np.full(1, np.uint64(seed), np.uint64)
    rest, gate = n, GATE * test.sigma
    while count < MOST_PLANES and rest >= max(float(test.min_points), _LEAST_REST * n):
        parts = _parts(cell, left)
        plane, points = planes[count], 0
        if len(parts) < 3 or not _drawn(parts, test, state, plane):
            break
        for _ in range(_FITS):
            for i in range(n):
                chosen[i] = left[i] and abs(off_plane(cell[i], plane)) < gate
            points = _fit(cell, chosen, plane, values[count])
            if points < 4:
                break
        if points < 4:
            break
        count += 1
        for i in range(n):
            if left[i] and abs(off_plane(cell[i], plane)) < gate:
                left[i] = False
                rest -= 1
    return count if n - rest >= EXPLAINED * n else 0


@kernel(inline=True)
def _gate(test: MixedTest, values: np.ndarray) -> float:
    """m, how far points of a plane are off it at most, by its own eigenvalues (3,)."""
    return GATE * min(max(np.sqrt(max(values[0], 0.0)), THINNEST * test.sigma), test.sigma)


@kernel
def _choose(
    cell: np.ndarray,
    test: MixedTest,
    planes: np.ndarray,
    values: np.ndarray,
    k: int,
    chosen: np.ndarray,
) -> None:
    """Which points lie on plane k and on no other, seen from the side from which most points are; chosen (n,) bool, out.

    cell: (n, 6) float64; planes: (K, 6) float64; values: (K, 3) float64, m^2
    """
    plane, gate, side = planes[k], _gate(test, values[k]), 0
    for i in range(len(cell)):
        side += 1 if off_plane(cell[i, 3:], plane) > 0.0 else -1
    sign = 1.0 if side >= 0 else -1.0
    for i in range(len(cell)):
        away = abs(off_plane(cell[i], plane))
        chosen[i] = away < gate and sign * off_plane(cell[i, 3:], plane) > 0.0
        for other in range(len(planes)):
            if not chosen[i] or other == k:
                continue
            cosine = 0.0
            for a in range(3):
                cosine += planes[other, 3 + a] * plane[3 + a]
            far = abs(off_plane(cell[i], planes[other]))
            if far < _gate(test, values[other]) and (abs(cosine) < PARALLEL or far < away):
                chosen[i] = False


@kernel
def _is_plane(test: MixedTest, count: int, values: np.ndarray) -> bool:
    """Whether so many points with these eigenvalues (3,), m^2, are a plane that tells something."""
    small, middle = max(values[0], 0.0), values[1]
    return (
        count >= test.min_points
        and small < test.ratio * middle
        and small <= test.max_tilt**2 * middle * count
        and small <= (THICKEST * test.sigma) ** 2
        and middle >= (SPREAD * test.size) ** 2
    )


@kernel
def _label_cell(cell: np.ndarray, test: MixedTest, seed: int, label: np.ndarray) -> None:
    """The plane of each point, label (n,) int8, out; -1: none. cell: (n, 6) float64"""
    planes, values = np.zeros((MOST_PLANES, 6)), np.zeros((MOST_PLANES, 3))
    step = max(len(cell) // _SEARCHED, 1)
    count = _search(cell[::step].copy(), test, seed, planes, values)
    chosen = np.zeros(len(cell), np.bool_)
    for k in range(count):
        for _ in range(2):
            _choose(cell, test, planes[:count], values[:count], k, chosen)
            points = _fit(cell, chosen, planes[k], values[k])
        if _is_plane(test, points, values[k]):
            for i in range(len(cell)):
                if chosen[i]:
                    label[i] = k


@parallel_kernel
def label(
    near: CellPoints, points: np.ndarray, poses: np.ndarray, sensors: np.ndarray, test: MixedTest
) -> np.ndarray:
    """The plane in its cell of each point of `near.order`, (M,) int8; -1: none.

    points: (N, 3) float32, m, scan frame; poses: (S, 4, 4) float64, world from scan; sensors: (S, 3) float64, m, world
    """
    out = np.full(len(near.order), np.int8(-1))
    for c in prange(len(near.key)):
        low, high = near.first[near.starts[c]], near.first[near.starts[c + 1]]
        if high - low >= 2 * test.min_points:
            cell = _of_cell(near, points, poses, sensors, c)
            _label_cell(cell, test, near.key[c], out[low:high])
    return out


@kernel
def observations(near: CellPoints, points: np.ndarray, labels: np.ndarray) -> Observations:
    """The point clusters of labeled points by plane and scan.

    points: (N, 3) float32, m, scan frame; labels: (M,) int8, of `near.order`, as of `label`
    """
    most = 0
    for e in range(len(near.scan)):
        seen = 0
        for j in range(near.first[e], near.first[e + 1]):
            if labels[j] >= 0:
                seen |= 1 << labels[j]
        most += (seen & 1) + (seen >> 1 & 1) + (seen >> 2 & 1)
    # one more: what is looked at after the last one is empty
    plane, scan = np.empty(most, np.int64), np.empty(most, np.int32)
    count, mean, scatter = np.zeros(most + 1), np.zeros((most + 1, 3)), np.zeros((most + 1, 6))
    at = 0
    for c in range(len(near.key)):
        for k in range(MOST_PLANES):
            for e in range(near.starts[c], near.starts[c + 1]):
                if _cluster(near, points, labels, e, k, at, count, mean, scatter):
                    plane[at], scan[at] = MOST_PLANES * c + k, near.scan[e]
                    at += 1
    return Observations(plane, scan, count[:most], mean[:most], scatter[:most])


@kernel
def _cluster(
    near: CellPoints,
    points: np.ndarray,
    labels: np.ndarray,
    e: int,
    k: int,
    at: int,
    count: np.ndarray,
    mean: np.ndarray,
    scatter: np.ndarray,
) -> bool:
    """Adds the points of an entry with label k to cluster `at` of count (O,), mean (O, 3) and scatter (O, 6), out;
    whether there are any."""
    for j in range(near.first[e], near.first[e + 1]):
        if labels[j] == k:
            count[at] += 1.0
            for a in range(3):
                mean[at, a] += points[near.order[j], a]
    if count[at] == 0.0:
        return False
    for a in range(3):
        mean[at, a] /= count[at]
    for j in range(near.first[e], near.first[e + 1]):
        if labels[j] == k:
            p = points[near.order[j]]
            add_squares(scatter[at], p[0] - mean[at, 0], p[1] - mean[at, 1], p[2] - mean[at, 2])
    return True
