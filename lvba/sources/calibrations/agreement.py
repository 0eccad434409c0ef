"""Whether two files say the same: printed with other digits, or measured at another time."""

import dataclasses

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera

SAME_DEG, SAME_M = 0.1, 1e-3
"""Within this, two transforms are the same one, printed with few digits."""
CONSISTENT_DEG, CONSISTENT_M = 0.5, 0.01
"""Within this, three transforms of a triangle close: they were calibrated one by one."""
SAME_TIME_S = 1e-3


def same_transform(first: Pose, second: Pose, degrees: float = SAME_DEG, length_m: float = SAME_M) -> bool:
    """Whether two transforms between the same frames differ by no more than this, rotation and translation."""
    angle, length = difference(first, second)
    return angle <= degrees and length <= length_m


def difference(first: Pose, second: Pose) -> tuple[float, float]:
    """Degrees and meters between two transforms of the same frames."""
    off = geometry.inverse(first) @ second
    return float(geometry.rotation_angle_deg(off[None])[0]), float(np.linalg.norm(off[:3, 3]))


def same_camera(first: Camera, second: Camera) -> bool:
    """Whether two cameras are the same to 6 digits; a size that one file does not say is no difference."""
    if first.lens is not second.lens or (first.width and second.width and _size(first) != _size(second)):
        return False
    return bool(np.allclose(_values(first), _values(second), rtol=1e-6, atol=1e-9))


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _values(camera: Camera) -> np.ndarray:
    padded = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *padded])


def with_size(camera: Camera, other: Camera) -> Camera:
    """The camera, with the size of the other if it has none."""
    return camera if camera.width else dataclasses.replace(camera, width=other.width, height=other.height)
