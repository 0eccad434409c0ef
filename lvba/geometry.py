"""Rigid transforms as (..., 4, 4) float64 arrays, named `a_from_b`: `x_a = a_from_b @ x_b`.

Tangent vectors are `[rotation (rad) | translation (m)]`, 6 numbers, and act on the right: `retract(a_from_b, delta) =
a_from_b @ exp(delta)`. So both parts are in the axes of b (the sensor's own), the rotation is about b's origin, and to
first order `R <- R (1 + [rotation]x)`, `t <- t + R translation`. All steps, Jacobians, normal equations and covariances
of poses, LiDAR's and visual ones, are in this tangent. Leading axes broadcast as in numpy.
Source of the closed forms: Sola et al. 2018, "A micro Lie theory", appendix D.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from lvba.arrays import Pose, Poses, Rotations, Tangents, Transforms

_SMALL_ANGLE = 1e-5
_HALF_A_TURN = -0.98
"""Cosine of an angle near pi."""


def from_rotation_translation(rotation: Rotations, translation: np.ndarray) -> np.ndarray:
    """The (..., 4, 4) transform of a (..., 3, 3) rotation matrix and a (..., 3) translation.

    translation: (..., 3) float64, m
    """
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transform = np.zeros((*shape, 4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
    return transform


def from_quaternion_translation(quaternion_xyzw: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The (..., 4, 4) transform of (..., 4) quaternions (x, y, z, w; normalized here) and (..., 3) translations.

    quaternion_xyzw: (..., 4) float64; translation: (..., 3) float64, m
    """
    quaternion_xyzw = np.asarray(quaternion_xyzw, float)
    rotation = Rotation.from_quat(quaternion_xyzw.reshape(-1, 4)).as_matrix()
    return from_rotation_translation(rotation.reshape(*quaternion_xyzw.shape[:-1], 3, 3), translation)


def quaternion(transform: Transforms) -> np.ndarray:
    """The (..., 4) unit quaternions (x, y, z, w; w >= 0) of (..., 4, 4) transforms."""
    rotation = transform[..., :3, :3]
    quaternion_xyzw = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(quaternion_xyzw).reshape(*rotation.shape[:-2], 4)


def inverse(a_from_b: Transforms) -> np.ndarray:
    """`b_from_a`, (..., 4, 4)."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    translation = -(rotation_t @ a_from_b[..., :3, 3:])[..., 0]
    return from_rotation_translation(rotation_t, translation)


def steps(world_from_sensor: Poses) -> np.ndarray:
    """(N - 1, 4, 4), from each of the poses (N, 4, 4) to the next, in the frame of the earlier."""
    return np.asarray(inverse(world_from_sensor[:-1]) @ world_from_sensor[1:])


def transform_points(a_from_b: Pose, points_b: np.ndarray) -> np.ndarray:
    """`points_a`, (N, 3) float64, of one (4, 4) transform and (N, 3) points.

    points_b: (N, 3) float32 or float64, m
    """
    return np.asarray(points_b, float) @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def finite(points: np.ndarray) -> np.ndarray:
    """Those of points without NaN or infinity; the array itself where all are.

    points: (N, 3) float32 or float64, m
    """
    known = np.isfinite(points)
    # nearly always all are, and to see that takes a fortieth of the time to see which
    return points if known.all() else points[known.all(axis=1)]


def hat(vector: np.ndarray) -> np.ndarray:
    """The (..., 3, 3) cross-product matrices of (..., 3) vectors: `hat(a) @ b = a x b`.

    vector: (..., 3) float64
    """
    vector = np.asarray(vector, float)
    matrix = np.zeros((*vector.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def _series(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sin(a)/a, (1-cos(a))/a^2, (a-sin(a))/a^3, safe at zero; each with two trailing unit axes."""
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    first = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24, 2 * np.sin(safe / 2) ** 2 / safe**2)
    third = np.where(angle < 1e-2, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)
    return first[..., None, None], second[..., None, None], third[..., None, None]


def exp(delta: Tangents) -> np.ndarray:
    """The (..., 4, 4) transforms of (..., 6) tangent vectors `[rotation | translation]`."""
    delta = np.asarray(delta, float)
    phi, rho = delta[..., :3], delta[..., 3:]
    first, second, third = _series(np.linalg.norm(phi, axis=-1))
    skew = hat(phi)
    square = skew @ skew
    rotation = np.eye(3) + first * skew + second * square
    left_jacobian = np.eye(3) + second * skew + third * square
    return from_rotation_translation(rotation, (left_jacobian @ rho[..., None])[..., 0])


