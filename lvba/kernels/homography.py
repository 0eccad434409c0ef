"""The plane homography between two cameras (Li et al., eq. 7), its warp of a patch, and its Jacobian.

With `m = K^-1 u`, `R = R_t^T R_r`, `a = R_t^T (t_r - t_t)` and `k = R_r^T n / (n^T (p - t_r))`: `y = (R + a k^T) m`, and
the third component of y is depth in the target over depth in the reference.
"""

import numpy as np

from lvba.kernels.compiled import kernel
from lvba.kernels.scene import Intrinsics


@kernel
def relative_pose(
    poses: np.ndarray, reference: int, target: int, relative: np.ndarray, offset: np.ndarray
) -> None:
    """Fills `relative = R_t^T R_r` (3, 3) and `offset = R_t^T (t_r - t_t)` (3,). poses: (I, 4, 4) float64,
    world_from_camera

    relative: (3, 3) float64, out; offset: (3,) float64, m, out
    """
    r, t = poses[reference], poses[target]
    for i in range(3):
        offset[i] = 0.0
        for j in range(3):
            offset[i] += t[j, i] * (r[j, 3] - t[j, 3])
            relative[i, j] = t[0, i] * r[0, j] + t[1, i] * r[1, j] + t[2, i] * r[2, j]


@kernel
def plane_in_reference(
    pose: np.ndarray, position: np.ndarray, normal: np.ndarray, plane: np.ndarray
) -> float:
    """Fills `plane = R_r^T n / (n^T (p - t_r))` (3,), the plane `plane . x = 1` in the reference camera.

    pose: (4, 4) float64, world_from_camera of the reference; position: (3,) float64, m, and normal: (3,) float64, unit,
    world. Returns `n^T (p - t_r)`, m.
    plane: (3,) float64, 1/m, out
    """
    distance = 0.0
    for i in range(3):
        distance += normal[i] * (position[i] - pose[i, 3])
    for i in range(3):
        plane[i] = (pose[0, i] * normal[0] + pose[1, i] * normal[1] + pose[2, i] * normal[2]) / distance
    return distance


@kernel
def plane_homography(
    poses: np.ndarray,
    reference: int,
    target: int,
    position: np.ndarray,
    normal: np.ndarray,
    intrinsics: Intrinsics,
) -> np.ndarray:
    """`K (R + a k^T) K^-1`, (3, 3): pixels of the reference to homogeneous ones of the target.

    poses: (I, 4, 4) float64, world_from_camera; position: (3,) float64, m, and normal: (3,) float64, unit, world, of the
    plane; intrinsics: of both images
    """
    relative, offset, plane = np.empty((3, 3)), np.empty(3), np.empty(3)
    relative_pose(poses, reference, target, relative, offset)
    plane_in_reference(poses[reference], position, normal, plane)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    h = np.empty((3, 3))
    for i in range(3):
        h[i, 0] = (relative[i, 0] + offset[i] * plane[0]) / fx
        h[i, 1] = (relative[i, 1] + offset[i] * plane[1]) / fy
        h[i, 2] = relative[i, 2] + offset[i] * plane[2] - h[i, 0] * cx - h[i, 1] * cy
    for j in range(3):
        h[0, j] = fx * h[0, j] + cx * h[2, j]
        h[1, j] = fy * h[1, j] + cy * h[2, j]
    return h


@kernel
def patch_warp(
    relative: np.ndarray,
    offset: np.ndarray,
    plane: np.ndarray,
    ray: np.ndarray,
    intrinsics: Intrinsics,
    warp: np.ndarray,
) -> float:
    """Fills the warp (8,) of a patch and returns `z_t / z_r` at its centre.

    It is the homography about the centre of the patch, so that small numbers are summed: for a pixel offset (i, j) from
    there, `d = 1 + warp[6] i + warp[7] j`, the target pixel is
    `((warp[0] i + warp[1] j + warp[2]) / d, (warp[3] i + warp[4] j + warp[5]) / d)`.
    relative: (3, 3), offset: (3,) of `relative_pose`; plane: (3,) of `plane_in_reference`; ray: (3,) float64, `K^-1 u`
    warp: (8,) float64, out
    """
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    scale = plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2]
    center_z = relative[2, 0] * ray[0] + relative[2, 1] * ray[1] + relative[2, 2] * ray[2] + offset[2] * scale
    i_z = (relative[2, 0] + offset[2] * plane[0]) / (fx * center_z)
    j_z = (relative[2, 1] + offset[2] * plane[1]) / (fy * center_z)
    for axis in range(2):
        focal, center = (fx, cx) if axis == 0 else (fy, cy)
        value = relative[axis, 0] * ray[0] + relative[axis, 1] * ray[1] + relative[axis, 2] * ray[2]
        value += offset[axis] * scale
        warp[3 * axis] = (
            focal * (relative[axis, 0] + offset[axis] * plane[0]) / (fx * center_z) + center * i_z
        )
        warp[3 * axis + 1] = (
            focal * (relative[axis, 1] + offset[axis] * plane[1]) / (fy * center_z) + center * j_z
        )
        warp[3 * axis + 2] = focal * value / center_z + center
    warp[6] = i_z
    warp[7] = j_z
    return center_z


