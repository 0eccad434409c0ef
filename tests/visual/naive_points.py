"""Slow, plain twins of the kernels that choose scene points, judge targets and compare brightness."""

import numpy as np


def halve(images, saturated):
    count, height, width, channels = images.shape
    cut = images[:, : height // 2 * 2, : width // 2 * 2].astype(float)
    blocks = cut.reshape(count, height // 2, 2, width // 2, 2, channels).transpose(0, 1, 3, 5, 2, 4)
    blocks = blocks.reshape(count, height // 2, width // 2, channels, 4)
    half = np.round(blocks.mean(axis=-1))  # halves to even
    half[blocks.max(axis=-1) >= saturated] = 255
    half[blocks.min(axis=-1) <= 0] = 0
    return half


def blank_masked(images, reach, dark, bright):
    result = images.copy()
    for i, image in enumerate(images):
        for row, column in np.argwhere(~((image > dark) & (image < bright)).all(axis=2)):
            result[i, max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = 0
    return result


def project(points, world_from_camera, intrinsics):
    """(N, 3): column, row, depth."""
    local = (points.astype(float) - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = intrinsics[0] * local[:, 0] / local[:, 2] + intrinsics[2]
        v = intrinsics[1] * local[:, 1] / local[:, 2] + intrinsics[3]
    return np.column_stack([u, v, local[:, 2]])


def in_image(uvz, width, height, nearest):
    u, v, z = uvz.T
    return (z > nearest) & (u >= -0.5) & (v >= -0.5) & (u < width - 0.5) & (v < height - 0.5)


def hidden(uvz, points, plane, lidar, size, tolerance):
    """Per point: 2 when its own cell's nearest point, or those of most cells around, hide it; 1 when any does."""
    cells = np.floor((uvz[:, :2] + 0.5) / size).astype(int)
    inside = {}
    for k, cell in enumerate(map(tuple, cells)):
        inside.setdefault(cell, []).append((float(uvz[k, 2]), k))
    nearest, alone = nearest_but_alone(inside)
    result = np.zeros(len(uvz), np.uint8)
    for k, (i, j) in enumerate(cells):
        around = [nearest.get((i + di, j + dj)) for di in (-1, 0, 1) for dj in (-1, 0, 1)]
        hides = [q is not None and _hides(q, k, uvz, points, plane, lidar, tolerance) for q in around]
        held = sum(q is not None for q in around)
        result[k] = 2 if hides[4] or sum(hides) > held / 2 or k in alone else int(any(hides))
    return result


def nearest_but_alone(inside):
    """The nearest point of each cell, or the next where that is alone, and those that are. inside: of each (z, index)"""
    two, nearest, alone = {cell: sorted(points)[:2] for cell, points in inside.items()}, {}, set()
    for (i, j), points in two.items():
        around = [each for di in (-1, 0, 1) for dj in (-1, 0, 1) for each in two.get((i + di, j + dj), [])]
        z, k = points[0]
        others = np.array([other for other, m in around if m != k])
        if len(others) >= 4 and (np.abs(others - z) > 0.1 * z).all():
            alone.add(k)
            points = points[1:]
        if points:
            nearest[i, j] = points[0][1]
    return nearest, alone


def off_plane(lidar, k, points):
    return (points - lidar.center[k]) @ lidar.normal[k]


def _hides(q, k, uvz, points, plane, lidar, tolerance):
    z = uvz[k, 2]
    if uvz[q, 2] >= z - tolerance - 0.02 * z:
        return False
    if plane[k] < 0:
        return uvz[q, 2] < z - 2 * tolerance - 0.1 * z
    own = plane[k]
    return abs(off_plane(lidar, own, points[q])) > max(lidar.tolerance[own], 0.004 * z)


def usual_gap(uvz, size, axis):
    """px, median distance between neighboring occupied bins along an axis of the image."""
    held = np.unique(np.floor((uvz[:, :2] + 0.5) / size).astype(int), axis=0)
    gaps = [np.diff(np.sort(held[held[:, 1 - axis] == line, axis])) for line in np.unique(held[:, 1 - axis])]
    gaps = np.sort(np.concatenate([*gaps, np.zeros(0, int)]))
    return size * gaps[(len(gaps) - 1) // 2] if len(gaps) else 0.0


def thinned(uvz, width, size, most):
    """Which points are looked up: of each bin every n-th, so that at most so many are."""
    cells = np.floor((uvz[:, :2] + 0.5) / size).astype(int)
    code, kept = cells[:, 1] * (width + 1) + cells[:, 0], np.zeros(len(uvz), bool)
    for each in np.unique(code):
        members = np.flatnonzero(code == each)
        taken = min(len(members), most)
        kept[members[np.arange(taken) * len(members) // taken]] = True
    return kept


def support(column, row, own, reach, wide, uvz, hidden_flags, points, lidar):
    du, dv = uvz[:, 0] - column, uvz[:, 1] - row
    on_plane = np.abs(off_plane(lidar, own, points)) <= np.maximum(lidar.tolerance[own], 0.004 * uvz[:, 2])
    counted = hidden_flags < 2
    inside = counted & (np.abs(du) <= reach) & (np.abs(dv) <= reach)
    near = counted & on_plane & (np.abs(du) <= wide[0]) & (np.abs(dv) <= wide[1])
    extent = [max((s * d[near]).max(initial=0), 0) for d, s in ((du, -1), (du, 1), (dv, -1), (dv, 1))]
    return [np.sum(inside & on_plane), np.sum(inside & ~on_plane), *extent]


def select_points(lidar, ranges, images, scores, poses, intrinsics, cell, gates):
    """Per image a dict from grid cell (row, column) to (pixel column, pixel row, plane)."""
    half, points, plane = gates.half, lidar.position, lidar.plane
    height, width = images.shape[1:3]
    result = []
    for image, score, pose, (start, stop, step) in zip(images, scores, poses, ranges, strict=True):
        pts, own = points[start:stop:step].astype(float), plane[start:stop:step]
        uvz = project(pts, pose, intrinsics)
        good = in_image(uvz, width, height, gates.min_depth)
        pts, own, uvz = pts[good], own[good], uvz[good]
        spacing = np.sqrt(width * height / max(len(pts), 1))
        buffer = max(gates.min_buffer, min(gates.buffer_spacings * spacing, 2 * half + 1))
        flags = hidden(uvz, pts, own, lidar, buffer, gates.hiding)
        pixel = np.floor(uvz[:, :2] + 0.5).astype(int)
        margin = half + 1
        inside = (pixel >= margin).all(1) & (pixel[:, 0] < width - margin) & (pixel[:, 1] < height - margin)
        value = np.zeros(len(pts))
        value[inside] = score[pixel[inside, 1], pixel[inside, 0]]
        value[(own < 0) | (flags > 0) | (value < gates.min_score)] = 0
        cells = np.floor((uvz[:, :2] + 0.5) / cell).astype(int)
        even = np.clip(gates.extent_spacings * spacing / (half + 0.5), 2, 4) * (half + 0.5)
        wide = [max(even, min(2 * usual_gap(uvz, gates.bin, axis), gates.max_extent)) for axis in (0, 1)]
        kept = thinned(uvz, width, gates.bin, gates.enough)
        held = uvz[kept], flags[kept], pts[kept]
        found = {}
        for column_row in np.unique(cells, axis=0):
            members = np.flatnonzero((cells == column_row).all(1) & (value > 0))
            members = members[np.argsort(-value[members], kind="stable")][: gates.tries]
            for k in members:
                u, v = pixel[k]
                center, normal = lidar.center[own[k]], lidar.normal[own[k]]
                ray = pose[:3, :3] @ [
                    (u - intrinsics[2]) / intrinsics[0],
                    (v - intrinsics[3]) / intrinsics[1],
                    1,
                ]
                met = normal @ (center - pose[:3, 3]) / (normal @ ray)
                if abs(normal @ ray) / np.linalg.norm(ray) < gates.min_normal_cosine or met < gates.min_depth:
                    continue
                if abs(met - uvz[k, 2]) > 0.05 * uvz[k, 2] + 0.1:
                    continue
                patch = image[v - half : v + half + 1, u - half : u + half + 1]
                if ((patch > gates.dark) & (patch < gates.bright)).all(axis=2).mean() < gates.min_usable:
                    continue
                on, off, *extent = support(u, v, own[k], 2 * (half + 0.5), wide, *held, lidar)
                if on < gates.min_support or off > gates.max_off_plane * (on + off) or min(extent) < half:
                    continue
                found[int(column_row[1]), int(column_row[0])] = (int(u), int(v), int(own[k]))
                break
        result.append(found)
    return result


def warp_by_plane(u, v, reference_pose, target_pose, position, normal, intrinsics):
    """Pixel and depth in the target of where the reference's ray meets the plane."""
    fx, fy, cx, cy = intrinsics
    ray = reference_pose[:3, :3] @ np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
    length = normal @ (position - reference_pose[:3, 3]) / (normal @ ray)
    world = reference_pose[:3, 3] + length * ray
    x, y, z = target_pose[:3, :3].T @ (world - target_pose[:3, 3])
    return fx * x / z + cx, fy * y / z + cy, z


def bilinear(image, x, y):
    """Value (C,) and the four neighbours (4, C); None outside."""
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    if x0 < 0 or y0 < 0 or x0 + 1 >= image.shape[1] or y0 + 1 >= image.shape[0]:
        return None, None
    four = image[[y0, y0, y0 + 1, y0 + 1], [x0, x0 + 1, x0, x0 + 1]].astype(float)
    a, b = x - x0, y - y0
    return np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]) @ four, four


def judge(images, poses, intrinsics, position, normal, reference, target, pixel, gates, shift=(0.0, 0.0)):
    """(verdict, NCC) of one pair, by the order of gates of the kernel; shift: px, added in the target."""
    half = gates.half
    r, t = poses[reference], poses[target]
    height, width, channels = images.shape[1:]
    d_t, d_r = position - t[:3, 3], position - r[:3, 3]
    d_t, d_r = d_t / np.linalg.norm(d_t), d_r / np.linalg.norm(d_r)
    if not d_t @ t[:3, 2] > gates.min_view_cosine:
        return 1, 0
    if not min(-d_t @ normal, -d_r @ normal) > gates.min_normal_cosine:
        return 3, 0
    u, v = pixel

    def moved(du, dv):
        x, y, z = warp_by_plane(u + du, v + dv, r, t, position, normal, intrinsics)
        return x + shift[0], y + shift[1], z

    for i in (-half, half):
        for j in (-half, half):
            x, y, z = moved(j, i)
            if z <= 0:
                return 1, 0
            if not (0 <= x <= width - 1.001 and 0 <= y <= height - 1.001):
                return 2, 0
    e = 1e-5
    jacobian = (
        np.array([moved(e, 0)[:2], moved(0, e)[:2]]) - np.array([moved(-e, 0)[:2], moved(0, -e)[:2]])
    ) / (2 * e)
    large, small = np.linalg.svd(jacobian)[1]
    if small < gates.min_scale or large > gates.max_scale:
        return 4, 0
    first, second, kept = [], [], []
    for i in range(-half, half + 1):
        for j in range(-half, half + 1):
            a = images[reference, v + i, u + j].astype(float)
            x, y = moved(j, i)[:2]
            b, four = bilinear(images[target], x, y)
            if all(((x > gates.dark) & (x < gates.bright)).all() for x in (a, four)):
                first.append(a)
                second.append(b)
                p, q = x % 1, y % 1
                kept.append(sum(w**2 for w in ((1 - p) * (1 - q), p * (1 - q), (1 - p) * q, p * q)))
    if len(first) < 2:
        return 6, 0
    first, second = np.array(first) - np.mean(first, axis=0), np.array(second) - np.mean(second, axis=0)
    variances = [
        max((x**2).mean(axis=0).sum() - gates.noise * part * channels, gates.contrast_floor * channels)
        for x, part in ((first, 1.0), (second, np.mean(kept)))
    ]
    ncc = (first * second).mean(axis=0).sum() / np.sqrt(variances[0] * variances[1])
    if len(first) / (2 * half + 1) ** 2 < gates.min_usable:
        return 6, ncc
    return (0 if ncc > gates.min_ncc else 7), ncc


def nearest_points(points, ranges, poses, intrinsics, width, height, cell, nearest):
    """Per image a dict from cell (row, column) to the index of its nearest point, or of the next where that is alone."""
    result = []
    for pose, (start, stop, step) in zip(poses, ranges, strict=True):
        index = np.arange(start, stop, step)
        uvz = project(points[index], pose, intrinsics)
        good = (uvz[:, 2] > nearest) & (uvz[:, :2] >= -0.5).all(1)
        good &= (uvz[:, 0] < width - 0.5) & (uvz[:, 1] < height - 0.5)
        cells = {}
        for m, (u, v, z) in zip(index[good], uvz[good], strict=True):
            cells.setdefault((int((v + 0.5) / cell), int((u + 0.5) / cell)), []).append((z, m))
        result.append(nearest_but_alone(cells)[0])
    return result


def visibility_map(points, offsets, near, size):
    """Dict from voxel (i, j, k) to the set of cameras that see it."""
    near_offsets, near_cameras = near
    result = {}
    for s in range(len(offsets) - 1):
        cameras = near_cameras[near_offsets[s] : near_offsets[s + 1]].tolist()
        for voxel in np.floor(points[offsets[s] : offsets[s + 1]].astype(float) / size).astype(int):
            result.setdefault(tuple(voxel.tolist()), set()).update(cameras)
    return result


def window(covariance8, offsets):
    """(1 - x^T A^-1 x)^2 inside the ellipse of A, sum 1. covariance8: A (2, 2); offsets: (N, 2), right and down"""
    inside = 1 - np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance8), offsets)
    weights = np.maximum(inside, 0) ** 2
    return weights / weights.sum()


def compare(reference, target, pixel, moved, shrink, jacobian, size, least):
    """(mean of the reference, mean of the target, spread, contrast) over windows of one footprint, 0 meaning masked.

    moved(du, dv) -> x, y, z; jacobian: (2, 2), d(x, y) / d(du, dv); size: px
    """
    half = size // 2
    offsets = np.array([(j, i) for i in range(-half, half + 1) for j in range(-half, half + 1)], float)
    square = (half + 0.5) ** 2 * np.eye(2)
    back = np.linalg.inv(shrink * jacobian)
    sample = 8 * 0.25 * back @ back.T
    sample *= min(1.0, 0.6 * square[0, 0] / np.linalg.eigvalsh(sample)[-1])
    own, other = window(square, offsets), window(square + 8 / 12 * np.eye(2) - sample, offsets)
    kept, a_values, b_values = [], [], []
    for n, (j, i) in enumerate(offsets.astype(int)):
        x, y, z = moved(j, i)
        if z <= 0:
            return -1, -1, 0, 0
        a = reference[pixel[1] + i, pixel[0] + j].astype(float)
        b, four = bilinear(target, (x + 0.5) * shrink - 0.5, (y + 0.5) * shrink - 0.5)
        if b is not None and (a > 0).all() and (four > 0).all() and own[n] + other[n] > 0:
            kept.append(n)
            a_values.append(a)
            b_values.append(b)
    if min(own[kept].sum(), other[kept].sum()) < least:
        return -1, -1, 0, 0
    a_mean = np.average(np.mean(a_values, axis=1), weights=own[kept])
    b_mean = np.average(np.mean(b_values, axis=1), weights=other[kept])
    difference = np.array(a_values) / a_mean - np.array(b_values) / b_mean
    spread = np.sqrt(np.average((difference**2).mean(axis=1), weights=other[kept]))
    contrast = 0.0
    for values, mean in ((np.array(a_values), a_mean), (np.array(b_values), b_mean)):
        middle = np.average(values.mean(axis=1), weights=other[kept])
        contrast += np.average(((values - middle) ** 2).mean(axis=1), weights=other[kept]) / mean**2
    return a_mean, b_mean, spread, np.sqrt(contrast)


def keep_spread(group, limit):
    keep = np.zeros(len(group), bool)
    for value in np.unique(group):
        members = np.flatnonzero(group == value)
        if len(members) > limit:
            members = members[[((2 * k + 1) * len(members)) // (2 * limit) for k in range(limit)]]
        keep[members] = True
    return keep
