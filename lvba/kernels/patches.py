"""Scene points of one pyramid level: LiDAR points seen by an image, gated, scored, the best of every grid cell.

Lengths in metres, world frame; pixels (column, row) of the level's images. One image is one unit of parallel work.
"""

import math

import numba
import numpy as np

_jit = numba.njit(cache=True, nogil=True)


@_jit
def project_near(
    points: np.ndarray,
    start: int,
    stop: int,
    step: int,
    world_from_camera: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    nearest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The points [start:stop:step] inside the image: uvz (N, 3) float32 and index (N,) int64.

    points: (M, 3) float32; world_from_camera: (4, 4); intrinsics: fx, fy, cx, cy; nearest: smallest depth
    """
    r, fx, fy, cx, cy = world_from_camera, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    uvz = np.empty((max((stop - start + step - 1) // step, 0), 3), np.float32)
    index = np.empty(len(uvz), np.int64)
    count = 0
    for m in range(start, stop, step):
        dx, dy, dz = points[m, 0] - r[0, 3], points[m, 1] - r[1, 3], points[m, 2] - r[2, 3]
        z = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
        if not z > nearest:
            continue
        # rounded before the test: rounded after it, 639.4999999 would be 639.5 and lie in a cell that is none
        u = np.float32(fx * (r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz) / z + cx)
        v = np.float32(fy * (r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz) / z + cy)
        if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
            continue
        uvz[count, 0], uvz[count, 1], uvz[count, 2] = u, v, z
        index[count] = m
        count += 1
    return uvz[:count].copy(), index[:count].copy()


@_jit
def bin_points(uvz: np.ndarray, width: int, height: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The points by square bins of `size` px: (offsets (bins + 1,), order (N,)), bins in rows, points in input order."""
    columns, rows = math.ceil(width / size), math.ceil(height / size)
    offsets = np.zeros(columns * rows + 1, np.int64)
    which = np.empty(len(uvz), np.int64)
    for k in range(len(uvz)):
        which[k] = int((uvz[k, 1] + 0.5) / size) * columns + int((uvz[k, 0] + 0.5) / size)
        offsets[which[k] + 1] += 1
    for b in range(len(offsets) - 1):
        offsets[b + 1] += offsets[b]
    fill = offsets[:-1].copy()
    order = np.empty(len(uvz), np.int64)
    for k in range(len(uvz)):
        order[fill[which[k]]] = k
        fill[which[k]] += 1
    return offsets, order


@_jit
def hiding_depth(z: float, tolerance: float) -> float:
    """What lies nearer than this may hide a point at depth z."""
    return 0.98 * z - tolerance


@_jit
def z_buffer(uvz: np.ndarray, width: int, height: int, size: float) -> np.ndarray:
    """The nearest point of every cell of `size` px, (rows, columns) int64, -1 where none; of equals the first."""
    nearest = np.full((math.ceil(height / size), math.ceil(width / size)), -1, np.int64)
    for k in range(len(uvz)):
        row, column = int((uvz[k, 1] + 0.5) / size), int((uvz[k, 0] + 0.5) / size)
        best = nearest[row, column]
        if best < 0 or uvz[k, 2] < uvz[best, 2]:
            nearest[row, column] = k
    return nearest


@_jit
def is_behind(
    k: int,
    q: int,
    uvz: np.ndarray,
    index: np.ndarray,
    points: np.ndarray,
    plane: np.ndarray,
    planes: np.ndarray,
    tolerance: float,
) -> bool:
    """Whether a nearer point q hides point k: it must lie off k's plane (a slanted plane does not hide itself).

    planes: (K, 7): centre, unit normal, tolerance in m of its points' distance
    """
    z = uvz[k, 2]
    own = plane[index[k]]
    if own < 0:
        return uvz[q, 2] < z - 2 * tolerance - 0.1 * z
    off = 0.0
    for a in range(3):
        off += planes[own, 3 + a] * (points[index[q], a] - planes[own, a])
    return abs(off) > max(planes[own, 6], 0.004 * z)


@_jit
def hidden_points(
    uvz: np.ndarray,
    index: np.ndarray,
    points: np.ndarray,
    plane: np.ndarray,
    planes: np.ndarray,
    width: int,
    height: int,
    size: float,
    tolerance: float,
) -> np.ndarray:
    """(N,) uint8: 0 seen; 1 something nearer in a neighbouring cell of the z-buffer; 2 covered: in the point's own cell,
    or in more than half of the cells round it that hold points (through a sparse surface what is behind shows)."""
    nearest = z_buffer(uvz, width, height, size)
    rows, columns = nearest.shape
    hidden = np.zeros(len(uvz), np.uint8)
    for k in range(len(uvz)):
        row, column = int((uvz[k, 1] + 0.5) / size), int((uvz[k, 0] + 0.5) / size)
        held, hiding, own, limit = 0, 0, False, hiding_depth(uvz[k, 2], tolerance)
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                q = nearest[i, j]
                if q < 0:
                    continue
                held += 1
                if uvz[q, 2] < limit and is_behind(k, q, uvz, index, points, plane, planes, tolerance):
                    hiding += 1
                    own = own or (i == row and j == column)
        if own or 2 * hiding > held:
            hidden[k] = 2
        elif hiding:
            hidden[k] = 1
    return hidden


@_jit
def support(
    column: int,
    row: int,
    own: int,
    reach: float,
    wide: float,
    uvz: np.ndarray,
    index: np.ndarray,
    hidden: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
    offsets: np.ndarray,
    order: np.ndarray,
    size: float,
    columns: int,
    rows: int,
) -> np.ndarray:
    """Do the LiDAR points round a pixel lie on plane `own`? Six numbers (float64).

    Points on the plane and points off it within `reach` px (square), then how far points on the plane extend to the
    left, right, top and bottom of the pixel, px, within `wide` px. Covered points do not count.
    """
    on, off, left, right, top, bottom = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(int((row - wide + 0.5) / size), 0), min(int((row + wide + 0.5) / size), rows - 1) + 1):
        first = max(int((column - wide + 0.5) / size), 0)
        last = min(int((column + wide + 0.5) / size), columns - 1)
        for o in range(offsets[i * columns + first], offsets[i * columns + last + 1]):
            k = order[o]
            du, dv = uvz[k, 0] - column, uvz[k, 1] - row
            if abs(du) > wide or abs(dv) > wide or hidden[k] == 2:
                continue
            distance = 0.0
            for a in range(3):
                distance += planes[own, 3 + a] * (points[index[k], a] - planes[own, a])
            inside = abs(du) <= reach and abs(dv) <= reach
            if abs(distance) <= max(planes[own, 6], 0.004 * uvz[k, 2]):
                on += inside
                left, right = max(left, -du), max(right, du)
                top, bottom = max(top, -dv), max(bottom, dv)
            elif inside:
                off += 1
    return np.array([on, off, left, right, top, bottom])


