"""Robust means of the ratios that pairs of images (edges) have, and how their errors hang together."""

import numpy as np
from scipy import sparse

from lvba.arrays import Indices
from lvba.kernels import edge_sums
from lvba.visual.exposure_graph import BLOCKS, NORMAL, robust_std


def edge_means(
    edge: Indices, value: np.ndarray, sigma: np.ndarray, edges: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust mean (E,) of the values of every edge, its standard deviation (E,), and the weights (N,) used.

    edge (N,): which edge a value (N,) with standard deviation (N,) belongs to. Cauchy weights, scaled by the median of
    all normalized residuals, from the median as start. Where those of an edge scatter more, its mean is as uncertain:
    somebody who walks by covers most of what two images share.
    value: (N,) float64; sigma: (N,) float64
    """
    mean = medians(edge, value, edges)
    several = np.bincount(edge, minlength=edges) >= 4  # of few values the residuals say nothing
    many = several[edge]
    for _ in range(10):
        residual = (value - mean[edge]) / sigma
        scale = max(robust_std(residual[many]), 1e-3) if many.any() else 1.0
        weight = 1 / (sigma**2 * (1 + (residual / (2 * scale)) ** 2))
        total = np.bincount(edge, weight, edges)
        mean = np.bincount(edge, weight * value, edges) / total
    own = NORMAL * medians(edge, np.abs(value - mean[edge]) / sigma, edges)
    return mean, np.where(several, np.maximum(own, scale), scale) / np.sqrt(total), weight


def pieces_of_means(
    edge: Indices, value: np.ndarray, weight: np.ndarray, block: Indices, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What part of an edge's weight each block has, and that times how far it is off the mean, both (E, BLOCKS).

    value: (N,) float64; weight: (N,) float64; mean: (E,) float64, of each edge
    """
    cell, shape = edge * BLOCKS + block, (len(mean), BLOCKS)
    total = np.bincount(edge, weight, shape[0])[:, None]
    fraction = np.bincount(cell, weight, shape[0] * BLOCKS).reshape(shape) / total
    pull = np.bincount(cell, weight * (value - mean[edge]), shape[0] * BLOCKS).reshape(shape) / total
    return fraction, pull


def weighted_means(edge: Indices, weight: np.ndarray, values: np.ndarray, edges: int) -> np.ndarray:
    """(E, K): of the values (N, K) of every edge, each with its weight (N,).

    weight: (N,) float64; values: (N, K) float64
    """
    total = np.bincount(edge, weight, edges)
    means = [np.bincount(edge, weight * column, edges) / total for column in values.T]
    return np.stack(means, axis=1)


def medians(group: Indices, value: np.ndarray, groups: int) -> np.ndarray:
    """(groups,) float64: of the values (N,) of every group; group: (N,), which one a value belongs to.

    value: (N,) float64
    """
    return edge_sums.medians(group, value, groups)


def shared_errors(edge: Indices, patch: Indices, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which edges err together (M, 2), each two once, and the correlation of their errors (M,): they have patches in
    common.

    A patch is compared with several images, and half of the variance of each ratio is that of the patch's own view.
    edge, patch: (N,) of each ratio; part: (N,) float64, signed, of its error in that of the edge's mean, in any unit
    """
    edges = int(edge.max(initial=-1)) + 1
    by_patch = sparse.csr_matrix((part, (edge, patch)), shape=(edges, int(patch.max(initial=-1)) + 1))
    together = sparse.triu(by_patch @ by_patch.T, 1).tocoo()
    own = by_patch.multiply(by_patch).sum(axis=1).A1 + np.bincount(edge, part * part, edges)
    correlation = together.data / np.sqrt(own[together.row] * own[together.col])
    return np.stack([together.row, together.col], axis=1).astype(np.int64), correlation
