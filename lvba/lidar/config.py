"""Settings of LiDAR bundle adjustment."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from lvba.lidar.voxel_map import PlaneTest
from lvba.lidar.weights import WEIGHT_PASSES
from lvba.settings import Group, setting


@dataclass(frozen=True)
class Stage:
    """One setting of the voxel map, used until the poses stand still."""

    sizes: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """m, edges of the cells, finest first, each twice the one before; 0.05 to 32."""
    plane_test: PlaneTest = field(default_factory=PlaneTest)
    """What counts as a plane."""
    rounds: int = 8
    """Most associations; 1 to 100."""
    pose_tolerance: float = 1e-4
    """m: the poses stand still when none moves further than this in a round; 0 to 1."""
    cost_tolerance: float = 0.01
    """They stand still, too, when a round changes the squared errors over their variances by less than this for each
    degree of freedom of the poses: at 0.01 poses move by a tenth of their standard deviations; 0 to 1."""
    steps: int = 1
    """Most steps on the planes of one association; 1 to 50."""
    exact: bool = False
    """Exact second derivatives instead of Gauss-Newton: fewer steps on fixed planes, but indefinite far from the
    solution, where Gauss-Newton takes over."""
    project_degenerate: bool = True
    """Keep degenerate directions at the odometry."""
    oblique_grid: bool = True
    """Turn the grid out of the axes of the world. Walls are often parallel to those, and then lie on faces of cells:
    noise throws their points to both sides, and two copies of a wall never meet in one cell."""
    mixed_cells: bool = True
    """Where planes leave scans open, look for others in the finest cells that hold several surfaces
    (`lidar.mixed_cells`). While rough poses tear surfaces apart, these are no planes; and where scans are dense enough
    for finer cells, small surfaces have cells of their own."""
    weight_passes: int = WEIGHT_PASSES
    """How often planes and the weights of observations are found in turn; 0 to 10; 0: all points weigh the same."""

    def __post_init__(self) -> None:
        sizes = self.sizes
        doubled = all(abs(b - 2 * a) < 1e-9 for a, b in pairwise(sizes))
        if not sizes or not doubled or not 0.05 <= sizes[0] <= sizes[-1] <= 32.0:
            raise ValueError(f"lidar stage sizes = {sizes}; allowed: 0.05 to 32 m, each twice the one before")
        for name, low, high in (
            ("rounds", 1, 100),
            ("pose_tolerance", 0.0, 1.0),
            ("cost_tolerance", 0.0, 1.0),
            ("steps", 1, 50),
            ("weight_passes", 0, 10),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"lidar stage {name} = {getattr(self, name)}; allowed: {low} to {high}")


_COARSE = Stage(
    sizes=(0.5, 1.0, 2.0),
    plane_test=PlaneTest(ratio=0.15, finest_ratio=0.15, max_residual_growth=np.inf),
    rounds=5,
    pose_tolerance=0.01,
    mixed_cells=False,
)
_MIDDLE = Stage(
    sizes=(0.25, 0.5, 1.0),
    plane_test=PlaneTest(ratio=0.08, finest_ratio=0.1, max_residual_growth=0.5),
    rounds=4,
    pose_tolerance=0.002,
    mixed_cells=False,
)


STAGES = (_COARSE, _MIDDLE, Stage())
"""Coarse cells first: they join what the rough poses left apart; fine ones then see which planes are none."""


@dataclass(frozen=True)
class LidarConfig(Group):
    """LiDAR bundle adjustment: how scan poses are refined."""

    prior_translation: float = setting(
        0.05,
        meaning="Standard deviation of the rough motion from scan to scan. It decides only where planes leave a "
        "scan open.",
        unit="m",
        low=0.001,
        high=10,
        change_when="The odometry is known to be much better or worse, as from wheel encoders or a hand-held camera.",
    )
    prior_rotation: float = setting(
        0.01,
        meaning="The same for its rotation.",
        unit="rad",
        low=1e-4,
        high=1,
        change_when="As `lidar.prior_translation`.",
    )
    dense_points: int = setting(
        64,
        meaning="Every stage gets cells of half the size, and half again, as long as these hold this many points of a "
        "single scan: depth cameras and dense scans at close range. 0: never.",
        unit="points",
        low=4,
        high=10_000,
        also=(0,),
        change_when="Small surfaces of a dense scan are missed (lower), or fine cells cost too much time (higher, or 0).",
        advanced=True,
    )

    rounds: int = setting(
        8,
        meaning="Most associations of points with planes at the finest cells; rounds end when poses stand still.",
        unit="rounds",
        low=1,
        high=100,
        change_when="The report says that scan poses had not converged (more).",
        advanced=True,
    )

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages that a run goes through, before finer cells are added."""
        return (*STAGES[:-1], replace(STAGES[-1], rounds=self.rounds))

    @property
    def prior_sigmas(self) -> np.ndarray:
        """(6,), rad and m, of the odometry from scan to scan."""
        return np.array([self.prior_rotation] * 3 + [self.prior_translation] * 3)
