"""How much brighter or darker nearer views of a surface seem, alike in all images of a camera.

A pixel of a nearer view covers less of a surface, and sees more of its contrast. Means of the light do not depend on
that, means of a curve of it do: where grey values are a power of the light, as most cameras store them, nearer views of
anything are a little darker. Along a path that looks ahead all ratios err to the same side, and add up. The power itself
is told by no ratio (see `response`), but nearer and farther patches of the same pair of images tell of this.
"""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Vector

PRIOR_SIGMA = 0.003
"""Standard deviation about zero of the log ratio where a view is nearer by a factor of e. Grey values to a power of
1 / 2.2: 0.0015 on a simulated street. Where all patches of a pair come nearer alike, nothing but this tells of it."""
SIGNIFICANCE = 6.0
"""Standard deviations by which it must differ from zero, as a response must."""
FLOOR = 0.0005
"""How far an estimate is off that patches have no reason for: along a street of 4 km that a linear camera sees, slices of
600 m had -0.0002 to -0.001 where exposures were best with -0.0001, and were sure of it to 0.0002."""
SMALLEST = 2 * FLOOR
"""Least that counts."""
LARGEST = 0.01
"""What is more is no matter of contrast: where patches of a pair hardly differ in how near they come, anything."""


@dataclass(frozen=True)
class Nearness:
    """value: log ratio of brightness of a view over one farther by a factor of e; 0: none was found
    sigma: its standard deviation; inf: nothing was measured
    """

    value: float = 0.0
    sigma: float = float("inf")

    def __bool__(self) -> bool:
        return bool(self.value)


NONE = Nearness()


def judged(value: float, sigma: float) -> Nearness:
    """Of an estimate; none where it is not significant, or nearer views are brighter: no camera's grey values bend so."""
    significant = max(SIGNIFICANCE * sigma, SMALLEST) < -value < LARGEST
    return Nearness(value if significant else 0.0, sigma)


def log_nearer(reference_m: Vector, target_m: Vector) -> np.ndarray:
    """(N,) float64: log of how many times nearer targets are. reference_m, target_m: (N,) float64, distances in m"""
    return np.log(np.maximum(reference_m, 1e-6) / np.maximum(target_m, 1e-6))
