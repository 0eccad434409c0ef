"""Names for the arrays that many functions take: shape, dtype and unit said once; the argument says the frame.

N, S and I count rows, scans and images. A transform named `a_from_b` takes coordinates of frame b to those of frame a;
what is named `_world` is in the world frame.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]
"""(4, 4) float64: a rigid transform, m."""
Poses = NDArray[np.float64]
"""(N, 4, 4) float64: rigid transforms, m."""
Transforms = NDArray[np.float64]
"""(..., 4, 4) float64: rigid transforms of any leading shape, m."""
Rotations = NDArray[np.float64]
"""(..., 3, 3) float64: rotation matrices of any leading shape."""
Tangents = NDArray[np.float64]
"""(..., 6) float64: `[rotation | translation]` in the tangent of `lvba.geometry`, rad and m."""
StepSigmas = NDArray[np.float64]
"""(6,) float64: standard deviations of `[rotation | translation]`, rad and m."""
PoseBlocks = NDArray[np.float64]
"""(N, 6, 6) float64: covariances of poses in the tangent of `lvba.geometry` (rad and m, squared), or information, their
inverse."""
Times = NDArray[np.float64]
"""(N,) float64: s."""
Vector = NDArray[np.float64]
"""(3,) float64: a position, m, or a unit vector."""
Vectors = NDArray[np.float64]
"""(N, 3) float64: positions, m, or unit vectors."""
CloudPoints = NDArray[np.float32]
"""(N, 3) float32: measured points, m."""
Images = NDArray[np.uint8]
"""(I, H, W, C) uint8: gray values or RGB of I images, rows from the top."""
Picture = NDArray[np.uint8]
"""(H, W, 3) uint8: RGB of one image, rows from the top."""
LogExposures = NDArray[np.float64]
"""(I,) float64: natural logarithms of relative exposure times."""
Indices = NDArray[np.integer[Any]]
"""(N,) integers: rows of another array."""
