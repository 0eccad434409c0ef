"""The unknowns of the visual bundle adjustment."""

from dataclasses import dataclass, field

import numpy as np

from lvba.arrays import Times
from lvba.optim.shared_parameters import Pose, Scalar, SharedParameters, Vector, parameter


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
class Calibration(SharedParameters):
    """What all images share: how the camera sits on the LiDAR, in space and time, and what is wrong of its intrinsics.

    scan_from_camera: (4, 4) float64
    time_offset: s; an image stamped t was taken at t + time_offset on the LiDAR's clock
    focal: (2,) float64, by what part both focal lengths are longer than calibrated, and by what part fy is beyond that
    principal_point: (2,) float64, px of the raw image, by how much cx and cy are larger
    distortion: (4,) float64, by how much the first four coefficients of the lens are larger
    readout: s, from the first to the last row of an image
    clock_rate: s a second by which the camera's clock loses on the LiDAR's: an image stamped t was taken at
        t + time_offset + clock_rate (t - epoch) there (`moments`)
    """

    scan_from_camera: np.ndarray = field(metadata=parameter(Pose()))
    time_offset: float = field(default=0.0, metadata=parameter(Scalar("s")))
    focal: np.ndarray = field(default_factory=lambda: np.zeros(2), metadata=parameter(Vector(2, "")))
    principal_point: np.ndarray = field(
        default_factory=lambda: np.zeros(2), metadata=parameter(Vector(2, "px"))
    )
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(4), metadata=parameter(Vector(4, "")))
    readout: float = field(default=0.0, metadata=parameter(Scalar("s")))
    clock_rate: float = field(default=0.0, metadata=parameter(Scalar("")))

    def moments(self, times: Times, epoch: float) -> Times:
        """(I,) s on the LiDAR's clock, at which images with these stamps (I,) were taken; epoch: s, a stamp."""
        return np.asarray(times + self.lateness(times - epoch))

    def lateness(self, since: Times) -> np.ndarray:
        """(I,) s, by which images were taken after their stamps, so many s (I,) after the epoch."""
        return np.asarray(self.time_offset + self.clock_rate * since)


@dataclass(frozen=True)
class VisualState:
    """Everything the visual bundle adjustment solves for.

    motion: (I, 6) float64 `[rotation | translation]`, rad/s and m/s, in the axes of each camera: by how much it moves
        otherwise than the trajectory says while its rows are read; None: not at all
    """

    cameras: CameraStates
    calibration: Calibration
    motion: np.ndarray | None = None
