"""The pinhole camera with radial-tangential distortion (k1 k2 p1 p2) and its image pyramid.

Pixels are (column, row); the centre of the first pixel is (0, 0). Camera axes: x right, y down, z forward.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels. `distortion` holds k1, k2, p1, p2; all zero for an undistorted image."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> np.ndarray:
        """K, (3, 3) float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def undistorted(self) -> "Camera":
        """The pinhole camera whose images `lvba.visual.image.undistort` makes: same K and size, no distortion."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def scaled(self, factor: float) -> "Camera":
        """For images resized by `factor` (0.5: half the width): pixel centres map as c' = (c + 0.5) * factor - 0.5."""
        return Camera(
            round(self.width * factor),
            round(self.height * factor),
            self.fx * factor,
            self.fy * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
            self.distortion,
        )

    def at_level(self, level: int) -> "Camera":
        """The camera of pyramid level `level` (0: full size; each level halves, odd sizes rounded down)."""
        camera = self
        for _ in range(level):
            half = camera.scaled(0.5)
            camera = Camera(
                camera.width // 2, camera.height // 2, half.fx, half.fy, half.cx, half.cy, self.distortion
            )
        return camera
