"""Against what the public BALM2 computed on its own recording."""

import os
from pathlib import Path

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import normal_equations, plane_feature
from lvba.lidar.normal_equations import Problem
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.solver import solve

FOLDER = (
    Path(os.environ.get("LVBA_DATA", Path(__file__).parents[3] / "shared" / "data"))
    / "balm_realworld"
    / "oracle"
)
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no recordings at {FOLDER}"),
]


def poses(name):
    table = np.loadtxt(FOLDER / name)
    return geometry.from_quaternion_translation(table[:, 4:8], table[:, 1:4])


@pytest.fixture(scope="module")
def oracle():
    data = np.load(FOLDER / "clusters.npz")
    count, total = data["count"], data["sum"]
    mean = total / count[:, None]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    scatter = np.stack([data["outer"][:, k] - total[:, i] * mean[:, j] for k, (i, j) in enumerate(pairs)], 1)
    offsets = np.searchsorted(data["plane"], np.arange(data["plane"].max() + 2)).astype(np.int64)
    features = PlaneFeatures(
        offsets,
        data["scan"].astype(np.int32),
        PointClusters(count, mean, scatter),
        np.ones(len(count)),
        np.ones(len(offsets) - 1),
    )
    return features, data


def test_cost_and_gradient(oracle):
    """The oracle's poses were matrices of 6 decimals, not quite rotations; the files hold the nearest rotations: its cost
    and gradient are met as far as that allows, its formulas to 1e-9 by tests against differences."""
    features, data = oracle
    equations = normal_equations.linearize_planes(features, poses("poses_initial.txt"), 1.0)
    assert equations.cost == pytest.approx(float(data["cost_initial"]), rel=3e-6)
    gradient = equations.gradient.reshape(-1, 6).copy()
    gradient[:, :3] += np.cross(poses("poses_initial.txt")[:, :3, 3], gradient[:, 3:])
    off = gradient.ravel() - data["gradient_left"]
    assert np.linalg.norm(off) < 3e-4 * np.linalg.norm(data["gradient_left"])


def test_final_cost_and_poses(oracle):
    features, _ = oracle
    start = poses("poses_initial.txt")
    found = solve(Problem(features, 1.0, None), start, np.ones(6), steps=10, exact=True, tolerance=1e-12)
    assert found.cost_after == pytest.approx(24603.921, rel=1e-6)
    assert found.cost_after <= 24603.921
    off = geometry.inverse(poses("poses_balm2.txt")) @ found.world_from_scan
    assert np.abs(off[:, :3, 3]).max() < 3e-5
    assert geometry.rotation_angle_deg(off).max() < 2e-4
    # and from where BALM2 stopped there is next to nothing left to gain
    left = plane_feature.fit(features, poses("poses_balm2.txt")).cost - found.cost_after
    assert 0 <= left < 1e-6 * found.cost_after