@kernel
def shift_warp(warp: np.ndarray, shift: np.ndarray) -> None:
    """Adds a shift to the target pixels of a warp.

    warp: (8,) float64, of `patch_warp`; shift: (2,) float64, px
    """
    for axis in range(2):
        warp[3 * axis] += shift[axis] * warp[6]
        warp[3 * axis + 1] += shift[axis] * warp[7]
        warp[3 * axis + 2] += shift[axis]


@kernel
def warp_bounds(warp: np.ndarray, radius: int) -> tuple[float, float, float, float]:
    """Least and greatest column and row (4 floats) of the warped patch; NaN where a corner is behind the camera.

    warp: (8,) of `patch_warp`; radius: px, half the patch
    """
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in (-radius, radius):
        for j in (-radius, radius):
            depth = 1.0 + warp[6] * i + warp[7] * j
            if not depth > 0.05:
                return np.nan, np.nan, np.nan, np.nan
            x = (warp[0] * i + warp[1] * j + warp[2]) / depth
            y = (warp[3] * i + warp[4] * j + warp[5]) / depth
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    return low_x, high_x, low_y, high_y


@kernel
def center_jacobian(
    relative: np.ndarray,
    offset: np.ndarray,
    plane: np.ndarray,
    distance: float,
    ray: np.ndarray,
    intrinsics: Intrinsics,
    jacobian: np.ndarray,
) -> None:
    """Fills (2, 13): target pixel of the patch centre by `[rotation_r | translation_r | rotation_t | translation_t]`
    and by an offset of the plane along its normal.

    Local (right) perturbations. The reference pixel is fixed, so its ray meets the fixed plane anew (where the
    paper's reference pixel moves with the pose through eq. 5). distance: m, of `plane_in_reference`; the others as of
    `patch_warp`
    relative: (3, 3) float64; offset: (3,) float64, m; plane: (3,) float64, 1/m; ray: (3,) float64, `K^-1 u`
    jacobian: (2, 13) float64, px per rad and per m, out
    """
    depth = 1.0 / (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
    point = np.empty(3)
    for i in range(3):
        point[i] = (
            depth * (relative[i, 0] * ray[0] + relative[i, 1] * ray[1] + relative[i, 2] * ray[2]) + offset[i]
        )
    for axis in range(2):
        focal = (intrinsics.fx if axis == 0 else intrinsics.fy) / point[2]
        to_pixel_x = focal if axis == 0 else 0.0
        to_pixel_y = focal if axis == 1 else 0.0
        to_pixel_z = -focal * point[axis] / point[2]
        jacobian[axis, 6] = to_pixel_y * point[2] - to_pixel_z * point[1]
        jacobian[axis, 7] = to_pixel_z * point[0] - to_pixel_x * point[2]
        jacobian[axis, 8] = to_pixel_x * point[1] - to_pixel_y * point[0]
        jacobian[axis, 9], jacobian[axis, 10], jacobian[axis, 11] = -to_pixel_x, -to_pixel_y, -to_pixel_z
        g0 = to_pixel_x * relative[0, 0] + to_pixel_y * relative[1, 0] + to_pixel_z * relative[2, 0]
        g1 = to_pixel_x * relative[0, 1] + to_pixel_y * relative[1, 1] + to_pixel_z * relative[2, 1]
        g2 = to_pixel_x * relative[0, 2] + to_pixel_y * relative[1, 2] + to_pixel_z * relative[2, 2]
        along = depth * (g0 * ray[0] + g1 * ray[1] + g2 * ray[2])
        g0, g1, g2 = g0 - along * plane[0], g1 - along * plane[1], g2 - along * plane[2]
        jacobian[axis, 0] = depth * (ray[1] * g2 - ray[2] * g1)
        jacobian[axis, 1] = depth * (ray[2] * g0 - ray[0] * g2)
        jacobian[axis, 2] = depth * (ray[0] * g1 - ray[1] * g0)
        jacobian[axis, 3], jacobian[axis, 4], jacobian[axis, 5] = g0, g1, g2
        jacobian[axis, 12] = along / distance
