"""Directions that no plane holds: how many there are, and that the prior alone decides them."""

import numpy as np
import pytest
import textured_planes

from lvba import geometry
from lvba.camera import Camera
from lvba.lidar.plane import Planes
from lvba.visual import calibration_prior, degeneracy, photometric, scene_points
from lvba.visual.photometric import PhotometricState
from lvba.visual.prior_config import PriorConfig
from lvba.visual.scene_points import Observations
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior, Source

CAMERA = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)


def planes_of(world: textured_planes.PlaneWorld) -> Planes:
    """The world's planes as a LiDAR would have found them."""
    count = len(world.points)
    axes = np.stack([world.normals, world.axes[:, 0], world.axes[:, 1]], axis=2)
    return Planes(
        world.points, world.normals, np.tile([1e-4, 0.1, 0.1], (count, 1)), axes, np.full(count, 1000),
        np.full(count, 10, np.int32), np.ones(count), np.full(count, 5e-4), np.zeros(count),
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    world, poses = textured_planes.room(), textured_planes.walk(8)
    images = textured_planes.render(world, poses, CAMERA, np.ones(8), noise=2.0, supersample=1)
    points, observations = textured_planes.scene_points(world, poses, CAMERA, step=10)
    return world, poses, images, points, observations


def found(scene, keep: set[int]) -> degeneracy.DegenerateDirections:
    """The degenerate directions where only some of the planes are used."""
    world, poses, images, points, observations = scene
    mine = np.isin(points.plane[observations.point], list(keep))
    part = Observations(observations.point[mine], observations.target[mine], observations.is_global[mine])
    problem = photometric.prepare(images, CAMERA, points, part, offset_sigma=np.full(len(points), 0.002))
    state = PhotometricState(CameraStates(poses, np.zeros(len(poses))), np.zeros(len(points)))
    return degeneracy.find(problem, photometric.linearize(problem, state), planes_of(world))


def test_a_room_holds_its_cameras(scene):
    assert len(found(scene, {0, 1, 2, 3, 4, 5}).common) == 0


def test_one_plane_leaves_three_directions_along_and_about_it(scene):
    directions = found(scene, {3})
    normal = scene[0].normals[3]
    assert len(directions.common) == 3
    assert directions.common[:, 3:] @ normal == pytest.approx(np.zeros(3), abs=0.05)
    assert directions.count.max() == 3


def test_two_directions_of_walls_leave_one_along_both(scene):
    directions = found(scene, {3, 5})
    assert len(directions.common) == 1
    along = directions.common[0, 3:] / np.linalg.norm(directions.common[0, 3:])
    assert abs(along @ np.cross(scene[0].normals[3], scene[0].normals[5])) > 0.98


@pytest.mark.parametrize("count", [1, 2])
def test_points_in_one_place_leave_all_but_the_motion_along_their_normal(scene, count):
    world, poses, images, points, observations = scene
    first = np.flatnonzero(points.plane == 3)[0]
    seen = observations.point == first
    one = scene_points.take(points, np.full(count, first))
    target = np.tile(observations.target[seen], count)
    pairs = Observations(
        np.repeat(np.arange(count, dtype=np.int32), seen.sum()), target, np.zeros(len(target), bool)
    )
    problem = photometric.prepare(images, CAMERA, one, pairs, offset_sigma=np.full(count, 0.002))
    state = PhotometricState(CameraStates(poses, np.zeros(len(poses))), np.zeros(count))
    directions = degeneracy.find(problem, photometric.linearize(problem, state), planes_of(world))
    assert len(directions.common) == 5
    assert np.isfinite(directions.common).all()
    assert directions.common[:, 3:] @ world.normals[3] == pytest.approx(np.zeros(5), abs=0.05)
    blind = np.setdiff1d(np.arange(8), [one.reference[0], *target])
    assert (directions.count[blind] == 6).all()
    assert (np.delete(directions.count, blind) == 5).all()
    held = degeneracy.return_to_prior(
        VisualState(CameraStates(poses, np.zeros(8)), Calibration(np.eye(4))), prior_at(poses), directions
    )
    assert np.isfinite(held.cameras.world_from_camera).all()


def prior_at(poses: np.ndarray) -> Prior:
    count = len(poses)
    none = np.zeros((count, 3))
    each, exact = np.ones((count, 3)), np.zeros((count, 3))
    source = Source(poses, 0.002 * each, 0.01 * each, exact, exact)
    return Prior((source,), none, none, calibration_prior.build(Calibration(np.eye(4)), PriorConfig().sigma))


def test_a_common_slide_along_a_degenerate_direction_goes_back_to_the_prior(scene):
    poses = scene[1]
    directions = degeneracy.DegenerateDirections(
        np.ones(8, np.int32), np.array([[0, 0, 0, 1.0, 0, 0]]), np.zeros(3)
    )
    slid = poses.copy()
    slid[:, :3, 3] += [0.3, 0.1, 0.0]
    state = VisualState(CameraStates(slid, np.zeros(8)), Calibration(np.eye(4)))
    held = degeneracy.return_to_prior(state, prior_at(poses), directions)
    moved = held.cameras.world_from_camera[:, :3, 3] - poses[:, :3, 3]
    assert moved[:, 0] == pytest.approx(np.zeros(8), abs=0.02)
    assert moved[:, 1] == pytest.approx(np.full(8, 0.1), abs=1e-6)
    spread = degeneracy.held_covariance(held, prior_at(poses), directions)
    world = poses[:, :3, :3] @ spread[:, 3:, 3:] @ np.swapaxes(poses[:, :3, :3], 1, 2)
    assert (np.sqrt(world[:, 0, 0]) > 0.01 / np.sqrt(8) - 1e-9).all()
    assert np.abs(world[:, 1, 1]).max() < 1e-12


def test_without_degenerate_directions_nothing_moves(scene):
    state = VisualState(CameraStates(scene[1], np.zeros(8)), Calibration(np.eye(4)))
    none = degeneracy.DegenerateDirections(np.zeros(8, np.int32), np.zeros((0, 6)), np.zeros(3))
    assert (
        degeneracy.return_to_prior(state, prior_at(geometry.retract(scene[1], np.full((8, 6), 0.01))), none)
        is state
    )
