"""Against what the public BALM2 computed on its own recording.

It worked with matrices of six decimals (see `oracle_poses`): R = Q (1 + E), Q a rotation, E symmetric, up to 1e-6. Here E
goes into the clusters, scan by scan, which is the same problem; poses are rotations throughout. On the pose files as they
are, gradient and poses would agree to 2e-4 and 0.025 mm only, however exact both programs are.
"""

import os
from pathlib import Path

import numpy as np
import oracle_poses
import pytest

from lvba import geometry
from lvba.lidar import plane_factor, plane_feature
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.problem import Problem, solve

FOLDER = (
    Path(os.environ.get("LVBA_DATA", Path(__file__).parents[3] / "shared" / "data"))
    / "balm_realworld"
    / "oracle"
)
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no recordings at {FOLDER}"),
]


class Oracle:
    """What the oracle started from: features with its scans' E, and the rotations without."""

    def __init__(self):
        self.data = np.load(FOLDER / "clusters.npz")
        self.table = np.loadtxt(FOLDER / "poses_initial.txt")
        self.matrices = oracle_poses.recover(self.table)
        left, _, right = np.linalg.svd(self.matrices[:, :3, :3])
        self.start = self.matrices.copy()
        self.start[:, :3, :3] = left @ right
        self.stretch = geometry.inverse(self.start) @ self.matrices
        self.stretch[:, :3, 3] = 0.0
        self.features = clusters_of(self.data, self.stretch)


def clusters_of(data, stretch):
    count, total = data["count"], data["sum"]
    mean = total / count[:, None]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    scatter = np.stack([data["outer"][:, k] - total[:, i] * mean[:, j] for k, (i, j) in enumerate(pairs)], 1)
    offsets = np.searchsorted(data["plane"], np.arange(data["plane"].max() + 2)).astype(np.int64)
    scan = data["scan"].astype(np.int32)
    clusters = PointClusters(count, mean, scatter).moved(stretch, scan)
    return PlaneFeatures(offsets, scan, clusters, np.ones(len(count)), np.ones(len(offsets) - 1))


@pytest.fixture(scope="module")
def oracle():
    return Oracle()


def test_the_oracles_matrices_are_known(oracle):
    # to all digits that the files have, and no other choice of first pose and grid would do that 177 times
    assert np.abs(oracle.matrices[:, :3, 3] - oracle.table[:, 1:4]).max() <= 0.501e-9
    for matrix, row in zip(oracle.matrices, oracle.table, strict=True):
        read = oracle_poses.quaternions(matrix[None, :3, :3], row[4:8])
        assert np.abs(read - row[4:8]).max() <= 0.501e-12


def test_cost_and_gradient(oracle):
    equations = plane_factor.linearize(oracle.features, oracle.start, 1.0)
    assert 2 * equations.cost == pytest.approx(float(oracle.data["cost_initial"]), rel=1e-9)
    local = equations.gradient.reshape(-1, 2, 3)
    gradient = 2 * np.einsum("nij,nkj->nki", oracle.start[:, :3, :3], local).reshape(-1, 6)
    gradient[:, :3] += np.cross(oracle.start[:, :3, 3], gradient[:, 3:])  # about the origin, as theirs
    wanted = oracle.data["gradient_left"].reshape(-1, 6)
    assert np.linalg.norm(gradient - wanted) < 1e-9 * np.linalg.norm(wanted)
    assert np.abs(gradient - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_final_cost_and_poses(oracle):
    problem = Problem(oracle.features, 1.0, None)
    found = solve(problem, oracle.start, np.ones(6), steps=10, exact=True, tolerance=1e-12)
    assert 2 * found.cost_after == pytest.approx(24603.921, rel=1e-8)
    # the oracle takes its first pose out of the result by the transpose again, E of the first scan included
    ours = oracle.stretch[0] @ found.world_from_scan @ oracle.stretch
    theirs = np.loadtxt(FOLDER / "poses_balm2.txt")
    assert np.linalg.norm(ours[:, :3, 3] - theirs[:, 1:4], axis=1).max() < 1e-5
    for pose, row in zip(ours, theirs, strict=True):
        assert np.abs(oracle_poses.quaternions(pose[None, :3, :3], row[4:8]) - row[4:8]).max() < 1e-6
    # and from where BALM2 stopped there is next to nothing left to gain
    end = geometry.from_quaternion_translation(theirs[:, 4:8], theirs[:, 1:4])
    left = plane_feature.fit(oracle.features, end).cost - 2 * found.cost_after
    assert 0 <= left < 2e-7 * found.cost_after