def moved_along(points: np.ndarray, amounts: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """(N, 3) float64: `exp(amount * tangent)` of each point, without a transform for each of them.

    points: (N, 3) float32 or float64, m; amounts: (N,) float64, of 1
    tangent: (6,) float64 `[rotation | translation]`, rad and m
    """
    here, amount = np.asarray(points, float), np.asarray(amounts, float)[:, None]
    phi, rho = np.asarray(tangent, float)[:3], np.asarray(tangent, float)[3:]
    first, second, third = (each[..., 0] for each in _series(np.abs(amount[:, 0]) * np.linalg.norm(phi)))
    # row vectors: `v @ across` is phi x v
    across = -hat(phi)
    turned = here @ across
    there = here + amount * (first * turned + rho)
    turned, shifted = turned @ across, rho @ across
    there += amount**2 * (second * (turned + shifted))
    there += amount**3 * (third * (shifted @ across))
    return np.asarray(there)


def log(transform: Transforms) -> np.ndarray:
    """The (..., 6) tangent vectors `[rotation | translation]` of (..., 4, 4) transforms; rotation below pi."""
    transform = np.asarray(transform, float)
    phi = _rotation_vector(transform[..., :3, :3])
    _, second, third = _series(np.linalg.norm(phi, axis=-1))
    skew = hat(phi)
    left_jacobian = np.eye(3) + second * skew + third * (skew @ skew)
    rho = np.linalg.solve(left_jacobian, transform[..., :3, 3:])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """(..., 3) float64, rad, of rotation matrices (..., 3, 3)."""
    # R - R^T is twice the sine of the angle, times the axis
    turned = rotation - np.swapaxes(rotation, -1, -2)
    axis = np.stack([turned[..., 2, 1], turned[..., 0, 2], turned[..., 1, 0]], axis=-1)
    sine = 0.5 * np.linalg.norm(axis, axis=-1)
    cosine = 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1)
    angle = np.arctan2(sine, cosine)
    small = sine < _SMALL_ANGLE
    factor = np.where(small, 0.5 + sine**2 / 12, 0.5 * angle / np.where(small, 1.0, sine))
    vector = np.asarray(factor[..., None] * axis)
    half_a_turn = cosine < _HALF_A_TURN
    if half_a_turn.any():
        # the sine vanishes there, too
        vector[half_a_turn] = Rotation.from_matrix(rotation[half_a_turn]).as_rotvec()
    return vector


def inverse_right_jacobian(rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3): how `log(exp(r) exp(d))` changes with d at 0. Source: Sola et al. 2018, eq. 144.

    rotation: (..., 3) float64, rotation vectors r, rad
    """
    angle = np.linalg.norm(rotation, axis=-1)[..., None, None]
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    factor = np.where(
        small, 1 / 12 + angle**2 / 720, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe))
    )
    skew = hat(rotation)
    return np.asarray(np.eye(3) + 0.5 * skew + factor * (skew @ skew))


def retract(a_from_b: Transforms, delta: Tangents) -> np.ndarray:
    """`a_from_b @ exp(delta)`, (..., 4, 4), with the rotation part made orthonormal again.

    What does not move stays as it is, to the last bit.
    """
    delta = np.asarray(delta, float)
    still = np.all(delta == 0, axis=-1)[..., None, None]
    moved = np.asarray(a_from_b @ exp(delta))
    rotation = moved[..., :3, :3]
    # one step of Newton's method towards the nearest rotation, which is next to it
    moved[..., :3, :3] = rotation @ (1.5 * np.eye(3) - 0.5 * (np.swapaxes(rotation, -1, -2) @ rotation))
    return np.where(still, a_from_b, moved)


def turn_tangent(blocks: np.ndarray, rotation: Rotations) -> np.ndarray:
    """(..., 6, 6) covariances, information or projectors of `[rotation | translation]`, in turned axes: T blocks T^T.

    rotation: (..., 3, 3), new axes from old ones; both parts are turned by it
    blocks: (..., 6, 6) float64, rad and m, squared, or their inverse
    """
    turn = np.zeros((*rotation.shape[:-2], 6, 6))
    turn[..., :3, :3] = turn[..., 3:, 3:] = rotation
    return np.asarray(turn @ blocks @ np.swapaxes(turn, -1, -2))


def orthonormalize(transform: Transforms) -> np.ndarray:
    """The nearest (..., 4, 4) rigid transforms: rotation parts projected on SO(3)."""
    return from_quaternion_translation(quaternion(transform), transform[..., :3, 3])


def closest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that turns vectors b as near as can be to vectors a.

    Source: Umeyama 1991. Of a matrix that is nearly a rotation, the nearest one.
    matrix: (3, 3) float64, the sum of a b^T
    """
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def adjoint(a_from_b: Transforms) -> np.ndarray:
    """(..., 6, 6) such that `a_from_b @ exp(d) = exp(adjoint(a_from_b) @ d) @ a_from_b`."""
    rotation = a_from_b[..., :3, :3]
    matrix = np.zeros((*a_from_b.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., 3:, :3] = hat(a_from_b[..., :3, 3]) @ rotation
    return matrix


def interpolate(first: Transforms, second: Transforms, fraction: np.ndarray) -> np.ndarray:
    """On the screw motion from `first` (fraction 0) to `second` (fraction 1), (..., 4, 4); extrapolates beyond.

    fraction: (...) float64, one for each transform
    """
    fraction = np.asarray(fraction, float)[..., None]
    return retract(first, fraction * log(inverse(first) @ second))


def rotation_angle_deg(transform: Transforms) -> np.ndarray:
    """The rotation angles of (..., 4, 4) transforms, (...), degrees."""
    rotation = transform[..., :3, :3].reshape(-1, 3, 3)
    angle = Rotation.from_matrix(rotation).magnitude()
    return np.asarray(np.degrees(angle).reshape(transform.shape[:-2]))
