"""From points to cells: the (cell, scan) clusters of a voxel grid, in one parallel pass over the scans.

Keys are Morton codes of 16 bits per axis: the parent of a cell is its key shifted by three bits, so that cells in the
order of their keys hold every coarser level as contiguous runs.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.hash_table import FREE, doubled, place_of
from lvba.kernels.morton import gather, spread
from lvba.kernels.point_cluster import (
    POINTS,
    Clusters,
    add_cluster,
    add_point,
    cluster_of_sums,
    eigen3,
    move_cluster,
)

AXIS_CELLS = 1 << 16
_FIRST_TABLE = 1 << 13


@kernel(inline=True)
def morton(x: Any, y: Any, z: Any) -> Any:
    """The int64 Morton code of three cell numbers in [0, 65536)."""
    return np.int64(spread(x) | (spread(y) << np.uint64(1)) | (spread(z) << np.uint64(2)))


@kernel
def cell_of(keys: np.ndarray) -> np.ndarray:
    """The cell numbers (N, 3) int64 of Morton codes (N,) int64.

    keys: (N,) int64, Morton codes
    """
    cells = np.empty((len(keys), 3), np.int64)
    for n in range(len(keys)):
        for axis in range(3):
            cells[n, axis] = np.int64(gather(np.uint64(keys[n]) >> np.uint64(axis)))
    return cells


@kernel
def _grow(table_key: np.ndarray, table_value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    keys, went = doubled(table_key)
    values = np.empty(len(keys), np.int32)
    for j in range(len(table_key)):
        if table_key[j] != FREE:
            values[went[j]] = table_value[j]
    return keys, values


@kernel
def _number(points: np.ndarray, pose: np.ndarray, scale: float, local: np.ndarray, keys: np.ndarray) -> int:
    """Fill one scan's part of `assign`'s outputs; returns its number of cells."""
    table_key = np.full(_FIRST_TABLE, FREE)
    table_value = np.empty(_FIRST_TABLE, np.int32)
    n = 0
    last_x, last_y, last_z, last = np.int64(-1), np.int64(-1), np.int64(-1), np.int32(-1)
    xx, xy, xz, x0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    yx, yy, yz, y0 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    zx, zy, zz, z0 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        gx = (xx * px + xy * py + xz * pz + x0) * scale
        gy = (yx * px + yy * py + yz * pz + y0) * scale
        gz = (zx * px + zy * py + zz * pz + z0) * scale
        # written so that NaN is outside
        inside = (
            gx >= 0.0 and gy >= 0.0 and gz >= 0.0 and gx < AXIS_CELLS and gy < AXIS_CELLS and gz < AXIS_CELLS
        )
        if not inside:
            local[i] = -1
            continue
        x, y, z = np.int64(gx), np.int64(gy), np.int64(gz)
        if x != last_x or y != last_y or z != last_z:
            last_x, last_y, last_z = x, y, z
            key = morton(x, y, z)
            h = place_of(table_key, key)
            if table_key[h] == FREE:
                table_key[h], table_value[h] = key, n
                keys[n] = key
                n += 1
                last = table_value[h]
                if 2 * n > len(table_key):
                    table_key, table_value = _grow(table_key, table_value)
            else:
                last = table_value[h]
        local[i] = last
    return n


@parallel_kernel
def assign(
    points: np.ndarray, offsets: np.ndarray, grid_from_scan: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number the cells that each scan's points fall in.

    points: (M, 3) float32, m, scan frame; offsets: (S + 1,) int64, scan s owns points offsets[s] to offsets[s + 1];
    grid_from_scan: (S, 4, 4) float64, the grid's cells start at the origin; size: edge, m.
    Points outside of [0, 65536) cells get -1.
    Returns (M,) int32 the point's cell among its scan's cells in order of first appearance; (M,) int64 whose entries
    from offsets[s] on are the Morton keys of scan s's cells; (S,) int64 the number of those cells.
    """
    scans = len(offsets) - 1
    local = np.empty(len(points), np.int32)
    keys = np.empty(len(points), np.int64)
    cells = np.zeros(scans, np.int64)
    for s in prange(scans):
        first, last = offsets[s], offsets[s + 1]
        cells[s] = _number(
            points[first:last], grid_from_scan[s], 1.0 / size, local[first:last], keys[first:last]
        )
    return local, keys, cells


