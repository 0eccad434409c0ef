"""Rays of one map through the surfaces of another: a surface that is seen through is not there."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel

_CHUNK = 64


@kernel
def _meets(
    origin: np.ndarray,
    along: np.ndarray,
    center: np.ndarray,
    normal: np.ndarray,
    radius: float,
    cosine: float,
) -> float:
    """How far the disk is along a unit direction, where it is met at its front and not too aslant; -1: it is not."""
    toward, height, middle, reach = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        toward += normal[k] * along[k]
        height += normal[k] * (center[k] - origin[k])
        middle += along[k] * (center[k] - origin[k])
        reach += (center[k] - origin[k]) ** 2
    if toward > -cosine or reach - middle * middle > radius * radius:
        return -1.0
    t = height / toward
    off = 0.0
    for k in range(3):
        off += (origin[k] + t * along[k] - center[k]) ** 2
    return t if off <= radius * radius else -1.0


@parallel_kernel
def first_hit(
    origins: np.ndarray,
    ends: np.ndarray,
    margin: float,
    centers: np.ndarray,
    normals: np.ndarray,
    starts: np.ndarray,
    low: np.ndarray,
    shape: np.ndarray,
    cell: float,
    radius: float,
    cosine: float,
) -> np.ndarray:
    """The disk (R,) int32 that each ray meets first, at least `margin` after its origin and before its end; -1: none.

    origins, ends: (R, 3) float64, m; margin: m
    centers, normals: (K, 3) float64, disks of `radius` (m), in the order of the cells that hold their centers
    starts: (cells + 1,) int64: cell (i, j, k) owns the disks from starts[(i shape[1] + j) shape[2] + k]
    low: (3,) float64 m, lowest corner; shape: (3,) int64, cells; cell: m, edge
    cosine: least cosine between ray and normal of a disk that counts; disks are met at their front only
    A disk is found while the ray is in its cell or a neighbor of it: radius <= cell.
    """
    hits = np.full(len(origins), -1, np.int32)
    chunks = -(-len(origins) // _CHUNK)
    for chunk in prange(chunks):
        along, at = np.empty(3), np.empty(3, np.int64)
        for r in range(chunk * _CHUNK, min(len(origins), (chunk + 1) * _CHUNK)):
            length = 0.0
            for k in range(3):
                along[k] = ends[r, k] - origins[r, k]
                length += along[k] ** 2
            length = np.sqrt(length)
            if length <= 2 * margin:
                continue
            for k in range(3):
                along[k] /= length
            best = length - margin
            t = margin
            # steps of a cell, each looking at the cells around: no disk within reach of the ray is missed
            while t < best + cell:
                for k in range(3):
                    at[k] = int(np.floor((origins[r, k] + t * along[k] - low[k]) / cell))
                for i in range(max(at[0] - 1, 0), min(at[0] + 2, shape[0])):
                    for j in range(max(at[1] - 1, 0), min(at[1] + 2, shape[1])):
                        row = (i * shape[1] + j) * shape[2]
                        first, last = max(at[2] - 1, 0), min(at[2] + 2, shape[2])
                        if first >= last:
                            continue
                        for d in range(starts[row + first], starts[row + last]):
                            hit = _meets(origins[r], along, centers[d], normals[d], radius, cosine)
                            if margin <= hit < best:
                                best, hits[r] = hit, d
                t += cell
    return hits
