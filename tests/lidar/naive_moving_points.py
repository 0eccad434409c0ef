"""Plain twins of `kernels.range_images`: one cell, one look after another, in numbers of float32 as kernels have them."""

import numpy as np

f32 = np.float32


def cell_of(direction, n):
    """Face, row and column: the axis of the largest component, and how far the others are from its middle."""
    size = np.abs(direction)
    axis = int(np.argmax(size))
    across = [direction[k] / size[axis] for k in range(3) if k != axis]
    at = [u * (f32(1) + f32(0.3476) * (f32(1) - np.abs(u))) for u in across]
    column, row = (int(np.clip(int((u + f32(1)) * (f32(0.5) * f32(n))), 0, n - 1)) for u in at)
    return 2 * axis + int(direction[axis] < 0), row, column


def distance(p):
    return np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])


def range_image(points, n):
    image = np.full((6, n, n), np.inf, np.float32)
    for point in points:
        if 0 < distance(point) < np.inf:
            cell = cell_of(point, n)
            image[cell] = min(image[cell], distance(point))
    return image


def look(image, point):
    """1: something is there, -1: seen through, 0: neither."""
    n, away = image.shape[1], distance(point)
    if away < 1.0:
        return 0
    face, row, column = cell_of(point, n)
    around = np.full((3, 3), np.inf, np.float32)
    for a in range(3):
        for b in range(3):
            r, c = row + a - 1, column + b - 1
            if 0 <= r < n and 0 <= c < n:
                around[a, b] = image[face, r, c]
    filled = np.isfinite(around)
    if (np.abs(around[filled] - away) < max(f32(0.3), f32(0.03) * away)).any():
        return 1
    both_sides = filled[1, 1] or (filled & filled[::-1, ::-1]).any()
    return -int(filled.sum() >= 4 and around.min() > away and both_sides)


def seen_through(points, images, image_from_points):
    out = []
    for point in points:
        says = []
        for image, pose in zip(images, image_from_points, strict=True):
            moved = [f32(0)] * 3
            for a in range(3):
                moved[a] = pose[a, 3]
                for b in range(3):
                    moved[a] += pose[a, b] * point[b]
            says.append(look(image, np.array(moved, np.float32)))
        through, there = says.count(-1), says.count(1)
        out.append(through >= 2 and through > 2 * there)
    return np.array(out)
