"""Planes of mixed cells as plainly as can be: numpy, a cell at a time, for comparison with the kernels."""

import numpy as np

from lvba.kernels import mixed_cells as kernel


def away(points, plane):
    return (points - plane[0]) @ plane[1]


def fit(points, plane):
    """The plane of points (n, 3), on the side of the one before, and its eigenvalues."""
    center = points.mean(0)
    values, vectors = np.linalg.eigh((points - center).T @ (points - center) / len(points))
    normal = vectors[:, 0]
    return (center, normal if normal @ plane[1] >= 0 else -normal), values


def parts(points, left):
    low = points.min(0)
    edge = np.ptp(points, axis=0).max() / kernel._SIDES * (1 + 1e-9) + 1e-9
    number = ((points[left] - low) / edge).astype(int) @ [kernel._SIDES**2, kernel._SIDES, 1]
    found = [points[left][number == each] for each in np.unique(number)]
    found = [each for each in found if len(each) >= kernel._FEWEST_IN_PART]
    return np.array([len(each) for each in found]), np.array([each.mean(0) for each in found])


class Draws:
    """A linear congruential generator."""

    def __init__(self, seed):
        self.state = int(seed)

    def next(self, below):
        self.state = (self.state * 6364136223846793005 + 1442695040888963407) % 2**64
        return (self.state >> 33) % below


def drawn(counts, means, test, draws):
    best, plane = 0.0, None
    for _ in range(kernel._DRAWS):
        a, b, c = (draws.next(len(means)) for _ in range(3))
        normal = np.cross(means[b] - means[a], means[c] - means[a])
        area = np.linalg.norm(normal)
        if area < (0.2 * test.size) ** 2:
            continue
        off = (away(means, (means[a], normal / area)) / (2 * test.sigma)) ** 2
        score = np.sum(counts * np.maximum(1 - off, 0))
        if score > best:
            best, plane = score, (means[a], normal / area)
    return plane


def search(points, test, seed):
    draws, left, planes, values = Draws(seed), np.ones(len(points), bool), [], []
    gate = kernel.GATE * test.sigma
    while len(planes) < kernel.MOST_PLANES and left.sum() >= max(
        test.min_points, kernel._LEAST_REST * len(points)
    ):
        counts, means = parts(points, left)
        plane = drawn(counts, means, test, draws) if len(means) >= 3 else None
        if plane is None:
            break
        for _ in range(kernel._FITS):
            plane, value = fit(points[left & (np.abs(away(points, plane)) < gate)], plane)
        planes.append(plane)
        values.append(value)
        left &= np.abs(away(points, plane)) >= gate
    return (planes, values) if np.sum(~left) >= kernel.EXPLAINED * len(points) else ([], [])


def gate_of(value, test):
    return kernel.GATE * np.clip(np.sqrt(max(value[0], 0.0)), kernel.THINNEST * test.sigma, test.sigma)


def chosen(points, sensors, planes, values, k, test):
    side = 1 if np.sum(np.where(away(sensors, planes[k]) > 0, 1, -1)) >= 0 else -1
    own = np.abs(away(points, planes[k]))
    on = (own < gate_of(values[k], test)) & (side * away(sensors, planes[k]) > 0)
    for other in range(len(planes)):
        if other != k:
            far = np.abs(away(points, planes[other]))
            across = abs(planes[other][1] @ planes[k][1]) < kernel.PARALLEL
            on &= ~((far < gate_of(values[other], test)) & (across | (far < own)))
    return on


def label(points, sensors, test, seed):
    """(n,) of points (n, 3) of one cell, seen from sensors (n, 3)."""
    labels = np.full(len(points), -1)
    planes, values = search(points[:: max(len(points) // kernel._SEARCHED, 1)], test, seed)
    for k in range(len(planes)):
        for _ in range(2):
            on = chosen(points, sensors, planes, values, k, test)
            planes[k], values[k] = fit(points[on], planes[k])
        small, middle = values[k][:2]
        if (
            on.sum() >= test.min_points
            and small < test.ratio * middle
            and small <= test.max_tilt**2 * middle * on.sum()
            and small <= (kernel.THICKEST * test.sigma) ** 2
            and middle >= (kernel.SPREAD * test.size) ** 2
        ):
            labels[on] = k
    return labels
