"""The camera: a pinhole behind a lens (`lvba.lens`), and its image pyramid.

Pixels are (column, row); the centre of the first pixel is (0, 0). Camera axes: x right, y down, z forward.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from lvba.lens import Lens


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; `distortion` holds the coefficients of the lens."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    lens: Lens = Lens.RADIAL_TANGENTIAL

    @property
    def is_pinhole(self) -> bool:
        """Whether its images have no distortion."""
        return self.lens is Lens.RADIAL_TANGENTIAL and not any(self.distortion)

    @property
    def matrix(self) -> np.ndarray:
        """K, (3, 3) float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def half_angle(self) -> float:
        """rad, off the axis, of the farthest corner of the image, distortion aside."""
        corners = [(x, y) for x in (-0.5, self.width - 0.5) for y in (-0.5, self.height - 0.5)]
        farthest = float(np.hypot(*self.normalized(np.array(corners))).max())
        return farthest if self.lens is Lens.EQUIDISTANT else math.atan(farthest)

    def normalized(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (N,) right and (N,) down behind the lens, of what a pinhole of this K sees at pixels.

        pixels: (N, 2) float64, px
        """
        return (pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy

    def undistorted(self) -> "Camera":
        """The pinhole camera whose images `lvba.visual.image.undistort` makes: same K and size, no distortion."""
        return Camera(width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy)

    def scaled(self, factor: float) -> "Camera":
        """For images resized by `factor` (0.5: half the width): pixel centres map as c' = (c + 0.5) * factor - 0.5."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def at_level(self, level: int) -> "Camera":
        """The camera of pyramid level `level` (0: full size; each level halves, odd sizes rounded down)."""
        camera = self
        for _ in range(level):
            camera = replace(camera.scaled(0.5), width=camera.width // 2, height=camera.height // 2)
        return camera
