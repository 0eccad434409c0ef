"""Eliminating the offset of every scene point's plane from the normal equations (Schur complement)."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.photometric import OFFSET

_CHUNK = 256


@parallel_kernel
def gather(
    gradient: np.ndarray, coupling: np.ndarray, starts: np.ndarray, precision: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each point's Hessian (P,), gradient (P,), and couplings with images (P + O, 7): references, then targets.

    gradient, coupling: (O, 15) of `photometric.assemble`; starts: (P + 1,) int64
    precision: (P,) float64 inverse variance of the offset's prior; offset: (P,) float64 its present value
    """
    points = len(starts) - 1
    hessian, own = np.empty(points), np.empty(points)
    entry = np.zeros((points + len(gradient), 7))
    chunks = -(-points // _CHUNK)
    for chunk in prange(chunks):
        for p in range(chunk * _CHUNK, min(points, (chunk + 1) * _CHUNK)):
            h, g = precision[p], precision[p] * offset[p]
            for o in range(starts[p], starts[p + 1]):
                h += coupling[o, OFFSET]
                g += gradient[o, OFFSET]
                for k in range(7):
                    entry[p, k] += coupling[o, k]
                    entry[points + o, k] = coupling[o, 7 + k]
            hessian[p], own[p] = h, g
    return hessian, own, entry


@parallel_kernel
def schur_blocks(
    entry: np.ndarray,
    hessian: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    point: np.ndarray,
    slots: np.ndarray,
) -> np.ndarray:
    """(B, 7, 7): what elimination takes off every block, `- sum of entry[first] entry[second]^T / hessian[point]`.

    first, second, point: (E,) int32, contributions in the order of their blocks; block b owns slots[b] to slots[b + 1]
    entry: (P + O, 7) float64 and hessian: (P,) float64, of `gather`; slots: (B + 1,) int64
    """
    blocks = np.zeros((len(slots) - 1, 7, 7))
    for b in prange(len(slots) - 1):
        for n in range(slots[b], slots[b + 1]):
            scale = 1.0 / hessian[point[n]]
            for i in range(7):
                left = scale * entry[first[n], i]
                for j in range(7):
                    blocks[b, i, j] -= left * entry[second[n], j]
    return blocks


@kernel
def contributions(
    starts: np.ndarray, reference: np.ndarray, target: np.ndarray, images: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What `schur_blocks` adds: first and second entry (E,) and point (E,) int32, and the block's key (E,) int64.

    Entries p (the reference of point p) and P + o (the target of observation o), the lower image first; the key is
    lower image * images + higher image.
    starts: (P + 1,) int64; reference: (P,) int32, image; target: (O,) int32, image
    """
    points = len(reference)
    total = 0
    for p in range(points):
        count = starts[p + 1] - starts[p] + 1
        total += count * (count + 1) // 2
    first, second = np.empty(total, np.int32), np.empty(total, np.int32)
    point, key = np.empty(total, np.int32), np.empty(total, np.int64)
    n = 0
    for p in range(points):
        for a in range(starts[p] - 1, starts[p + 1]):
            entry_a, image_a = (p, reference[p]) if a < starts[p] else (points + a, target[a])
            for b in range(a, starts[p + 1]):
                entry_b, image_b = (p, reference[p]) if b < starts[p] else (points + b, target[b])
                swap = image_a > image_b
                first[n], second[n] = (entry_b, entry_a) if swap else (entry_a, entry_b)
                key[n] = min(image_a, image_b) * np.int64(images) + max(image_a, image_b)
                point[n] = p
                n += 1
    return first, second, point, key


@kernel
def scatter(
    gradient: np.ndarray,
    entry: np.ndarray,
    pull: np.ndarray,
    reference: np.ndarray,
    target: np.ndarray,
    point: np.ndarray,
) -> None:
    """Takes `entry * pull` of every point and observation off the (I, 7) gradient of its image, in order.

    gradient: (I, 7) float64, in and out; entry: (P + O, 7) float64, of `gather`; pull: (P,) float64
    reference: (P,) int32, image; target: (O,) int32, image; point: (O,) int32
    """
    points = len(reference)
    for p in range(points):
        for k in range(7):
            gradient[reference[p], k] -= entry[p, k] * pull[p]
    for o in range(len(target)):
        for k in range(7):
            gradient[target[o], k] -= entry[points + o, k] * pull[point[o]]


@kernel
def add_blocks(sums: np.ndarray, where: np.ndarray, blocks: np.ndarray) -> None:
    """Adds block m to `sums[where[m]]`, in order.

    sums: (S, n, m) float64, in and out; where: (M,) int64; blocks: (M, n, m) float64
    """
    for m in range(len(where)):
        for i in range(blocks.shape[1]):
            for j in range(blocks.shape[2]):
                sums[where[m], i, j] += blocks[m, i, j]


@kernel
def take_squares(sums: np.ndarray, where: np.ndarray, vectors: np.ndarray) -> None:
    """Takes v v^T of every vector m (M, n) off `sums[where[m]]` (n, n), in order.

    sums: (S, n, n) float64, in and out; where: (M,) int64; vectors: (M, n) float64
    """
    for m in range(len(where)):
        for i in range(vectors.shape[1]):
            for j in range(vectors.shape[1]):
                sums[where[m], i, j] -= vectors[m, i] * vectors[m, j]
