"""Planes fitted anew to the points near them, once more, slow and plain."""

import numpy as np

from lvba.kernels import plane_refit as kernel


def refit(points, cell_of_point, plane_of_point, weight, k, center, axes, gate):
    """center, eigenvalues, eigenvectors (rows), height, over_noise of plane k, from the points themselves.

    cell_of_point: (M, 3) integers; axes: of all planes, (K, 3, 3), columns; center, gate: of plane k
    """
    own = plane_of_point == k
    cells = {tuple(c) for c in cell_of_point[own]}
    touching = {
        (x + a, y + b, z + c) for x, y, z in cells for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)
    }
    near = np.array([tuple(c) in touching for c in cell_of_point])
    local = (points - center) @ axes[k]
    low, high = local[own, 1:].min(0), local[own, 1:].max(0)
    edge = max(np.sqrt(np.prod(high - low) * kernel.PATCH_POINTS / own.sum()), kernel.PATCH_MIN_M)
    sides = np.clip(((high - low) / edge).astype(int), 1, kernel.MOST_PATCHES)
    patch = np.floor((local[:, 1:] - low) / ((high - low) / sides * (1 + 1e-9))).astype(int)
    used = {tuple(p) for p in patch[own]}
    over = near & np.array([tuple(p) in used for p in patch]) & (np.abs(local[:, 0]) <= 2 * gate)
    other = (plane_of_point >= 0) & ~own
    over &= ~other | (axes[plane_of_point, :, 0] @ axes[k][:, 0] >= kernel.ALONG)
    spot, normal = center, axes[k][:, 0]
    for _ in range(kernel.TURNS):
        inside = over & (np.abs((points - spot) @ normal) <= gate)
        spot = np.average(points[inside], axis=0, weights=weight[inside])
        away = points[inside] - spot
        values, vectors = np.linalg.eigh((away * weight[inside, None]).T @ away / weight[inside].sum())
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ axes[k][:, 0])
    height = (points - spot) @ normal
    inside = over & (np.abs(height) <= gate)
    groups = {}
    for p, h in zip(patch[inside], height[inside], strict=True):
        groups.setdefault(tuple(p), []).append(h)
    groups = [np.array(g) for g in groups.values() if len(g) >= kernel.FEWEST]
    if len(groups) <= 3:
        return spot, values, normal, 0.0, np.nan
    count = sum(map(len, groups))
    noise = sum(((g - g.mean()) ** 2).sum() for g in groups) / sum(len(g) - 1 for g in groups)
    noise *= len(groups) - 3
    squares = sum(len(g) * g.mean() ** 2 for g in groups)
    return spot, values, normal, np.sqrt(max(squares - noise, 0) / count), squares / noise
