"""LiDAR bundle adjustment as the public BALM2 runs it: one association, three levels, no weights."""

import numpy as np

from lvba.lidar.config import LidarConfig, Stage
from lvba.lidar.voxel_map import PlaneTest

PLANE_TEST = PlaneTest(max_residual_growth=np.inf, spread=0.0, max_tilt=np.inf, two_sided=False)
"""Coarse planes are trusted, and both sides of a wall are one plane."""
CONFIG = LidarConfig(prior_translation=10.0, prior_rotation=1.0, dense_points=0)
"""No prior to speak of, and no finer cells."""


def stage(root: float = 2.0) -> Stage:
    """Its one stage; root: m, edge of the coarsest cells."""
    return Stage(
        sizes=(root / 4, root / 2, root),
        plane_test=PLANE_TEST,
        rounds=1,
        steps=10,
        exact=True,
        project_degenerate=False,
        oblique_grid=False,
        weight_passes=0,
    )
