"""Slow, plain twins of the kernels behind the products."""

import itertools

import numpy as np


def project(points, pose, intrinsics):
    """u, v, z (N,) float32 of points (N, 3); pose (3, 4): rotation rows and camera center."""
    d = (points - pose[:, 3]).astype(np.float32)
    x, y, z = ((pose[a, 0] * d[:, 0] + pose[a, 1] * d[:, 1]) + pose[a, 2] * d[:, 2] for a in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = np.float32(1) / z
        return intrinsics[0] * x * inverse + intrinsics[2], intrinsics[1] * y * inverse + intrinsics[3], z


def nearest_points(points, source, pose, intrinsics, image, guard, radius, height, width):
    """Depth and index of the nearest point per pixel, all points and those of other images; one image."""
    depth = np.full((2, height, width), np.inf, np.float32)
    index = np.full((2, height, width), -1, np.int32)
    u, v, z = project(points, pose, intrinsics)
    for i in range(len(points)):
        inside = -0.5 < u[i] < width - 0.5 and -0.5 < v[i] < height - 0.5
        if z[i] < 0.05 or not inside:
            continue
        column, row = int(u[i] + np.float32(0.5)), int(v[i] + np.float32(0.5))
        for variant in range(2):
            if variant == 1 and abs(int(source[i]) - image) <= guard:
                continue
            for r in range(max(0, row - radius), min(height, row + radius + 1)):
                for c in range(max(0, column - radius), min(width, column + radius + 1)):
                    if z[i] < depth[variant, r, c]:
                        depth[variant, r, c], index[variant, r, c] = z[i], i
    return depth, index


def seen_depths(points, pose, intrinsics, cell, height, width):
    """How deep each cell sees: its nearest point, the slope of its surface, and what stands in front next to it."""
    depth, _ = nearest_points(points, np.zeros(len(points)), pose, intrinsics, 0, 0, 0, height, width)
    rows, columns = -(-height // cell), -(-width // cell)
    inverse = np.zeros((rows + 2, columns + 2))
    for r in range(rows):
        for c in range(columns):
            inverse[r + 1, c + 1] = 1 / min(
                depth[0, r * cell : (r + 1) * cell, c * cell : (c + 1) * cell].min(), 1e30
            )
    out = np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):
            window = inverse[r : r + 3, c : c + 3]
            own, opposite = window[1, 1], window[::-1, ::-1]
            nearer = window > own
            surface = nearer & (own > 1e-20) & (opposite > 1e-20) & (own - opposite >= 0.4 * (window - own))
            front = max(own, window[nearer & ~surface].max(initial=0))
            slope = np.minimum(own - opposite, window - own)[surface].max(initial=0)
            with np.errstate(divide="ignore"):
                out[r, c] = 1 / (front if front > 1.02 * own else own - slope)
    return np.where(out > 1e20, np.inf, out)


def bilinear(image, u, v):
    """Bilinear RGB at one place."""
    height, width = image.shape[:2]
    column, row = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - column, v - row
    patch = image[row : row + 2, column : column + 2].astype(float)
    top, bottom = (1 - a) * patch[0, 0] + a * patch[0, 1], (1 - a) * patch[1, 0] + a * patch[1, 1]
    return (1 - b) * top + b * bottom, patch.max()


def best_views(point, normal, poses, intrinsics, pictures, valid, nearest, cell, tolerance, limits, slots):
    """The best (rank, color, image) of one point, best first."""
    found = []
    for k, pose in enumerate(poses):
        (u,), (v,), (z,) = project(point[None], pose, intrinsics)
        height, width = valid.shape
        if z < 0.05 or not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
            continue
        column, row = int(u + 0.5), int(v + 0.5)
        if (
            not valid[row, column]
            or z > nearest[k, row // cell, column // cell] * (1 + tolerance[1]) + tolerance[0]
        ):
            continue
        ray = point - pose[:, 3]
        if normal @ ray > 0.25 * np.linalg.norm(ray):
            continue
        rank = 1.0 / (ray @ ray)
        color, highest = bilinear(pictures[k], np.clip(u, 0, width - 1), np.clip(v, 0, height - 1))
        if highest >= limits[1] or highest <= limits[0]:
            rank *= 1e-9
        found.append((rank, color, k))
    return sorted(found, key=lambda view: -view[0])[:slots]


def robust_mean(samples, weights, floor):
    """Huber mean per channel, started at the weighted median, and the spread."""
    out = np.empty(3)
    for c in range(3):
        center = weighted_median(samples[:, c], weights)
        distance = np.abs(samples[:, c] - center)
        knee = 1.5 * max(1.4826 * weighted_median(distance, weights), floor)
        w = weights * np.where(distance <= knee, 1.0, knee / np.maximum(distance, 1e-30))
        out[c] = (w * samples[:, c]).sum() / w.sum()
    return out, np.sqrt((weights[:, None] * (samples - out) ** 2).sum() / (3 * weights.sum()))


def weighted_median(values, weights):
    """The smallest value at which half of the weight is reached."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return values[order[np.argmax(reached >= 0.5 * weights.sum())]]


def thin(points, voxel):
    """One point per voxel, the nearest to its center."""
    best = {}
    for i, point in enumerate(points.astype(float)):
        scaled = point / voxel
        key = tuple(np.floor(scaled))
        distance = ((scaled - np.floor(scaled) - 0.5) ** 2).sum()
        if key not in best or distance < best[key][0]:
            best[key] = (distance, i)
    return np.sort([i for _, i in best.values()])


def entropies(points, radius, min_neighbors):
    """Entropy of the Gaussian through the neighbors of each point."""
    out = np.full(len(points), np.nan)
    for i, point in enumerate(points):
        near = points[((points - point) ** 2).sum(1) <= radius**2]
        if len(near) >= min_neighbors:
            covariance = np.cov(near.T)
            out[i] = 0.5 * np.log(np.linalg.det(2 * np.pi * np.e * covariance))
    return out


def facing_normals(points, start, seen_from):
    """(M, 3) of points (M, 3) in blocks, by the scatter of those in the same eighth, or block, and the same octant."""
    normals = np.zeros(points.shape)
    for first, last in itertools.pairwise(start):
        here = points[first:last].astype(float)
        octant = seen_from[first:last] > points[first:last]
        eighth = 2 * (here - here.min(0)) > np.ptp(here, axis=0)
        for i in range(len(here)):
            beside = (octant == octant[i]).all(1)
            for chosen in (beside & (eighth == eighth[i]).all(1), beside):
                if chosen.sum() < 5:
                    continue
                values, vectors = np.linalg.eigh(np.cov(here[chosen].T, bias=True))
                if values[0] <= 0.1 * values[1] and values[1] >= 0.15 * values[2]:
                    normal = vectors[:, 0]
                    normals[first + i] = normal * np.sign(normal @ (seen_from[first + i] - here[i]))
                    break
    return normals
