"""What the planes of a scan tell about its pose, without what only the noise of their normals tells."""

import numpy as np

from lvba import distinct_rows
from lvba.arrays import Vectors

_FEWEST = 8
_ENOUGH, _LARGER = 40, 4
_LEAST_SIGMA_M = 0.002
_FLAT = 0.1
"""Smallest over middle eigenvalue of a plane's points, at most."""
_UNCERTAIN_RAD = 0.1
"""A normal that its points leave freer than this is not used: they lie along a line, as those of a single beam do."""


def of_planes(points: Vectors, cell: float) -> np.ndarray:
    """(6, 6) float64, information of planes about the pose of a scan, [rotation | translation], rad and m, its own axes.

    points: (N, 3), m, LiDAR frame; cell: m, least edge of cells with one plane each
    A normal that scatters by s about the true one tells s^2 of what it should along the plane, where it should tell
    nothing: in a corridor, that alone would hold a pose along it. s follows from the planes' own points and is
    subtracted.
    """
    means, values, vectors, counts = _planes(points, _full(points, cell))
    if not len(means):
        return np.zeros((6, 6))
    thickness = values[:, 0] * counts / (counts - 3)
    # of few points, a thickness may be small by chance: no plane is thinner than the usual one
    thickness = np.maximum(thickness, np.median(thickness))
    scatter = thickness[:, None] / (counts[:, None] * np.maximum(values[:, 1:], 1e-12))
    # what an uncertain normal tells is mostly noise, and what is subtracted for it is as uncertain: in a street, single
    # beams on the ground would take away all that surfaces across it tell
    weight = counts / np.maximum(thickness, _LEAST_SIGMA_M**2) * (scatter[:, 0] < _UNCERTAIN_RAD**2)
    total = _squares(means, vectors[:, :, 0], weight)
    for axis in (1, 2):
        total -= _squares(means, vectors[:, :, axis], weight * scatter[:, axis - 1])
    return _without_negative(total)


def _full(points: Vectors, cell: float) -> float:
    """m, edge of cells that most points share with enough others: twice, four times, ... the least."""
    for _ in range(_LARGER):
        index = _cells(points, cell)
        if np.median(np.bincount(index)[index]) >= _ENOUGH:
            break
        cell *= 2
    return cell


def _cells(points: Vectors, cell: float) -> np.ndarray:
    """(N,) int64, the number of the cell that each of points (N, 3) is in."""
    return distinct_rows.number(np.floor(points / cell).astype(np.int64))


def _planes(points: Vectors, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means (M, 3), eigenvalues (M, 3) ascending, eigenvectors (M, 3, 3) in columns and counts (M,) of flat cells."""
    index = _cells(points, cell)
    counts = np.bincount(index)
    means = np.stack([np.bincount(index, points[:, k]) for k in range(3)], axis=-1) / counts[:, None]
    away = points - means[index]
    squares = np.empty((len(counts), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            squares[:, i, j] = squares[:, j, i] = np.bincount(index, away[:, i] * away[:, j]) / counts
    enough = counts >= _FEWEST
    values, vectors = np.linalg.eigh(squares[enough])
    values = np.maximum(values, 0.0)
    is_flat = values[:, 0] < _FLAT * values[:, 1]
    return means[enough][is_flat], values[is_flat], vectors[is_flat], counts[enough][is_flat].astype(float)


def _squares(centers: np.ndarray, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    rows = np.concatenate([np.cross(centers, directions), directions], axis=1)
    return np.asarray((rows * weights[:, None]).T @ rows)


def _without_negative(information: np.ndarray) -> np.ndarray:
    """Its nearest without negative eigenvalues, with turns measured at the reach of its points."""
    reach = np.sqrt(max(np.trace(information[:3, :3]) / max(np.trace(information[3:, 3:]), 1e-12), 1e-12))
    scale = np.repeat([1 / reach, 1.0], 3)
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(positive / scale[:, None] / scale)
