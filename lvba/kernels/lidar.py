"""The plane cost of LiDAR bundle adjustment and its exact first and second derivatives.

A feature f is a plane seen by several scans; an observation o is what one scan holds of it, a weighted point cluster in
the scan's frame. Cost of a feature: N lam0, the weighted sum of squared point-plane distances at the best plane, N the
weighted number of points and lam0 <= lam1 <= lam2 the eigenvalues of the weighted covariance of all its points.
Source of the derivatives: Liu, Liu and Zhang 2023 (BALM2), section IV, regrouped: a feature's Hessian is block-diagonal
minus rank three, H = D - W W'. Perturbation of scan i, world axes about the sensor's own position (BALM2: about the
world's origin, which loses digits far from it): R <- exp(phi) R, t <- t + tau.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.point_cluster import (
    Clusters,
    add_cluster,
    eigen3,
    fill_cross,
    move_cluster,
    rotate_scatter,
)

TILE = 12
"""Neighboring scans whose parts of W share a panel: enough of them to fill whole vector registers."""
_WIDTH = 6 * TILE
_ROWS = 3


class Fits(NamedTuple):
    """Best planes of F features, world frame. total: (F,) float64, sum of weights; center: (F, 3) float64, m

    eigenvalues: (F, 3) float64, m^2, ascending; eigenvectors: (F, 3, 3) float64, unit, as rows
    """

    total: np.ndarray
    center: np.ndarray
    eigenvalues: np.ndarray
    eigenvectors: np.ndarray


class ByScan(NamedTuple):
    """Observations by scan: scan s owns order[starts[s]] to order[starts[s + 1]].

    starts: (S + 1,) int64; order: (O,) int64
    """

    starts: np.ndarray
    order: np.ndarray


class Panels(NamedTuple):
    """Where W is kept: tile t of TILE scans owns panels starts[t] to starts[t + 1], ascending in feature.

    starts: (tiles + 1,) int64; feature: (P,) int32; seen: (P,) int64, bit s is set where scan s of the tile sees it
    """

    starts: np.ndarray
    feature: np.ndarray
    seen: np.ndarray


@parallel_kernel
def fit(poses: np.ndarray, offsets: np.ndarray, scan: np.ndarray, clusters: Clusters) -> Fits:
    """The best plane of each feature at given poses.

    poses: (S, 4, 4) float64, world_from_scan; offsets: (F + 1,) int64, feature f owns observations offsets[f] to
    offsets[f + 1]; scan: (O,) int32; clusters: (O,), weighted, scan frame
    """
    features = len(offsets) - 1
    total = np.zeros(features)
    center = np.zeros((features, 3))
    values = np.zeros((features, 3))
    vectors = np.zeros((features, 3, 3))
    for f in prange(features):
        sums = np.zeros(6)
        world_mean = np.empty(3)
        world_scatter = np.empty(6)
        for o in range(offsets[f], offsets[f + 1]):
            pose = poses[scan[o]]
            move_cluster(pose, clusters.mean[o], clusters.scatter[o], world_mean, world_scatter)
            add_cluster(total[f : f + 1], center[f], sums, clusters.total[o], world_mean, world_scatter)
        if total[f] > 0.0:
            for a in range(6):
                sums[a] /= total[f]
            eigen3(sums, values[f], vectors[f])
    return Fits(total, center, values, vectors)


@parallel_kernel
def distances(
    poses: np.ndarray,
    offsets: np.ndarray,
    scan: np.ndarray,
    clusters: Clusters,
    center: np.ndarray,
    normal: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How far each observation's mean is from its plane, (O,), and its points' sum of squares along the normal, (O,).

    float64, m and m^2. As in `fit`; center: (F, 3) float64, m, and normal: (F, 3) float64, unit, world frame
    poses, offsets, scan: as in `fit`
    """
    distance, within = np.empty(len(scan)), np.empty(len(scan))
    for f in prange(len(offsets) - 1):
        c, n = center[f], normal[f]
        for o in range(offsets[f], offsets[f + 1]):
            r, m, s = poses[scan[o]], clusters.mean[o], clusters.scatter[o]
            x = r[0, 0] * n[0] + r[1, 0] * n[1] + r[2, 0] * n[2]
            y = r[0, 1] * n[0] + r[1, 1] * n[1] + r[2, 1] * n[2]
            z = r[0, 2] * n[0] + r[1, 2] * n[1] + r[2, 2] * n[2]
            offset = n[0] * (c[0] - r[0, 3]) + n[1] * (c[1] - r[1, 3]) + n[2] * (c[2] - r[2, 3])
            distance[o] = x * m[0] + y * m[1] + z * m[2] - offset
            cross = s[1] * x * y + s[2] * x * z + s[4] * y * z
            within[o] = s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * cross
    return distance, within