@_jit
def usable_part(image: np.ndarray, column: int, row: int, half: int, dark: float, bright: float) -> float:
    """The part of the pixels round (column, row) whose channels all lie strictly between `dark` and `bright`."""
    good = 0
    for i in range(row - half, row + half + 1):
        for j in range(column - half, column + half + 1):
            fine = True
            for channel in range(image.shape[2]):
                value = image[i, j, channel]
                fine = fine and dark < value < bright
            good += fine
    return good / float((2 * half + 1) ** 2)


@_jit
def meet(
    column: int, row: int, world_from_camera: np.ndarray, intrinsics: np.ndarray, plane: np.ndarray
) -> tuple[float, float, float, float, float]:
    """Where the ray of a pixel meets a plane: x, y, z (world), depth, and |cosine| of the viewing angle; depth -1: never.

    plane: (7,): centre, unit normal, tolerance
    """
    x = (column - intrinsics[2]) / intrinsics[0]
    y = (row - intrinsics[3]) / intrinsics[1]
    r = world_from_camera
    ray = np.empty(3)
    along, offset = 0.0, 0.0
    for a in range(3):
        ray[a] = r[a, 0] * x + r[a, 1] * y + r[a, 2]
        along += plane[3 + a] * ray[a]
        offset += plane[3 + a] * (plane[a] - r[a, 3])
    cosine = abs(along) / math.sqrt(x * x + y * y + 1)
    if along == 0 or offset / along <= 0:
        return 0.0, 0.0, 0.0, -1.0, cosine
    depth = offset / along
    return r[0, 3] + depth * ray[0], r[1, 3] + depth * ray[1], r[2, 3] + depth * ray[2], depth, cosine


@_jit
def passes(
    k: int,
    uvz: np.ndarray,
    index: np.ndarray,
    hidden: np.ndarray,
    points: np.ndarray,
    plane: np.ndarray,
    planes: np.ndarray,
    offsets: np.ndarray,
    order: np.ndarray,
    image: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: np.ndarray,
    gates: np.ndarray,
) -> bool:
    """Whether projected point k makes a scene point; gates as in `select_points`."""
    height, width = image.shape[0], image.shape[1]
    half, size = int(gates[0]), gates[8]
    spacing = math.sqrt(width * height / max(len(uvz), 1))
    wide = min(max(2.0, gates[9] * spacing / (half + 0.5)), 4.0) * (half + 0.5)
    column, row = math.floor(uvz[k, 0] + 0.5), math.floor(uvz[k, 1] + 0.5)
    _, _, _, depth, cosine = meet(column, row, world_from_camera, intrinsics, planes[plane[index[k]]])
    if cosine < gates[1] or depth < gates[7] or abs(depth - uvz[k, 2]) > 0.05 * uvz[k, 2] + 0.1:
        return False
    if usable_part(image, column, row, half, gates[2], gates[3]) < gates[4]:
        return False
    found = support(
        column, row, plane[index[k]], 2.0 * (half + 0.5), wide, uvz, index, hidden, points, planes,
        offsets, order, size, math.ceil(width / size), math.ceil(height / size),
    )  # fmt: skip
    if found[0] < gates[6] or found[1] > gates[5] * (found[0] + found[1]):
        return False
    return min(min(found[2], found[3]), min(found[4], found[5])) >= half


