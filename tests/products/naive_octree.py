"""The octree as one would describe it, point by point."""

import itertools


def levels(points, bits, first, leaf_points, grid_levels=7, key_levels=21):
    """The level of each whole-number point (N, 3) in [0, 2^bits)."""
    fine = [tuple((int(x) << key_levels) >> bits for x in point) for point in points]
    out = [None] * len(points)

    def divide(members, level):
        last = level == key_levels - grid_levels
        if last or (level >= first and len(members) <= leaf_points):
            for i in members:
                out[i] = level
            return
        below = key_levels - grid_levels - level
        cells = {}
        for i in members:
            cells.setdefault(tuple(x >> below for x in fine[i]), []).append(i)
        for cell in cells.values():
            kept = min(cell, key=lambda i: (off_center(fine[i], below), interleaved(fine[i], key_levels), i))
            out[kept] = level
        rest = [i for i in members if out[i] is None]
        child = key_levels - level - 1
        for corner in itertools.product((0, 1), repeat=3):
            inside = [i for i in rest if tuple(fine[i][a] >> child & 1 for a in range(3)) == corner]
            if inside:
                divide(inside, level + 1)

    if points:
        divide(range(len(points)), 0)
    return out


def off_center(point, below):
    size = 1 << below
    return sum((2 * (x % size) + 1 - size) ** 2 for x in point)


def interleaved(point, bits):
    key = 0
    for bit in reversed(range(bits)):
        for x in point:
            key = key << 1 | (x >> bit & 1)
    return key
