"""Slow, plain twins of the kernels behind the products."""

import itertools

import numpy as np


def project(points, pose, intrinsics):
    """u, v, z (N,) float32 of points (N, 3); pose (4, 4): world_from_camera."""
    d = (points - pose[:3, 3]).astype(np.float32)
    x, y, z = ((pose[0, a] * d[:, 0] + pose[1, a] * d[:, 1]) + pose[2, a] * d[:, 2] for a in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = np.float32(1) / z
        return intrinsics[0] * x * inverse + intrinsics[2], intrinsics[1] * y * inverse + intrinsics[3], z


def nearest_points(points, pose, intrinsics, height, width):
    """Depth and index of the nearest point per pixel of one image."""
    depth = np.full((height, width), np.inf, np.float32)
    index = np.full((height, width), -1, np.int32)
    for i, row, column, _, _, z in pixels_of(points, pose, intrinsics, height, width):
        if z < depth[row, column]:
            depth[row, column], index[row, column] = z, i
    return depth, index


def pixels_of(points, pose, intrinsics, height, width):
    """Of each point that is in an image: index, row, column, distance (px) to the right and down of its middle, depth."""
    u, v, z = project(points, pose, intrinsics)
    for i in range(len(points)):
        inside = -0.5 < u[i] < width - 0.5 and -0.5 < v[i] < height - 0.5
        if z[i] >= 0.05 and inside:
            column, row = int(u[i] + np.float32(0.5)), int(v[i] + np.float32(0.5))
            yield i, row, column, u[i] - column, v[i] - row, z[i]


def splatted(points, source, pose, intrinsics, image, guard, radius, height, width):
    """Depth and index of what each pixel sees, of all points and of those of other images; one image.

    Each pixel has a point of its own: the nearest one, with depths 5 % larger for each pixel from its middle, along rows
    and along columns, to eighths of a pixel. It shows that, unless it is behind those around: then the one of these that
    is nearest to its middle.
    """
    depth = np.full((2, height, width), np.inf, np.float32)
    index = np.full((2, height, width), -1, np.int32)
    seen = list(pixels_of(points, pose, intrinsics, height, width))
    for variant in range(2):
        own = {}
        for i, row, column, right, down, z in seen:
            if variant == 1 and abs(int(source[i]) - image) <= guard:
                continue
            right, down = ((np.floor(8 * (each + 0.5)) + 0.5) / 8 - 0.5 for each in (right, down))
            counted = np.floor(min(z * (1 + 0.05 * (abs(right) + abs(down))), 2047) * 2**14)
            if (row, column) not in own or counted < own[row, column][0]:
                own[row, column] = (counted, column + right, row + down, z, i)
        for row, column in np.ndindex(height, width):
            around = [
                own[r, c]
                for r in range(row - radius, row + radius + 1)
                for c in range(column - radius, column + radius + 1)
                if (r, c) in own
            ]
            front = [each for each in around if each[3] <= 1.05 * min(other[3] for other in around)]
            if (row, column) in own and own[row, column] in front:
                front = [own[row, column]]
            if front:
                nearest = min(front, key=lambda each: np.hypot(each[1] - column, each[2] - row))
                depth[variant, row, column], index[variant, row, column] = nearest[3:]
    return depth, index


def seen_depths(points, pose, intrinsics, cell, height, width):
    """How deep each cell sees: its nearest point, the slope of its surface, and what stands in front next to it."""
    depth, _ = nearest_points(points, pose, intrinsics, height, width)
    return cell_depths(depth, cell, stray=0.0)


def cell_depths(depth, cell, stray):
    """The same of what pixels show; a part of those of a cell that show anything may be nearer than its surface."""
    height, width = depth.shape
    rows, columns = -(-height // cell), -(-width // cell)
    inverse = np.zeros((rows + 2, columns + 2))
    for r in range(rows):
        for c in range(columns):
            window = depth[r * cell : (r + 1) * cell, c * cell : (c + 1) * cell]
            shown = np.append(np.sort(window[np.isfinite(window)]), 1e30)
            inverse[r + 1, c + 1] = 1 / shown[int(stray * (len(shown) - 1))]
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


def first_points(points, surface, tolerance, pose, intrinsics, cell, height, width):
    """(h, w, 8) and (h, w, 2, 2): the nearest point of each cell, and the cell whose counts for each of its quarters."""
    depth, index = nearest_points(points, pose, intrinsics, height, width)
    rows, columns = -(-height // cell), -(-width // cell)
    out = np.zeros((rows, columns, 8))
    out[..., 7] = np.inf
    for r in range(rows):
        for c in range(columns):
            window = depth[r * cell : (r + 1) * cell, c * cell : (c + 1) * cell]
            if np.isinf(window.min()):
                continue
            found = np.unravel_index(window.argmin(), window.shape)
            i = index[r * cell + found[0], c * cell + found[1]]
            normal = surface[i, :3]
            normal = normal * (1 if normal @ (pose[:3, 3] - points[i]) > 0 else -1)
            out[r, c] = [*points[i], *normal, allowed(surface[i], tolerance), window.min()]
    front = np.zeros((rows, columns, 2, 2), int)
    for r, c, a, b in np.ndindex(front.shape):
        four = [(y, x) for y in (r - 1 + a, r + a) for x in (c - 1 + b, c + b)]
        nine = [(y, x) for y in (r - 1, r, r + 1) for x in (c - 1, c, c + 1)]
        four, nine = (
            [(y, x) for y, x in near if 0 <= y < rows and 0 <= x < columns] for near in (four, nine)
        )
        near = nine if any(np.isinf(out[each][7]) for each in four) else four
        y, x = min(near, key=lambda each: out[each][7])
        front[r, c, a, b] = y * columns + x
    return out, front


def allowed(surface, tolerance):
    """How far points may be apart across a surface that are on it, m."""
    return surface[6] * (tolerance.known if surface[:3].any() else tolerance.unknown)


def hidden(first_seen, point, pose, depth, surface, tolerance, touching):
    """Whether what is in front hides a point: it is behind that surface, and that one in front of its own."""
    normal = surface[:3]
    if not surface[3:6].any() and normal @ (pose[:3, 3] - point) < 0:
        normal = -normal
    for front in first_seen:  # of its own cell, and of those about it
        if depth <= front[7]:
            continue
        apart = point - front[:3]
        below = -front[3:6] @ apart if front[3:6].any() else depth - front[7] - touching * depth
        above = -normal @ apart if normal.any() else depth - front[7] - touching * depth
        if below > front[6] and above > allowed(surface, tolerance):
            return True
    return False


def rank(point, surface, pose, pixel):
    """One over the mean square distance along the surface of what a view shows from the point; 0: too steep."""
    ray = point - pose[:3, 3]
    square, normal = ray @ ray, surface[:3]
    if not normal.any():
        return 1 / (2 * pixel**2 * square)
    cosine = -normal @ ray / np.sqrt(square)
    if not surface[3:6].any():
        cosine = abs(cosine)
    if cosine <= np.sqrt(surface[7]):
        return 0.0
    beam_and_view = surface[3:6] + ray / (np.sqrt(square) * cosine)
    return 1 / (pixel**2 * square * (1 + 1 / cosine**2) + surface[6] ** 2 * (beam_and_view @ beam_and_view))


def best_views(point, surface, tolerance, poses, intrinsics, pictures, valid, seen_first, usable, slots):
    """The best (rank, color, image) of one point, best first."""
    first_seen, front, cell = seen_first
    found, pixel = [], 1 / min(intrinsics[:2])
    for k, pose in enumerate(poses):
        (u,), (v,), (z,) = project(point[None], pose, intrinsics)
        height, width = valid.shape
        if z < 0.05 or not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
            continue
        column, row = int(u + 0.5), int(v + 0.5)
        if not valid[row, column]:
            continue
        half = int(row % cell + 0.5 >= cell / 2), int(column % cell + 0.5 >= cell / 2)
        other = front[k, row // cell, column // cell][half]
        in_front = first_seen[k, row // cell, column // cell], first_seen[k].reshape(-1, 8)[other]
        if hidden(in_front, point, pose, z, surface, tolerance, 2 * cell * pixel):
            continue
        good = rank(point.astype(float), surface.astype(float), pose, pixel)
        if good == 0:
            continue
        color, highest = bilinear(pictures[k], np.clip(u, 0, width - 1), np.clip(v, 0, height - 1))
        if highest >= usable.bright or highest <= usable.dark:
            good *= 1e-9
        found.append((good, color, k))
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


def surfaces(points, start, observer, max_angle):
    """(M, 8) of points (M, 3) in blocks, see the kernel: planes by the scatter of those in the same eighth, or block, and
    the same octant, fitted again without what is off them; else the nearest plane of the block."""
    out = np.zeros((len(points), 8))
    for first, last in itertools.pairwise(start):
        here, sensors = points[first:last].astype(float), observer[first:last]
        octant = (sensors > points[first:last]) @ [4, 2, 1]
        upper = 2 * (points[first:last] - points[first:last].min(0)) > np.ptp(points[first:last], axis=0)
        eighth = upper @ [4, 2, 1]
        planes = {}
        for o in range(8):
            for e in [*range(8), 8]:
                mine = (octant == o) & ((eighth == e) | (e == 8))
                found = plane(here[mine])
                if found is not None and found[0].any():
                    near = mine & (off(found, here) <= 3)
                    again = plane(here[near])
                    found = (
                        again if near.sum() < mine.sum() and again is not None and again[0].any() else found
                    )
                planes[e, o] = found
        flat = [found for (e, o), found in sorted(planes.items()) if found is not None and found[0].any()]
        for i in range(len(here)):
            beside = [planes[eighth[i], octant[i]], planes[8, octant[i]]]
            if beside[0] is not None and beside[1] is not None and beside[1][2] < 2 * beside[0][2]:
                beside = beside[::-1]
            own = [p for p in beside if p is not None and p[0].any() and off(p, here[i]) <= 3]
            other = sorted((p for p in flat if off(p, here[i]) < 3), key=lambda p: off(p, here[i]))
            if not own and not other:
                local = planes[eighth[i], octant[i]], planes[8, octant[i]]
                out[first + i, 6] = next((p[2] for p in local if p is not None), -1)
                continue
            normal, _, scatter, tilt = (own or other)[0]
            along = normal @ (sensors[i] - here[i])
            angle = min(max_angle + 2 * tilt, np.pi / 2)
            out[first + i] = [
                *(normal * np.sign(along)), *((sensors[i] - here[i]) / abs(along)), scatter, np.cos(angle) ** 2,
            ]  # fmt: skip
    return out


def plane(points):
    """Normal (zero: not flat), offset, scatter and tilt of the plane of points; None: too few."""
    if len(points) < 5:
        return None
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True) * len(points))
    values = np.maximum(values, 0)
    flat = values[0] <= 0.1 * values[1] and values[1] >= 0.03 * values[2]
    normal = vectors[:, 0] * flat
    tilt = np.sqrt(values[0] / (values[1] * min(len(points), 50))) if flat else 0.0
    return normal, normal @ points.mean(0), np.sqrt(values[0] / (len(points) - 3)), tilt


def off(found, points):
    """How far points are from a plane, in its standard deviations."""
    return np.abs(points @ found[0] - found[1]) / (found[2] + 1e-6)
