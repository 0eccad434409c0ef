"""The plane homography between two cameras (Li et al., eq. 7), its warp of a patch, and its Jacobian."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def relative_pose(
    rotation: np.ndarray,
    translation: np.ndarray,
    reference: int,
    target: int,
    relative: np.ndarray,
    offset: np.ndarray,
) -> None:
    """Fills `relative = R_t^T R_r` (3, 3) and `offset = R_t^T (t_r - t_t)` (3,)."""
    for i in range(3):
        offset[i] = 0.0
        for j in range(3):
            offset[i] += rotation[target, j, i] * (translation[reference, j] - translation[target, j])
            relative[i, j] = (
                rotation[target, 0, i] * rotation[reference, 0, j]
                + rotation[target, 1, i] * rotation[reference, 1, j]
                + rotation[target, 2, i] * rotation[reference, 2, j]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def plane_in_reference(
    rotation: np.ndarray,
    translation: np.ndarray,
    reference: int,
    position: np.ndarray,
    normal: np.ndarray,
    plane: np.ndarray,
) -> float:
    """Fills `plane = R_r^T n / (n^T (p - t_r))` (3,), the plane `plane . x = 1` in the reference camera.

    Returns `n^T (p - t_r)`, m.
    """
    distance = 0.0
    for i in range(3):
        distance += normal[i] * (position[i] - translation[reference, i])
    for i in range(3):
        plane[i] = (
            rotation[reference, 0, i] * normal[0]
            + rotation[reference, 1, i] * normal[1]
            + rotation[reference, 2, i] * normal[2]
        ) / distance
    return distance


@njit(cache=True, nogil=True, error_model="numpy")
def patch_warp(
    relative: np.ndarray,
    offset: np.ndarray,
    plane: np.ndarray,
    ray: np.ndarray,
    intrinsics: np.ndarray,
    warp: np.ndarray,
) -> float:
    """Fills the warp (8,) of a patch and returns `z_t / z_r` at its centre.

    For a pixel offset (i, j) from the centre, `d = 1 + warp[6] i + warp[7] j`, the target pixel is
    `((warp[0] i + warp[1] j + warp[2]) / d, (warp[3] i + warp[4] j + warp[5]) / d)`.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
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


@njit(cache=True, nogil=True, error_model="numpy")
def warp_bounds(warp: np.ndarray, radius: int) -> tuple[float, float, float, float]:
    """Least and greatest column and row (4 floats) of the warped patch; NaN where a corner is behind the camera."""
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


@njit(cache=True, nogil=True, error_model="numpy")
def center_jacobian(
    relative: np.ndarray,
    offset: np.ndarray,
    plane: np.ndarray,
    distance: float,
    ray: np.ndarray,
    intrinsics: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """Fills (2, 13): target pixel of the patch centre by `[rotation_r | translation_r | rotation_t | translation_t]`
    and by an offset of the plane along its normal.

    Local (right) perturbations. The reference pixel is fixed, so its ray meets the fixed plane anew (where the
    paper's reference pixel moves with the pose through eq. 5).
    """
    depth = 1.0 / (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
    point = np.empty(3)
    for i in range(3):
        point[i] = (
            depth * (relative[i, 0] * ray[0] + relative[i, 1] * ray[1] + relative[i, 2] * ray[2]) + offset[i]
        )
    for axis in range(2):
        focal = intrinsics[axis] / point[2]
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
