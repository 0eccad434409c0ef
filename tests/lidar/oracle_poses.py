"""The rough poses as the oracle computed with them: matrices that are rotations to six decimals only.

The recording came with a 4x4 matrix a scan, rounded to six decimals. The oracle took the first pose out of all of them,
by the transpose of its rotation part, and continued with what that gave; the pose files hold unit quaternions, nine and
twelve decimals. So `file = (R0' M_i, R0' (P_i - P_0))` with M_i, P_i on a grid of 1e-6, and that tells both: the
translations give R0 (only at the right one do all of them fall on the grid), and each quaternion then has a single matrix
M_i on the grid that rounds to its twelve decimals; the next best is off by a hundred times as much.
"""

from itertools import product

import numpy as np

GRID = 1e-6
FIRST = np.array(
    [[0.999997, 0.001400, 0.001959], [-0.001398, 0.999999, -0.000921], [-0.001960, 0.000919, 0.999998]]
)
"""R0, found by a search of small rotations for one that takes the translations to the grid."""
_NEIGHBORS = np.array(list(product((-1, 0, 1), repeat=9))).reshape(-1, 3, 3)


def recover(table: np.ndarray) -> np.ndarray:
    """The oracle's (S, 4, 4) matrices, from the rows (S, 8) of its file: t x y z qx qy qz qw."""
    grid = np.round(table[:, 1:4] @ np.linalg.inv(FIRST) / GRID) * GRID
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, 3] = grid @ FIRST
    for index, row in enumerate(table):
        poses[index, :3, :3] = _matrix(row[4:8])
    return poses


def _matrix(wanted: np.ndarray) -> np.ndarray:
    """R0' M of the M on the grid whose quaternion comes closest to the wanted one (4,), xyzw."""
    near = np.round(np.linalg.inv(FIRST.T) @ _rotation(wanted) / GRID)
    candidates = FIRST.T @ ((near + _NEIGHBORS) * GRID)
    off = np.abs(quaternions(candidates, wanted) - wanted).max(1)
    return candidates[np.argmin(off)]


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def quaternions(matrices: np.ndarray, like: np.ndarray) -> np.ndarray:
    """(N, 4) xyzw, unit, of the sign of `like`, of matrices that are nearly rotations.

    From the trace where it is positive, else from the largest diagonal entry (Shepperd 1978): on matrices that are
    rotations to 1e-6 the ways to read a quaternion differ by as much.
    """
    m = matrices
    if np.trace(m[0]) > 0:
        parts = [
            m[:, 2, 1] - m[:, 1, 2],
            m[:, 0, 2] - m[:, 2, 0],
            m[:, 1, 0] - m[:, 0, 1],
            1 + np.trace(m, axis1=1, axis2=2),
        ]
    else:
        i = int(np.argmax(np.diag(m[0])))
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = [np.empty(0)] * 4
        parts[i] = 1 + m[:, i, i] - m[:, j, j] - m[:, k, k]
        parts[j], parts[k] = m[:, j, i] + m[:, i, j], m[:, k, i] + m[:, i, k]
        parts[3] = m[:, k, j] - m[:, j, k]
    found = np.stack(parts, axis=1)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found * np.sign(found @ like)[:, None]
