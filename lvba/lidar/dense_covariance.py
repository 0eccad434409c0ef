"""Covariances of all poses as one matrix: inverse, blocks, and what is left after one rigid alignment."""

from collections.abc import Callable

import numpy as np
import scipy.linalg

from lvba import geometry, trajectory
from lvba.arrays import Poses


def blocks(matrix: np.ndarray, apart: int) -> np.ndarray:
    """(N - apart, 6, 6), of a matrix: the blocks of each pose and the one so many places after it.

    matrix: (6 N, 6 N) float64
    """
    poses = len(matrix) // 6
    here = np.arange(poses - apart)
    return np.array(matrix.reshape(poses, 6, poses, 6)[here, :, here + apart])


def inverse(information: np.ndarray) -> np.ndarray:
    """(N, N), the inverse of a positive matrix; eigenvalues that rounding made negative count as tiny.

    information: (N, N) float64
    """
    # symmetric, so its transpose in columns is the matrix itself in rows: LAPACK works on this one copy
    matrix = np.array(information).T
    try:
        factor, _ = scipy.linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        inverse, _ = scipy.linalg.lapack.dpotri(factor, lower=True, overwrite_c=True)
    except np.linalg.LinAlgError:
        values, vectors = _positive_eigen(information)
        return np.asarray((vectors / values) @ vectors.T)
    return _mirrored(inverse.T)


def root_of_inverse(information: np.ndarray) -> np.ndarray:
    """(N, N) float64, R where R R' is `inverse`; its inverse is a factor of the matrix: two thirds of the work.

    information: (N, N) float64
    """
    factor, unsolved = scipy.linalg.lapack.dpotrf(np.array(information).T, lower=1, overwrite_a=1)
    if unsolved:
        values, vectors = _positive_eigen(information)
        return np.asarray(vectors / np.sqrt(values))
    root, _ = scipy.linalg.lapack.dtrtri(factor, lower=1, overwrite_c=1)
    return np.asarray(root.T)


def _positive_eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (N,), tiny where rounding made them negative, and eigenvectors (N, N) of a symmetric matrix."""
    values, vectors = scipy.linalg.eigh(matrix, check_finite=False)
    return np.maximum(values, 1e-9 * values[-1]), vectors


def _mirrored(matrix: np.ndarray) -> np.ndarray:
    """A square matrix with what is above its diagonal written below it too, in place: a copy would double the memory."""
    width = 256
    for at in range(0, len(matrix), width):
        below = at + width
        matrix[below:, at:below] = matrix[at:below, below:].T
        block = matrix[at:below, at:below]
        block[:] = np.triu(block) + np.triu(block, 1).T
    return matrix


def aligned(covariance: np.ndarray, world_from_scan: Poses, lever_m: float | None = None) -> np.ndarray:
    """(S, 6, 6), of each pose (S, 4, 4) after the rigid motion that brings all poses closest to where they were:
    diagonal blocks of (I - M Q) C (I - M Q)', M rigid motions of all poses and Q what finds them.

    covariance: (6 S - 6, 6 S - 6) float64, C, of all poses but the first; lever_m: as of `alignment`
    """
    return _aligned(blocks(covariance, 0), lambda finds: finds @ covariance, world_from_scan, lever_m)


def aligned_of_root(root: np.ndarray, world_from_scan: Poses) -> np.ndarray:
    """(S, 6, 6), as `aligned`, of the covariance R R'.

    root: (6 S - 6, N) float64, R, of all poses (S, 4, 4) but the first
    """
    own = root.reshape(-1, 6, root.shape[1])
    return _aligned(own @ np.swapaxes(own, 1, 2), lambda finds: (finds @ root) @ root.T, world_from_scan)


def _aligned(
    own: np.ndarray,
    with_all: Callable[[np.ndarray], np.ndarray],
    world_from_scan: np.ndarray,
    lever_m: float | None = None,
) -> np.ndarray:
    """As `aligned`. own: (S - 1, 6, 6), the covariance's blocks; with_all: a matrix (6, 6 S - 6) times the covariance"""
    motion, pick = alignment(world_from_scan, lever_m)
    finds = np.linalg.solve(pick.T @ motion, pick.T)[:, 6:]
    common = with_all(finds)
    none = np.zeros((1, 6, 6))
    each = np.concatenate([none, own])
    with_common = np.concatenate([none, np.swapaxes(common.reshape(6, -1, 6), 0, 1)])
    motion = motion.reshape(-1, 6, 6)
    cross = motion @ with_common
    of_all = motion @ (common @ finds.T) @ np.swapaxes(motion, -1, -2)
    return np.asarray(each - cross - np.swapaxes(cross, -1, -2) + of_all)


def alignment(world_from_scan: Poses, lever_m: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rigid motions (6 S, 6) of all poses, local tangents, and what picks them out of a motion of all poses, (6 S, 6).

    lever_m: m, how far from each position a point is that counts as much as the position itself, and so the orientation;
        None: as errors against a reference are counted (`trajectory.lever_for_errors`)
    """
    if lever_m is None:
        lever_m = trajectory.lever_for_errors(world_from_scan)
    arm = world_from_scan[:, :3, 3] - world_from_scan[:, :3, 3].mean(0)
    rigid = np.zeros((len(arm), 6, 6))
    rigid[:, :3, :3] = rigid[:, 3:, 3:] = np.eye(3)
    rigid[:, 3:, :3] = -geometry.hat(arm)
    seen = np.zeros_like(rigid)
    seen[:, 3:] = rigid[:, 3:]
    # positions on a line leave the rotation about it open: the orientations decide, as in `trajectory.align`
    lever = max(1e-3 * float(np.sqrt((arm**2).sum(1).mean())), 1e-6, lever_m)
    seen[:, :3, :3] = lever**2 * np.eye(3)
    turn = np.zeros_like(rigid)
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(world_from_scan[:, :3, :3], -1, -2)
    return (turn @ rigid).reshape(-1, 6), (turn @ seen).reshape(-1, 6)
