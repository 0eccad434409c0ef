"""LiDAR and visual terms of one scene in one system: they add up with their own weights, in one tangent."""

import numpy as np
import pytest
import scipy.linalg
import textured_planes

from lvba import geometry
from lvba.camera import Camera
from lvba.lidar import plane_factor, plane_feature
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.optim import linear_solver
from lvba.optim.levenberg_marquardt import SolverConfig, levenberg_marquardt
from lvba.visual import photometric
from lvba.visual.photometric import PhotometricState
from lvba.visual.states import CameraStates

CAMERA = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)
SCAN_FROM_CAMERA = geometry.exp(np.array([0.4, -0.3, 0.8, 0.05, -0.2, 0.1]))
COUNT, SIGMA = 5, 0.01


def clusters(world, poses, rng):
    """What scans at these poses (S, 4, 4) hold of the planes of a world."""
    wide = Camera(320, 240, 60.0, 60.0, 159.5, 119.5)
    rows = []
    for scan, pose in enumerate(poses):
        plane, points = textured_planes.cast(
            world, pose, wide, rng.uniform(0, 320, 3000), rng.uniform(0, 240, 3000)
        )
        points = geometry.transform_points(
            geometry.inverse(pose), points + SIGMA * rng.normal(size=points.shape)
        )
        for k in np.unique(plane):
            mine = points[plane == k]
            off = mine - mine.mean(0)
            scatter = (off.T @ off)[np.triu_indices(3)]
            rows.append((k, scan, len(mine), mine.mean(0), scatter))
    rows.sort(key=lambda row: row[:2])
    plane, scan, count = (np.array([row[n] for row in rows]) for n in range(3))
    offsets = np.searchsorted(plane, np.append(np.unique(plane), plane.max() + 1)).astype(np.int64)
    found = PointClusters(count.astype(float), np.stack([r[3] for r in rows]), np.stack([r[4] for r in rows]))
    return PlaneFeatures(offsets, scan.astype(np.int32), found, np.ones(len(rows)), np.ones(len(offsets) - 1))


class Scene:
    """Images and scans of one room by a rig that moves as one; unknown: poses and log exposures of the cameras."""

    def __init__(self):
        world, self.truth = textured_planes.room(), textured_planes.walk(COUNT)
        images = textured_planes.render(world, self.truth, CAMERA, np.ones(COUNT), noise=2.0, supersample=1)
        points, observations = textured_planes.scene_points(world, self.truth, CAMERA, step=14)
        self.problem = photometric.prepare(
            images, CAMERA, points, observations, 7, sigma=4.0, variance_factor=5.0
        )
        scans = self.truth @ geometry.inverse(SCAN_FROM_CAMERA)
        self.features = clusters(world, scans, np.random.default_rng(1))
        self.free = np.ones((COUNT, 7), bool)
        self.free[0] = False

    def visual(self, cameras):
        state = PhotometricState(cameras, np.zeros(len(self.problem.points)))
        return photometric.linearize(self.problem, state).equations

    def lidar(self, cameras):
        scans = cameras.world_from_camera @ geometry.inverse(SCAN_FROM_CAMERA)
        by_camera = np.zeros((COUNT, 6, 7))
        by_camera[:, :, :6] = geometry.adjoint(SCAN_FROM_CAMERA)
        return plane_factor.linearize(self.features, scans, SIGMA, exact=False).projected(by_camera)

    def lidar_cost(self, cameras):
        scans = cameras.world_from_camera @ geometry.inverse(SCAN_FROM_CAMERA)
        return 0.5 * plane_feature.fit(self.features, scans).cost / SIGMA**2

    def joint(self, cameras):
        return self.visual(cameras) + self.lidar(cameras)


def moved(cameras, step):
    return photometric.moved(cameras, step.blocks)


@pytest.fixture(scope="module")
def scene():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photometric, "HUBER", 100.0)
        yield Scene()


@pytest.fixture(scope="module")
def start(scene):
    return CameraStates(textured_planes.disturbed(scene.truth, 0.004, 0.1), np.zeros(COUNT))


@pytest.fixture(scope="module")
def solved(scene, start):
    config = SolverConfig(max_iterations=60, relative_decrease=1e-12, step_tolerance=1e-10, refusals=20)
    return levenberg_marquardt(start, scene.joint, moved, config, scene.free).state


def test_the_sum_is_the_sum_of_both_quadratic_models(scene, start):
    visual, lidar, both = scene.visual(start), scene.lidar(start), scene.joint(start)
    step = np.random.default_rng(2).normal(size=(COUNT, 7)) * 0.01

    def model(equations):
        flat = step.ravel()
        return equations.cost + np.sum(equations.gradient * step) + 0.5 * flat @ equations.dense() @ flat

    assert model(both) == pytest.approx(model(visual) + model(lidar), rel=1e-12)


def test_a_lidar_term_has_its_slope_along_the_steps_of_cameras(scene, start):
    equations = scene.lidar(start)
    rng = np.random.default_rng(3)
    for _ in range(3):
        direction = rng.normal(size=(COUNT, 7))
        costs = [scene.lidar_cost(photometric.moved(start, sign * 1e-6 * direction)) for sign in (1.0, -1.0)]
        slope = (costs[0] - costs[1]) / 2e-6
        assert np.sum(equations.gradient * direction) == pytest.approx(slope, rel=1e-5)


def test_where_the_sum_is_least_its_terms_pull_against_each_other(scene, solved):
    visual, lidar = scene.visual(solved), scene.lidar(solved)
    both = visual + lidar
    inverse = np.linalg.inv(both.dense()[7:, 7:])

    def decrement(gradient):
        return float(gradient[1:].ravel() @ inverse @ gradient[1:].ravel())

    assert decrement(both.gradient) < 1e-3 * decrement(lidar.gradient)
    assert decrement(lidar.gradient) == pytest.approx(decrement(visual.gradient), rel=0.1)
    assert decrement(lidar.gradient) > 0.1, "or they do not disagree"


def test_together_they_know_more_than_each_alone(scene, solved):
    poses = scene.free.copy()
    poses[:, 6] = False
    found = [
        linear_solver.covariance(equations, scene.free if visual else poses).blocks[1:, :6, :6]
        for equations, visual in ((scene.visual(solved), True), (scene.lidar(solved), False))
    ]
    together = linear_solver.covariance(scene.joint(solved), scene.free).blocks[1:, :6, :6]
    for alone in found:
        for a, b in zip(together, alone, strict=True):
            # in units of what one alone leaves open
            values = scipy.linalg.eigh(a, b, eigvals_only=True)
            assert values[-1] < 1.0 + 1e-6
            assert values[0] < 0.999
