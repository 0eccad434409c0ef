"""The kernels of LiDAR bundle adjustment once more, slow and plain."""

import numpy as np

SYMMETRIC = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


def cluster(points):
    """(count, mean (3,), scatter (6,)) of (N, 3) points."""
    points = np.asarray(points, float)
    mean = points.mean(0)
    square = (points - mean).T @ (points - mean)
    return float(len(points)), mean, np.array([square[i, j] for i, j in SYMMETRIC])


def full(scatter):
    """(3, 3) of the 6 numbers."""
    matrix = np.zeros((3, 3))
    for value, (i, j) in zip(scatter, SYMMETRIC, strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def cells(points, size):
    """{cell (3 ints): indices of the points in it}, in order of first appearance."""
    found = {}
    for index, point in enumerate(points):
        if np.all(np.isfinite(point)):
            found.setdefault(tuple(np.floor(point / size).astype(int)), []).append(index)
    return found


def groups(rows):
    """Lists of the indices of equal rows, in order of first appearance."""
    found = {}
    for index, row in enumerate(rows):
        found.setdefault(tuple(row), []).append(index)
    return list(found.values())


def plane_cost(poses, features):
    """Sum over features [(scan, points, weight), ...] of N lam0, from the points themselves."""
    cost = 0.0
    for feature in features:
        world = np.concatenate([p @ poses[s][:3, :3].T + poses[s][:3, 3] for s, p, _ in feature])
        weight = np.concatenate([np.full(len(p), w) for _, p, w in feature])
        mean = weight @ world / weight.sum()
        covariance = ((world - mean) * weight[:, None]).T @ (world - mean)
        cost += np.linalg.eigvalsh(covariance)[0]
    return cost


def hessian(diagonal, columns, offsets, scan):
    """D - W W' with W written out, (6 S, 6 S); columns: (O, 3, 6) of each observation."""
    size = 6 * len(diagonal)
    features = len(offsets) - 1
    w = np.zeros((size, 3 * features))
    for f in range(features):
        for o in range(offsets[f], offsets[f + 1]):
            w[6 * scan[o] : 6 * scan[o] + 6, 3 * f : 3 * f + 3] = columns[o].T
    dense = -w @ w.T
    for s, block in enumerate(diagonal):
        dense[6 * s : 6 * s + 6, 6 * s : 6 * s + 6] += block
    return dense


def information(rotations, feature, scan, points, weight, eigenvalues, eigenvectors, total, trusted):
    """Planes held fixed: (S, 6, 6) from every point, and the part due to the normals' noise alone, from the clusters."""
    found = np.zeros((len(rotations), 6, 6))
    noise = np.zeros((len(rotations), 6, 6))
    for f, s, p, w in zip(feature, scan, points, weight, strict=True):
        lever = p @ rotations[s].T
        for k in range(3):
            u = eigenvectors[f, k]
            rows = np.concatenate([np.cross(lever, u), np.broadcast_to(u, lever.shape)], axis=1)
            if k == 0:
                found[s] += w * rows.T @ rows
            else:
                gap = eigenvalues[f, k] - eigenvalues[f, 0]
                noise[s] += w * eigenvalues[f, 0] / (min(total[f], trusted) * gap) * rows.T @ rows
    return found, noise


def noise_information(poses, features, sigma, trusted):
    """Of all poses together: each plane's points with a tangent for its normal, what planes could absorb taken out."""
    total = np.zeros((6 * len(poses), 6 * len(poses)))
    for feature in features:
        moved = [points @ poses[scan, :3, :3].T + poses[scan, :3, 3] for scan, points, _ in feature]
        weight = np.concatenate([np.full(len(points), w) for _, points, w in feature])
        points, scan = np.concatenate(moved), np.concatenate([[s] * len(p) for s, p, _ in feature])
        off = points - np.average(points, axis=0, weights=weight)
        values, vectors = np.linalg.eigh((weight[:, None] * off).T @ off / weight.sum())
        for k in (1, 2):
            variance = values[0] / (min(weight.sum(), trusted) * (values[k] - values[0]))
            rows = np.zeros((len(points), 6 * len(poses)))
            for i, s in enumerate(scan):
                lever = points[i] - poses[s, :3, 3]
                rows[i, 6 * s : 6 * s + 6] = np.concatenate([np.cross(lever, vectors[:, k]), vectors[:, k]])
            root = np.sqrt(weight)[:, None]
            plane = root * np.column_stack([np.ones(len(points)), off @ vectors[:, 1], off @ vectors[:, 2]])
            rows *= root
            rows -= plane @ np.linalg.lstsq(plane, rows, rcond=None)[0]
            total += variance * rows.T @ rows
    return total / sigma**2