@_jit
def select_image(
    points: np.ndarray,
    plane: np.ndarray,
    planes: np.ndarray,
    start: int,
    stop: int,
    step: int,
    image: np.ndarray,
    score: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: np.ndarray,
    cell: int,
    gates: np.ndarray,
    pixel: np.ndarray,
    own: np.ndarray,
) -> int:
    """Fill pixel (C, 2) and own (C,) of one image, row by row of cells; the number of LiDAR points in the image."""
    height, width = image.shape[0], image.shape[1]
    uvz, index = project_near(
        points, start, stop, step, world_from_camera, intrinsics, width, height, gates[7]
    )
    # cells so large that few are empty, or what lies behind shows through
    spacing = math.sqrt(width * height / max(len(uvz), 1))
    buffer = max(gates[10], min(gates[11] * spacing, 2 * gates[0] + 1))
    hidden = hidden_points(uvz, index, points, plane, planes, width, height, buffer, gates[12])
    offsets, order = bin_points(uvz, width, height, gates[8])
    cell_offsets, cell_order = bin_points(uvz, width, height, float(cell))
    value = np.zeros(len(uvz), np.float32)
    margin = int(gates[0]) + 1
    for k in range(len(uvz)):
        column, row = math.floor(uvz[k, 0] + 0.5), math.floor(uvz[k, 1] + 0.5)
        inside = margin <= column < width - margin and margin <= row < height - margin
        if inside and plane[index[k]] >= 0 and hidden[k] == 0 and score[row, column] >= gates[13]:
            value[k] = score[row, column]
    for c in range(len(own)):
        for _ in range(int(gates[14])):
            best = -1
            for o in range(cell_offsets[c], cell_offsets[c + 1]):
                k = cell_order[o]
                if value[k] > 0 and (best < 0 or value[k] > value[best]):
                    best = k
            if best < 0:
                break
            if passes(
                best, uvz, index, hidden, points, plane, planes, offsets, order, image, world_from_camera,
                intrinsics, gates,
            ):  # fmt: skip
                pixel[c, 0] = math.floor(uvz[best, 0] + 0.5)
                pixel[c, 1] = math.floor(uvz[best, 1] + 0.5)
                own[c] = plane[index[best]]
                break
            value[best] = 0
    return len(uvz)


@numba.njit(parallel=True, cache=True, nogil=True)
def select_points(
    points: np.ndarray,
    plane: np.ndarray,
    planes: np.ndarray,
    ranges: np.ndarray,
    images: np.ndarray,
    scores: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: np.ndarray,
    cell: int,
    gates: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best point of every cell of every image: pixel (I, C, 2) int32, plane (I, C) int32 (-1: none), seen (I,) int64.

    points: (M, 3) float32; plane: (M,) int32, -1: on none; planes: (K, 7) float64: centre, normal, tolerance
    ranges: (I, 3) int64: first point, end, step of the points of the scans near each image
    images: (I, H, W, C); scores: (I, H, W) float32, |DoG|; world_from_camera: (I, 4, 4); intrinsics: fx, fy, cx, cy
    cell: px
    gates: [half patch, least |cosine|, dark, bright, least usable part, largest part off the plane, least number on
        the plane, least depth, bin px, reach of the support's extent in mean point spacings, least
        z-buffer cell px, z-buffer cell in mean point spacings, z tolerance m, least score, tries per cell]
    seen: LiDAR points inside the image, hidden ones included
    """
    count, height, width, _ = images.shape
    cells = math.ceil(width / cell) * math.ceil(height / cell)
    pixel = np.zeros((count, cells, 2), np.int32)
    own = np.full((count, cells), -1, np.int32)
    seen = np.zeros(count, np.int64)
    for i in numba.prange(count):
        seen[i] = select_image(
            points, plane, planes, ranges[i, 0], ranges[i, 1], ranges[i, 2], images[i], scores[i],
            world_from_camera[i], intrinsics, cell, gates, pixel[i], own[i],
        )  # fmt: skip
    return pixel, own, seen
