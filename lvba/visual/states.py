"""The unknowns of the visual bundle adjustment."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CameraStates:
    """One pose and one relative exposure time per image.

    world_from_camera: (I, 4, 4) float64
    log_exposure: (I,) float64, natural log of tau_i / tau_0
    """

    world_from_camera: np.ndarray
    log_exposure: np.ndarray

    def __len__(self) -> int:
        return len(self.log_exposure)


@dataclass(frozen=True)
class Mount:
    """How the camera sits on the LiDAR, in space and time; shared by all images.

    scan_from_camera: (4, 4) float64
    time_offset: s; an image stamped t was taken at t + time_offset on the LiDAR's clock
    """

    scan_from_camera: np.ndarray
    time_offset: float = 0.0


@dataclass(frozen=True)
class VisualState:
    """Everything the visual bundle adjustment solves for."""

    cameras: CameraStates
    mount: Mount
