"""Settings of LiDAR bundle adjustment."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from lvba.lidar.voxel_map import BALM2_TEST, PlaneTest
from lvba.lidar.weights import WeightConfig


@dataclass(frozen=True)
class StageConfig:
    """One setting of the voxel map, used until the poses stand still."""

    sizes: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """m, edges of the cells, finest first, each twice the one before; 0.05 to 32."""
    plane_test: PlaneTest = field(default_factory=PlaneTest)
    """What counts as a plane."""
    rounds: int = 8
    """Most associations; 1 to 100."""
    settled: float = 1e-4
    """m: the poses stand still when none moves further than this in a round; 0 to 1."""
    least_gain: float = 0.01
    """They stand still, too, when a round changes the squared errors over their variances by less than this for each
    degree of freedom of the poses: at 0.01 poses move by a tenth of their standard deviations; 0 to 1."""
    steps: int = 1
    """Most steps on the planes of one association; 1 to 50."""
    exact: bool = False
    """Exact second derivatives instead of Gauss-Newton: fewer steps on fixed planes, but indefinite far from the
    solution, where Gauss-Newton takes over."""
    systematic: float = 0.1
    """Largest disagreement of a scan with a plane that is taken for an error of the surface, and lowers the weight of
    observations of many points, in standard deviations of a point; 0 to 10. Large while poses are rough."""
    hold: bool = True
    """Keep weak directions at the odometry."""

    def __post_init__(self) -> None:
        sizes = self.sizes
        doubled = all(abs(b - 2 * a) < 1e-9 for a, b in pairwise(sizes))
        if not sizes or not doubled or not 0.05 <= sizes[0] <= sizes[-1] <= 32.0:
            raise ValueError(f"lidar stage sizes = {sizes}; allowed: 0.05 to 32 m, each twice the one before")
        for name, low, high in (
            ("rounds", 1, 100),
            ("settled", 0.0, 1.0),
            ("least_gain", 0.0, 1.0),
            ("steps", 1, 50),
            ("systematic", 0.0, 10.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"lidar stage {name} = {getattr(self, name)}; allowed: {low} to {high}")


_COARSE = StageConfig(
    sizes=(0.5, 1.0, 2.0),
    plane_test=PlaneTest(ratio=0.15, finest_ratio=0.15, excess=np.inf),
    rounds=5,
    settled=0.01,
    systematic=1.0,
)
_MIDDLE = StageConfig(
    sizes=(0.25, 0.5, 1.0),
    plane_test=PlaneTest(ratio=0.08, finest_ratio=0.1, excess=0.5),
    rounds=4,
    settled=0.002,
    systematic=0.3,
)


@dataclass(frozen=True)
class LidarConfig:
    """How scan poses are refined."""

    stages: tuple[StageConfig, ...] = (_COARSE, _MIDDLE, StageConfig())
    """Coarse cells first: they join what the rough poses left apart; fine ones then see which planes are none."""
    weights: WeightConfig = field(default_factory=WeightConfig)
    """How observations that do not fit are held back."""
    prior_translation: float = 0.05
    """m, standard deviation of the rough motion from scan to scan; 0.001 to 10. Matters only where planes say nothing."""
    prior_rotation: float = 0.01
    """rad, the same for its rotation; 1e-4 to 1."""
    oblique_grid: bool = True
    """Turn the grid out of the axes of the world. Walls are often parallel to those, and then lie on faces of cells:
    noise throws their points to both sides, and two copies of a wall never meet in one cell."""

    dense_points: int = 64
    """Every stage gets cells of half the size, and half again, as long as these hold this many points of a single scan:
    depth cameras and dense scans at close range; 4 to 10000, 0 never."""

    def __post_init__(self) -> None:
        if self.dense_points != 0 and not 4 <= self.dense_points <= 10_000:
            raise ValueError(f"lidar.dense_points = {self.dense_points}; allowed: 4 to 10000, or 0 for never")
        for name, low, high in (("prior_translation", 0.001, 10.0), ("prior_rotation", 1e-4, 1.0)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"lidar.{name} = {getattr(self, name)}; allowed: {low} to {high}")
        if not self.stages:
            raise ValueError("lidar.stages is empty; at least one is needed")

    @property
    def prior_sigmas(self) -> np.ndarray:
        """(6,), rad and m, of the odometry from scan to scan."""
        return np.array([self.prior_rotation] * 3 + [self.prior_translation] * 3)


def balm2(root: float = 2.0) -> LidarConfig:
    """The method as the public BALM2 runs it, for comparison: one association, three levels, no weights.

    root: m, edge of the coarsest cells.
    """
    stage = StageConfig(
        sizes=(root / 4, root / 2, root),
        plane_test=BALM2_TEST,
        rounds=1,
        steps=10,
        exact=True,
        systematic=0.0,
        hold=False,
    )
    return LidarConfig(
        stages=(stage,),
        weights=WeightConfig(passes=0),
        prior_translation=10.0,
        prior_rotation=1.0,
        oblique_grid=False,
        dense_points=0,
    )
