"""Sorting a point cloud into blocks, and thinning it by a voxel grid."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel


@kernel
def transform(points: np.ndarray, world_from_points: np.ndarray, out: np.ndarray) -> None:
    """Writes the moved points into `out`. points, out: (N, 3) float32, m; world_from_points: (4, 4) float64."""
    m = world_from_points
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for a in range(3):
            out[i, a] = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]


@parallel_kernel
def cell_index(points: np.ndarray, low: np.ndarray, edge: float, shape: np.ndarray) -> np.ndarray:
    """The cell (N,) int32 of each point in a grid of `shape` cells from `low`; points outside go to the border cells.

    points: (N, 3) float32, m; low: (3,) float64, m; edge: m; shape: (3,) int64
    """
    cell = np.empty(points.shape[0], np.int32)
    for i in prange(points.shape[0]):
        index = 0
        for a in range(3):
            k = int(np.floor((np.float64(points[i, a]) - low[a]) / edge))
            index = index * shape[a] + min(max(k, 0), shape[a] - 1)
        cell[i] = index
    return cell


@kernel
def counting_order(cell: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The stable order (N,) int32 that sorts points by cell, and the (cells + 1,) int64 start of each cell.

    cell: (N,) int32
    """
    start = np.zeros(cells + 1, np.int64)
    for c in cell:
        start[c + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    fill = start[:-1].copy()
    order = np.empty(len(cell), np.int32)
    for i in range(len(cell)):
        order[fill[cell[i]]] = i
        fill[cell[i]] += 1
    return order, start


@parallel_kernel
def bounding_spheres(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Center of the bounding box and the radius round it, (B, 4) float32, of each block of points (none empty).

    points: (N, 3) float32, m; start: (B + 1,) int64, block b owns points start[b] to start[b + 1]
    """
    blocks = start.shape[0] - 1
    spheres = np.empty((blocks, 4), np.float32)
    for b in prange(blocks):
        low = np.full(3, np.inf, np.float32)
        high = np.full(3, -np.inf, np.float32)
        for i in range(start[b], start[b + 1]):
            for a in range(3):
                low[a] = min(low[a], points[i, a])
                high[a] = max(high[a], points[i, a])
        square = np.float32(0.0)
        for a in range(3):
            spheres[b, a] = np.float32(0.5) * (low[a] + high[a])
            half = np.float32(0.5) * (high[a] - low[a])
            square += half * half
        spheres[b, 3] = np.sqrt(square) * np.float32(1.0001)
    return spheres


@parallel_kernel
def thin_blocks(points: np.ndarray, order: np.ndarray, start: np.ndarray, voxel: float) -> np.ndarray:
    """Marks (N,) the point nearest to the center of each voxel; ties go to the lower index.

    order, start: points sorted into blocks whose borders are voxel borders.
    points: (N, 3) float32, m; order: (N,) int32; start: (B + 1,) int64; voxel: m
    """
    keep = np.zeros(points.shape[0], np.bool_)
    for b in prange(start.shape[0] - 1):
        first, count = start[b], start[b + 1] - start[b]
        if count == 0:
            continue
        base = np.empty(3, np.int64)
        for a in range(3):
            base[a] = np.int64(np.floor(np.float64(points[order[first], a]) / voxel)) - 1048576
        keys = np.empty(count, np.int64)
        distance = np.empty(count, np.float64)
        for k in range(count):
            key, square = np.int64(0), 0.0
            for a in range(3):
                x = np.float64(points[order[first + k], a]) / voxel
                whole = np.floor(x)
                key = key * 2097152 + (np.int64(whole) - base[a])
                square += (x - whole - 0.5) ** 2
            keys[k] = key
            distance[k] = square
        rank = np.argsort(keys, kind="mergesort")
        k = 0
        while k < count:
            best = rank[k]
            j = k + 1
            while j < count and keys[rank[j]] == keys[rank[k]]:
                if distance[rank[j]] < distance[best]:
                    best = rank[j]
                j += 1
            keep[order[first + best]] = True
            k = j
    return keep