@parallel_kernel
def linearize(
    poses: np.ndarray,
    by_scan: ByScan,
    feature: np.ndarray,
    clusters: Clusters,
    fits: Fits,
    panel: np.ndarray,
    panels: int,
    exact: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient (S, 6), diagonal part D (S, 6, 6) and W of sum_f N lam0, in panels: (P, 3, 6 TILE); float64.

    poses: (S, 4, 4) float64, world_from_scan; feature: (O,) int32; clusters: (O,), weighted, scan frame; fits: of `fit`
    at the same poses; panel: (O,) int32, where the observation's part of W goes, in the place of its scan in the tile.
    exact:
    False drops what depends on the residuals (Gauss-Newton with the planes eliminated): never indefinite, for poses far
    from the solution.
    """
    scans, mean, center, vectors = len(poses), clusters.mean, fits.center, fits.eigenvectors
    second = 1.0 if exact else 0.0
    gradient = np.zeros((scans, 6))
    diagonal = np.zeros((scans, 6, 6))
    columns = np.zeros((panels, 3, _WIDTH))
    for s in prange(scans):
        r = poses[s]
        x, y = 6 * (s % TILE), 6 * (s % TILE) + 3
        lever = np.empty(3)
        moved = np.empty(6)
        turned = np.empty(6)
        cross = np.zeros((3, 3))
        q = np.empty((3, 3))
        ue = np.empty(3)
        b = np.empty(3)
        for k in range(by_scan.starts[s], by_scan.starts[s + 1]):
            o = by_scan.order[k]
            f = feature[o]
            n = clusters.total[o]
            for a in range(3):
                lever[a] = r[a, 0] * mean[o, 0] + r[a, 1] * mean[o, 1] + r[a, 2] * mean[o, 2]
            rotate_scatter(r, clusters.scatter[o], moved)
            for j in range(3):
                u = vectors[f, j]
                ue[j] = n * (
                    u[0] * (lever[0] + r[0, 3] - center[f, 0])
                    + u[1] * (lever[1] + r[1, 3] - center[f, 1])
                    + u[2] * (lever[2] + r[2, 3] - center[f, 2])
                )
                q[j, 0] = moved[0] * u[0] + moved[1] * u[1] + moved[2] * u[2] + ue[j] * lever[0]
                q[j, 1] = moved[1] * u[0] + moved[3] * u[1] + moved[4] * u[2] + ue[j] * lever[1]
                q[j, 2] = moved[2] * u[0] + moved[4] * u[1] + moved[5] * u[2] + ue[j] * lever[2]
            u0 = vectors[f, 0]
            q0 = q[0]
            # columns of W and the gradient
            b[0] = n * (lever[1] * u0[2] - lever[2] * u0[1])
            b[1] = n * (lever[2] * u0[0] - lever[0] * u0[2])
            b[2] = n * (lever[0] * u0[1] - lever[1] * u0[0])
            scale = np.sqrt(2.0 / fits.total[f])
            w = columns[panel[o]]
            for a in range(3):
                w[0, x + a] = scale * b[a]
                w[0, y + a] = scale * n * u0[a]
            for j in range(1, 3):
                u, qj = vectors[f, j], q[j]
                gap = fits.eigenvalues[f, j] - second * fits.eigenvalues[f, 0]
                scale = np.sqrt(2.0 / (fits.total[f] * gap)) if gap > 0.0 else 0.0
                w[j, x] = scale * (qj[1] * u0[2] - qj[2] * u0[1] + second * (q0[1] * u[2] - q0[2] * u[1]))
                w[j, x + 1] = scale * (qj[2] * u0[0] - qj[0] * u0[2] + second * (q0[2] * u[0] - q0[0] * u[2]))
                w[j, x + 2] = scale * (qj[0] * u0[1] - qj[1] * u0[0] + second * (q0[0] * u[1] - q0[1] * u[0]))
                for a in range(3):
                    w[j, y + a] = scale * (ue[j] * u0[a] + second * ue[0] * u[a])
            gradient[s, 0] += 2.0 * (q0[1] * u0[2] - q0[2] * u0[1])
            gradient[s, 1] += 2.0 * (q0[2] * u0[0] - q0[0] * u0[2])
            gradient[s, 2] += 2.0 * (q0[0] * u0[1] - q0[1] * u0[0])
            for a in range(3):
                gradient[s, 3 + a] += 2.0 * ue[0] * u0[a]
            # D: the plane held fixed, and the curvature of the rotation
            fill_cross(u0, cross)
            rotate_scatter(cross, moved, turned)
            d = diagonal[s]
            full = (turned[0], turned[1], turned[2], turned[3], turned[4], turned[5])
            d[0, 0] += 2.0 * full[0]
            d[0, 1] += 2.0 * full[1]
            d[0, 2] += 2.0 * full[2]
            d[1, 1] += 2.0 * full[3]
            d[1, 2] += 2.0 * full[4]
            d[2, 2] += 2.0 * full[5]
            along = 2.0 * second * (u0[0] * q0[0] + u0[1] * q0[1] + u0[2] * q0[2])
            for a in range(3):
                d[a, a] -= along
                for c in range(a, 3):
                    d[a, c] += 2.0 * b[a] * b[c] / n + second * (u0[a] * q0[c] + q0[a] * u0[c])
                    d[3 + a, 3 + c] += 2.0 * n * u0[a] * u0[c]
                for c in range(3):
                    d[a, 3 + c] += 2.0 * b[a] * u0[c]
        for a in range(6):
            for c in range(a):
                diagonal[s, a, c] = diagonal[s, c, a]
    return gradient, diagonal, columns


# contract: product and sum in one instruction, with one rounding less; nothing is summed in another order
@kernel(fastmath={"contract"})
def _add_rows(block: np.ndarray, x: int, own: np.ndarray, other: np.ndarray) -> None:
    """Rows x to x + _ROWS of own' other onto those of the block; together, so that `other` is loaded once."""
    row0, row1, row2 = block[x], block[x + 1], block[x + 2]
    a0, a1, a2 = own[0, x], own[1, x], own[2, x]
    b0, b1, b2 = own[0, x + 1], own[1, x + 1], own[2, x + 1]
    c0, c1, c2 = own[0, x + 2], own[1, x + 2], own[2, x + 2]
    other0, other1, other2 = other[0], other[1], other[2]
    for y in range(_WIDTH):
        w0, w1, w2 = other0[y], other1[y], other2[y]
        row0[y] += a0 * w0 + a1 * w1 + a2 * w2
        row1[y] += b0 * w0 + b1 * w1 + b2 * w2
        row2[y] += c0 * w0 + c1 * w1 + c2 * w2


@kernel
def _tile_product(i: int, j: int, panels: Panels, columns: np.ndarray) -> np.ndarray:
    """(6 TILE, 6 TILE) of W W', scans of tile i by scans of tile j: over the features that have a panel in both."""
    starts, feature, seen = panels.starts, panels.feature, panels.seen
    block = np.zeros((_WIDTH, _WIDTH))
    a, b = starts[i], starts[j]
    while a < starts[i + 1] and b < starts[j + 1]:
        if feature[a] < feature[b]:
            a += 1
        elif feature[a] > feature[b]:
            b += 1
        else:
            for s in range(TILE):
                if (seen[a] >> s) & 1:
                    for x in range(6 * s, 6 * s + 6, _ROWS):
                        _add_rows(block, x, columns[a], columns[b])
            a += 1
            b += 1
    return block


@kernel
def coupled(panels: Panels, pairs: np.ndarray, scans: int) -> np.ndarray:
    """(Q, TILE, TILE) bool: which scans of the first and the second tile of a pair, the first scan not after the second,
    see a feature together; each scan with itself.

    pairs: (Q, 2) int64, tiles, the first not after the second; scans: S, how many there are
    """
    starts, feature, seen = panels.starts, panels.feature, panels.seen
    out = np.zeros((len(pairs), TILE, TILE), np.bool_)
    for q in range(len(pairs)):
        i, j = pairs[q, 0], pairs[q, 1]
        masks = np.zeros(TILE, np.int64)
        a, b = starts[i], starts[j]
        while a < starts[i + 1] and b < starts[j + 1]:
            if feature[a] < feature[b]:
                a += 1
            elif feature[a] > feature[b]:
                b += 1
            else:
                for s in range(TILE):
                    if (seen[a] >> s) & 1:
                        masks[s] |= seen[b]
                a += 1
                b += 1
        for s in range(min(TILE, scans - TILE * i)):
            for u in range(min(TILE, scans - TILE * j)):
                row, column = TILE * i + s, TILE * j + u
                out[q, s, u] = row == column or (row < column and ((masks[s] >> u) & 1) == 1)
    return out


@kernel
def _turn_block(
    block: np.ndarray, x: int, y: int, left: np.ndarray, right: np.ndarray, out: np.ndarray
) -> None:
    """out (6, 6) = L' B R, where B is 6 x 6 from (x, y) on, and L, R have the rotations of the poses left and right
    twice on their diagonal."""
    half = np.empty((6, 6))
    for a in range(6):
        for c in range(6):
            first, turn = 3 * (c // 3), c % 3
            half[a, c] = (
                block[x + a, y + first] * right[0, turn]
                + block[x + a, y + first + 1] * right[1, turn]
                + block[x + a, y + first + 2] * right[2, turn]
            )
    for a in range(6):
        first, turn = 3 * (a // 3), a % 3
        for c in range(6):
            out[a, c] = (
                left[0, turn] * half[first, c]
                + left[1, turn] * half[first + 1, c]
                + left[2, turn] * half[first + 2, c]
            )


@parallel_kernel
def hessian(
    panels: Panels,
    diagonal: np.ndarray,
    columns: np.ndarray,
    poses: np.ndarray,
    pairs: np.ndarray,
    slot: np.ndarray,
    blocks: int,
) -> np.ndarray:
    """Blocks (M, 6, 6) float64 of H = D - W W' on and above its diagonal, each pose in its own axes.

    diagonal: (S, 6, 6) and columns: (P, 3, 6 TILE) of `linearize`, world axes; poses: (S, 4, 4) float64, world_from_scan;
    pairs: (Q, 2) int64, of tiles, the first not after the second; slot: (Q, TILE, TILE) int32, where the block of two
    of their scans is written, -1: nowhere; blocks: M. Pairs of tiles are outputs of one thread each, and small enough to
    stay in its cache.
    """
    scans = len(diagonal)
    out = np.zeros((blocks, 6, 6))
    for h in prange((len(pairs) + 1) // 2):
        # near pairs have more in common than far ones: a thread's static share gets of both alike
        for turn in range(2):
            n = np.int64(h) if turn == 0 else np.int64(len(pairs) - 1 - h)
            i, j = pairs[n, 0], pairs[n, 1]
            if turn == 1 and n == h:
                continue
            block = _tile_product(i, j, panels, columns)
            for s in range(min(TILE, scans - TILE * i)):
                row = TILE * i + s
                for u in range(min(TILE, scans - TILE * j)):
                    column = TILE * j + u
                    at = slot[n, s, u]
                    if at < 0:
                        continue
                    for a in range(6):
                        for c in range(6):
                            own = diagonal[row, a, c] if row == column else 0.0
                            block[6 * s + a, 6 * u + c] = own - block[6 * s + a, 6 * u + c]
                    _turn_block(block, 6 * s, 6 * u, poses[row], poses[column], out[at])
                    if row == column:
                        for a in range(6):
                            for c in range(a):
                                out[at, a, c] = out[at, c, a]
    return out


@parallel_kernel
def information(
    poses: np.ndarray,
    by_scan: ByScan,
    feature: np.ndarray,
    clusters: Clusters,
    vectors: np.ndarray,
    variance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Information of each scan's observations about its pose, planes held fixed: (S, 6, 6), and the part of it that is
    due to the noise of the normals alone, (S, 6, 6): a normal that is off seems to measure a motion along its plane.

    variance: (F, 2) float64, rad^2, of each plane's normal towards its two tangents; vectors: (F, 3, 3) float64, the
    planes' eigenvectors; the others as in `linearize`. World axes about each sensor; sums of weights, that is times
    sigma^2.
    poses, feature: as in `linearize`
    """
    scans, mean = len(poses), clusters.mean
    blocks = np.zeros((scans, 6, 6))
    of_noise = np.zeros((scans, 6, 6))
    for s in prange(scans):
        r = poses[s]
        lever = np.empty(3)
        moved = np.empty(6)
        turned = np.empty(6)
        cross = np.zeros((3, 3))
        row = np.empty(6)
        for k in range(by_scan.starts[s], by_scan.starts[s + 1]):
            o = by_scan.order[k]
            f = feature[o]
            for a in range(3):
                lever[a] = r[a, 0] * mean[o, 0] + r[a, 1] * mean[o, 1] + r[a, 2] * mean[o, 2]
            rotate_scatter(r, clusters.scatter[o], moved)
            for j in range(3):
                u = vectors[f, j]
                weight = 1.0 if j == 0 else variance[f, j - 1]
                fill_cross(u, cross)
                rotate_scatter(cross, moved, turned)
                row[0] = lever[1] * u[2] - lever[2] * u[1]
                row[1] = lever[2] * u[0] - lever[0] * u[2]
                row[2] = lever[0] * u[1] - lever[1] * u[0]
                row[3], row[4], row[5] = u[0], u[1], u[2]
                out = blocks[s] if j == 0 else of_noise[s]
                scale = weight * clusters.total[o]
                for a in range(6):
                    for c in range(6):
                        out[a, c] += scale * row[a] * row[c]
                out[0, 0] += weight * turned[0]
                out[0, 1] += weight * turned[1]
                out[0, 2] += weight * turned[2]
                out[1, 0] += weight * turned[1]
                out[1, 1] += weight * turned[3]
                out[1, 2] += weight * turned[4]
                out[2, 0] += weight * turned[2]
                out[2, 1] += weight * turned[4]
                out[2, 2] += weight * turned[5]
    return blocks, of_noise