@kernel
def order_pairs(
    keys: np.ndarray, offsets: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The (cell, scan) pairs that `assign` found, by cell in Morton order, then by scan.

    keys, cells: of `assign`; offsets: (S + 1,) int64.
    Returns key (C,) int64 ascending; starts (C + 1,) int64, cell c owns entries starts[c] to starts[c + 1]; scan (K,)
    int32 of each entry; entry (K,) int64 of each pair, pairs numbered scan after scan.
    """
    pairs = cells.sum()
    table_key, table_value = np.full(_FIRST_TABLE, FREE), np.empty(_FIRST_TABLE, np.int32)
    cell, sorted_keys, count = np.empty(pairs, np.int32), np.empty(pairs, np.int64), np.zeros(pairs, np.int64)
    n, k = 0, 0
    for s in range(len(cells)):
        for i in range(offsets[s], offsets[s] + cells[s]):
            h = place_of(table_key, keys[i])
            if table_key[h] == FREE:
                table_key[h], table_value[h], sorted_keys[n] = keys[i], n, keys[i]
                n += 1
                if 2 * n > len(table_key):
                    table_key, table_value = _grow(table_key, table_value)
                    h = place_of(table_key, keys[i])
            cell[k] = table_value[h]
            count[table_value[h]] += 1
            k += 1
    # few cells are sorted, not the many pairs
    order = np.argsort(sorted_keys[:n])
    starts, free = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    for c in range(n):
        starts[c + 1] = starts[c] + count[order[c]]
        free[order[c]] = starts[c]
    scan, entry = np.empty(pairs, np.int32), np.empty(pairs, np.int64)
    k = 0
    for s in range(len(cells)):
        for _ in range(cells[s]):
            entry[k] = free[cell[k]]
            scan[entry[k]] = s
            free[cell[k]] += 1
            k += 1
    return sorted_keys[:n][order], starts, scan, entry


@parallel_kernel
def accumulate(
    points: np.ndarray, offsets: np.ndarray, local: np.ndarray, starts: np.ndarray, entry: np.ndarray
) -> Clusters:
    """Clusters of the (cell, scan) pairs that `assign` numbered, in their scan's frame.

    points, offsets: as in `assign`; local: (M,) int32, -1: no cell; starts: (S + 1,) int64, scan s owns pairs starts[s]
    to starts[s + 1]; entry: (K,) int64, where each pair's cluster goes.
    They are in the order of entries.
    """
    total = starts[-1]
    count, mean, scatter = np.empty(total), np.empty((total, 3)), np.empty((total, 6))
    for s in prange(len(offsets) - 1):
        n = starts[s + 1] - starts[s]
        # sums about the cell's first point: no digits lost to the distance from the sensor
        origin = np.zeros((n, 3))
        sums = np.zeros((n, 10))
        for i in range(offsets[s], offsets[s + 1]):
            if local[i] < 0:
                continue
            cell, first = sums[local[i]], origin[local[i]]
            px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            if cell[POINTS] == 0.0:
                first[0], first[1], first[2] = px, py, pz
            x, y, z = px - first[0], py - first[1], pz - first[2]
            add_point(cell, x, y, z)
        for c in range(n):
            k = entry[starts[s] + c]
            count[k] = sums[c, POINTS]
            cluster_of_sums(sums[c], mean[k], scatter[k])
            for a in range(3):
                mean[k, a] += origin[c, a]
    return Clusters(count, mean, scatter)


_CHUNK = 64
"""Cells that a thread takes at a time."""


class Merged(NamedTuple):
    """G cells that finer ones were merged to, and E entries, one for each scan that a cell holds.

    starts: (G + 1,) int64, cell g owns entries starts[g] to starts[g + 1]; scan: (E,) int32; total, mean, scatter: (E,),
    see `Clusters`; entry_of: (finer entries,) int64, the entry that each went into
    """

    starts: np.ndarray
    scan: np.ndarray
    total: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray
    entry_of: np.ndarray


class CellPlanes(NamedTuple):
    """Planes of C cells and of their two sides; world frame. See `fit_cells`.

    side: (E,) int8, of each entry: 0 or 1, -1 where the cell holds too little; total: (C, 2) float64; scans: (C, 2) int32
    center: (C, 2, 3) float64, m; eigenvalues: (C, 2, 3) float64, m^2; normals: (C, 2, 3) float64, unit, towards the
    sensors
    """

    side: np.ndarray
    total: np.ndarray
    scans: np.ndarray
    center: np.ndarray
    eigenvalues: np.ndarray
    normals: np.ndarray


@parallel_kernel
def merge_cells(
    children: np.ndarray,
    starts: np.ndarray,
    scan: np.ndarray,
    scans: int,
    clusters: Clusters,
) -> Merged:
    """The next coarser cells: entries of children that share a scan merged, ascending in scan.

    children: (G + 1,) int64, cell g owns finer cells children[g] to children[g + 1]; starts, scan, clusters: of the
    finer cells, as in `fit_cells`; scans: how many there are
    """
    groups = len(children) - 1
    chunks = -(-groups // _CHUNK)
    size = np.zeros(groups + 1, np.int64)
    for chunk in prange(chunks):
        met = np.full(scans, -1)  # the last cell that each scan was met in
        for g in range(chunk * _CHUNK, min(groups, (chunk + 1) * _CHUNK)):
            for h in range(starts[children[g]], starts[children[g + 1]]):
                size[g + 1] += met[scan[h]] != g
                met[scan[h]] = g
    merged = np.cumsum(size)
    entries = merged[-1]
    out_scan = np.empty(entries, np.int32)
    out_count, out_mean, out_scatter = np.zeros(entries), np.zeros((entries, 3)), np.zeros((entries, 6))
    entry_of = np.empty(len(scan), np.int64)
    for chunk in prange(chunks):
        entry = np.full(scans, -1)  # the last entry of each scan: of this cell if it is not below its first
        for g in range(chunk * _CHUNK, min(groups, (chunk + 1) * _CHUNK)):
            n = merged[g]
            for h in range(starts[children[g]], starts[children[g + 1]]):
                if entry[scan[h]] < merged[g]:
                    entry[scan[h]] = merged[g]
                    out_scan[n] = scan[h]
                    n += 1
            out_scan[merged[g] : n].sort()
            for e in range(merged[g], n):
                entry[out_scan[e]] = e
            for h in range(starts[children[g]], starts[children[g + 1]]):
                e = entry[scan[h]]
                add_cluster(
                    out_count[e : e + 1], out_mean[e], out_scatter[e],
                    clusters.total[h], clusters.mean[h], clusters.scatter[h],
                )  # fmt: skip
                entry_of[h] = e
    return Merged(merged, out_scan, out_count, out_mean, out_scatter, entry_of)


@parallel_kernel
def fit_cells(
    starts: np.ndarray,
    scan: np.ndarray,
    poses: np.ndarray,
    sensor: np.ndarray,
    clusters: Clusters,
    min_points: int,
    two_sided: bool,
) -> CellPlanes:
    """Planes of each cell, one per side that a surface is seen from.

    starts: (C + 1,) int64, cell c owns entries starts[c] to starts[c + 1]; scan: (E,) int32; clusters: (E,), one scan's
    points in the cell, scan frame; poses: (S, 4, 4) float64, world_from_scan; sensor: (S, 3) float64, m, its positions in
    the world.
    The cell's own normal splits its entries by side first: both faces of a thin wall have that normal in common.
    """
    count, mean, scatter = clusters.total, clusters.mean, clusters.scatter
    cells = len(starts) - 1
    side = np.full(len(scan), np.int8(-1))
    total = np.zeros((cells, 2))
    scans = np.zeros((cells, 2), np.int32)
    center = np.zeros((cells, 2, 3))
    values = np.zeros((cells, 2, 3))
    normals = np.zeros((cells, 2, 3))
    for c in prange(cells):
        points = 0.0
        for e in range(starts[c], starts[c + 1]):
            points += count[e]
        if points < min_points:
            continue
        moved, turned = np.empty(3), np.empty(6)
        whole_count, whole_mean, sums = np.zeros(1), np.zeros(3), np.zeros(6)
        value, vector, n = np.empty(3), np.empty((3, 3)), np.empty(3)
        for e in range(starts[c], starts[c + 1]):
            move_cluster(poses[scan[e]], mean[e], scatter[e], moved, turned)
            add_cluster(whole_count, whole_mean, sums, count[e], moved, turned)
        for a in range(6):
            sums[a] /= whole_count[0]
        eigen3(sums, value, vector)
        n[:] = vector[0]
        for e in range(starts[c], starts[c + 1]):
            r, p, m = poses[scan[e]], sensor[scan[e]], mean[e]
            height = 0.0
            for a in range(3):
                height += n[a] * (p[a] - (r[a, 0] * m[0] + r[a, 1] * m[1] + r[a, 2] * m[2] + r[a, 3]))
            side[e] = 0 if height >= 0.0 or not two_sided else 1
            scans[c, side[e]] += 1
        for k in range(2):
            if scans[c, k] == 0:
                continue
            if scans[c, 1 - k] == 0:  # it is the whole cell
                total[c, k], center[c, k], values[c, k] = whole_count[0], whole_mean, value
            else:
                sums[:] = 0.0
                for e in range(starts[c], starts[c + 1]):
                    if side[e] == k:
                        move_cluster(poses[scan[e]], mean[e], scatter[e], moved, turned)
                        add_cluster(total[c, k : k + 1], center[c, k], sums, count[e], moved, turned)
                if total[c, k] < 3.0:
                    continue
                for a in range(6):
                    sums[a] /= total[c, k]
                eigen3(sums, values[c, k], vector)
            up = vector[0, 0] * n[0] + vector[0, 1] * n[1] + vector[0, 2] * n[2]
            sign = 1.0 if (up >= 0.0) == (k == 0) else -1.0
            for a in range(3):
                normals[c, k, a] = sign * vector[0, a]
    return CellPlanes(side, total, scans, center, values, normals)


@parallel_kernel
def label(
    points: np.ndarray,
    offsets: np.ndarray,
    poses: np.ndarray,
    pair: np.ndarray,
    pair_starts: np.ndarray,
    plane_of_pair: np.ndarray,
    center: np.ndarray,
    normal: np.ndarray,
    gate: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The points in the world (M, 3) float32 and the plane of each (M,) int32, -1: none or further off than gate (K,).

    points, offsets: as in `assign`; poses: (S, 4, 4) float64, world_from_scan; pair: (M,) int32, `local` of `assign`;
    pair_starts: (S + 1,) int64, scan s owns plane_of_pair[pair_starts[s]:pair_starts[s + 1]], int32; center, normal:
    (K, 3) float64, of the planes, world; gate: (K,) float64, m
    plane_of_pair: (K,) int32, -1: none; center: (K, 3) float64, m; normal: (K, 3) float64, unit
    """
    world = np.empty((len(points), 3), np.float32)
    plane = np.full(len(points), np.int32(-1))
    for s in prange(len(offsets) - 1):
        r = poses[s]
        for i in range(offsets[s], offsets[s + 1]):
            px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
            y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
            z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
            world[i, 0], world[i, 1], world[i, 2] = x, y, z
            if pair[i] < 0:
                continue
            k = plane_of_pair[pair_starts[s] + pair[i]]
            if k < 0:
                continue
            away = (
                normal[k, 0] * (x - center[k, 0])
                + normal[k, 1] * (y - center[k, 1])
                + normal[k, 2] * (z - center[k, 2])
            )
            if abs(away) <= gate[k]:
                plane[i] = k
    return world, plane
