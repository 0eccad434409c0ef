"""One level of the visual bundle adjustment in a small world of known planes."""

from dataclasses import replace

import numpy as np
import pytest
import textured_planes

from lvba import geometry, trajectory
from lvba.camera import Camera
from lvba.optim.normal_equations import NormalEquations
from lvba.visual import bundle_adjustment, calibration_prior, covariance, exposure_graph, trajectory_prior
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior, Source
from lvba.visual.variant import Variant

CAMERA = Camera(320, 240, 190.0, 190.0, 159.5, 119.5)
COUNT = 10

JOINT = Variant(exposures="joint")


@pytest.fixture(scope="module")
def scene():
    world, poses = textured_planes.room(), textured_planes.walk(COUNT)
    log_exposure = 0.2 * np.random.default_rng(1).normal(size=COUNT)
    log_exposure -= log_exposure[0]
    images = textured_planes.render(world, poses, CAMERA, np.exp(log_exposure), noise=2.0)
    points, observations = textured_planes.scene_points(world, poses, CAMERA, step=14)
    return images, points, observations, poses, log_exposure


def still(world_from_camera: np.ndarray, sigma_m: float = 0.02, sigma_deg: float = 0.3) -> Prior:
    """A prior that expects the cameras at these poses."""
    count = len(world_from_camera)
    each, none = np.ones((count, 3)), np.zeros((count, 3))
    source = Source(world_from_camera, np.radians(sigma_deg) * each, sigma_m * each, none, none)
    return Prior((source,), none, none, calibration_prior.build(Calibration(np.eye(4)), PriorConfig().sigma))


def start(poses: np.ndarray, seed: int = 0) -> VisualState:
    rough = textured_planes.disturbed(poses, 0.005, 0.1, seed)
    return VisualState(CameraStates(rough, np.zeros(len(poses))), Calibration(np.eye(4)))


def errors(state: VisualState, poses: np.ndarray) -> tuple[float, float]:
    """Root mean square position error in mm and rotation error in degrees, without alignment."""
    error = trajectory.pose_error(state.cameras.world_from_camera, poses, aligned=np.eye(4))
    return 1e3 * error.ate_m, error.rotation_deg


def test_poses_and_exposures_are_found_in_a_room_without_any_prior(scene):
    images, points, observations, poses, log_exposure = scene
    rough = start(poses)
    found = bundle_adjustment.solve(images, CAMERA, points, observations, rough, None, variant=JOINT)
    assert errors(rough, poses)[0] > 6
    # the least held common motion, along the view, has a standard deviation of 1.5 mm here
    assert errors(found.state, poses)[0] < 3.0
    among = trajectory.pose_error(found.state.cameras.world_from_camera, poses)
    assert among.ate_m < 0.0005
    assert among.rotation_deg < 0.04
    assert found.state.cameras.log_exposure == pytest.approx(log_exposure, abs=0.003)
    assert found.converged
    assert 1.5 < np.median(found.problem.sigma) < 3.0


def test_a_prior_with_a_wrong_extrinsic_does_not_pull_and_the_extrinsic_is_found(scene):
    images, points, observations, poses, _ = scene
    points = replace(
        points, plane=textured_planes.in_cells(textured_planes.room(), points.plane, points.position_world)
    )
    wrong = geometry.exp(np.array([0.01, -0.02, 0.01, 0.01, 0.02, -0.01]))
    rough = start(poses)
    found = bundle_adjustment.solve(
        images, CAMERA, points, observations, rough, still(poses @ wrong), variant=JOINT
    )
    millimeters, degrees = errors(found.state, poses)
    assert millimeters < 1.5
    assert degrees < 0.02
    assert geometry.log(wrong @ found.state.calibration.scan_from_camera) == pytest.approx(
        np.zeros(6), abs=1.5e-3
    )
    assert found.prior is not None
    assert found.prior.sources[0].sigma_position.max() < 0.004


def bent(points, poses):
    """The points with every wall turned by a few degrees, each about an axis of its own, still on their pixels' rays."""
    turns = geometry.exp(np.pad(0.05 * np.random.default_rng(8).normal(size=(6, 3)), ((0, 0), (0, 3))))
    normal = np.einsum("pij,pj->pi", turns[points.plane, :3, :3], points.normal_world)
    middle = np.array([points.position_world[points.plane == k].mean(axis=0) for k in range(6)])
    eye = poses[points.reference, :3, 3]
    ray = points.position_world - eye
    reach = ((middle[points.plane] - eye) * normal).sum(axis=1) / (ray * normal).sum(axis=1)
    return replace(points, position_world=eye + reach[:, None] * ray, normal_world=normal)


def test_walls_that_contradict_each_other_do_not_draw_the_extrinsic_from_where_it_was_calibrated(
    scene, monkeypatch
):
    images, points, observations, poses, _ = scene
    claims = still(poses).calibration.claimed
    variant = Variant(plane_offsets=False, exposures="joint")
    off, counts = [], []
    for weighed in (calibration_prior.weighed, lambda *_: claims):
        monkeypatch.setattr(calibration_prior, "weighed", weighed)
        found = bundle_adjustment.solve(
            images,
            CAMERA,
            bent(points, poses),
            observations,
            start(poses),
            still(poses, 0.005, 0.1),
            variant=variant,
        )
        assert found.prior is not None
        assert found.prior.calibration.counted is not None
        counts.append(np.linalg.eigvals(np.linalg.solve(claims, found.prior.calibration.counted)).real)
        off.append(np.linalg.norm(found.state.calibration.scan_from_camera[:3, 3]))
    assert counts[0].max() > 5
    assert counts[0].min() > 1 - 1e-9
    assert off[0] < 0.8 * off[1]


def test_over_one_bare_plane_the_cameras_stay_at_the_prior(scene):
    images, points, observations, poses, _ = scene
    floor = points.plane[observations.point] == np.bincount(points.plane).argmax()
    only = textured_planes.Observations(
        observations.point[floor], observations.target[floor], observations.is_global[floor]
    )
    truth = still(poses)
    found = bundle_adjustment.solve(images, CAMERA, points, only, start(poses), truth, variant=JOINT)
    deviation = trajectory_prior.residuals(truth, truth.sources[0], found.state)
    rotation, position = deviation[:, :3], deviation[:, 3:]
    # 5 mm per axis at the start; along the plane the common motion is the prior's
    assert np.abs(position.mean(axis=0)).max() < 2e-3
    assert np.sqrt((position**2).mean()) < 4e-3
    assert np.degrees(np.sqrt((rotation**2).mean())) < 0.1


def test_exposures_that_are_not_to_be_solved_stay(scene):
    images, points, observations, poses, log_exposure = scene
    state = VisualState(
        CameraStates(start(poses).cameras.world_from_camera, log_exposure), Calibration(np.eye(4))
    )
    found = bundle_adjustment.solve(images, CAMERA, points, observations, state, None)
    assert (found.state.cameras.log_exposure == log_exposure).all()
    assert errors(found.state, poses)[0] < 3.0


def test_every_component_of_the_graph_keeps_one_exposure():
    component = exposure_graph.components(np.array([0, 1, 4]), np.array([1, 2, 3]), 6)
    assert component[0] == component[1] == component[2]
    assert component[3] == component[4]
    assert len(set(component)) == 3


def test_what_walls_tell_of_an_image_adds_up_to_what_the_equations_say(scene):
    images, points, observations, poses, _ = scene
    found = bundle_adjustment.solve(
        images, CAMERA, points, observations, start(poses), still(poses), variant=JOINT
    )
    at = found.photometric
    wall_clusters = covariance.find_wall_clusters(found.problem)
    told = covariance.information(found.problem, found.linearization, at, wall_clusters)
    total = np.zeros((COUNT, 6, 6))
    np.add.at(total, wall_clusters.image, told)
    equations = found.linearization.equations
    own = equations.rows == equations.columns
    assert total == pytest.approx(equations.blocks[own][:, :6, :6], rel=1e-7, abs=1e-3)
    plain = covariance.cluster_gradients(found.problem, found.linearization, wall_clusters)
    wanted = np.zeros((COUNT, 7))
    for n, (point, target) in enumerate(
        zip(found.problem.observations.point, found.problem.observations.target)
    ):
        wanted[points.reference[point]] += found.linearization.single[n, :7]
        wanted[target] += found.linearization.single[n, 7:14]
    assert np.asarray(plain.sum(axis=0)).reshape(COUNT, 7) == pytest.approx(wanted)


def test_what_cancels_between_the_images_of_a_wall_still_does_where_its_error_counts_for_more(scene):
    images, points, observations, poses, _ = scene
    found = bundle_adjustment.solve(
        images, CAMERA, points, observations, start(poses), still(poses), variant=JOINT
    )
    problem, at, walls = found.problem, found.photometric, covariance.find_wall_clusters(found.problem)
    known = bundle_adjustment.joint(found.linearization.equations, found.prior, found.state)
    gradients = covariance.wall_gradients(problem, found.linearization, at, walls, known)
    plain = covariance.cluster_gradients(problem, found.linearization, walls).toarray()
    columns = plain.shape[1]
    reduced = covariance.bias_reduced_gradients(gradients, known.shared).toarray()[:, :columns]
    balanced = covariance.balanced_gradients(gradients, known.shared).toarray()[:, :columns]
    pulls = np.abs(plain).max(axis=1) > 0
    plain, reduced, balanced = plain[pulls], reduced[pulls], balanced[pulls]
    factor = np.einsum("wi,wi->w", balanced, plain) / np.einsum("wi,wi->w", plain, plain)
    np.testing.assert_allclose(balanced, factor[:, None] * plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    assert (factor >= 1 - 1e-12).all()
    assert factor.max() > 1.05
    # by all that is known of each image, a wall's error is as large as bias reduction has it
    inverse = np.linalg.inv(known.diagonal_blocks()[:, :6, :6])

    def squared(gradients):
        by_image = gradients.reshape(len(gradients), COUNT, 7)[:, :, :6]
        return np.einsum("wia,iab,wib->w", by_image, inverse, by_image)

    np.testing.assert_allclose(squared(balanced), squared(reduced), rtol=1e-6)
    # bias reduction image by image turns them
    assert np.abs(reduced - factor[:, None] * plain).max() > 1e-3 * np.abs(plain).max()


@pytest.mark.parametrize("camera", ["refined", "as calibrated"])
def test_an_image_that_shares_no_point_changes_the_covariance_of_no_other(scene, camera):
    """Before, without a prior: `LinAlgError: Singular matrix`; as calibrated: an `IndexError`."""
    images, points, observations, poses, _ = scene

    def covariance_with(more: int) -> np.ndarray:
        rough = start(np.concatenate([poses, poses[:more]]))
        rough.cameras.world_from_camera[:COUNT] = start(poses).cameras.world_from_camera
        taken = np.concatenate([images, images[:more]])
        variant = replace(JOINT, camera=camera)
        found = bundle_adjustment.solve(taken, CAMERA, points, observations, rough, None, variant=variant)
        known, own = bundle_adjustment.covariance_of(found)
        np.testing.assert_array_equal(own, known.blocks[:, :6, :6])  # without a prior, nothing is shared
        return known.blocks

    alone, beside = covariance_with(0), covariance_with(1)
    assert np.isfinite(alone).all()
    assert (np.diagonal(alone[:, :6, :6], axis1=1, axis2=2) > 0).all()
    np.testing.assert_allclose(beside[:COUNT], alone, rtol=1e-6, atol=1e-12)


def test_a_wall_that_alone_holds_an_image_counts_for_as_much_as_it_may_be_wrong():
    # three walls, one to each axis of a position; the equations of the image are their sum and a weak prior
    walls = np.zeros((3, 6, 6))
    walls[0, 3, 3], walls[1, 4, 4], walls[2, 5, 5] = 100.0, 100.0, 100.0
    also = walls[0].copy()
    also[3, 3] = 300.0
    prior_block = np.diag([1.0, 1, 1, 25, 25, 25])
    hessian = np.zeros((1, 7, 7))
    hessian[0, :6, :6] = walls.sum(0) + also + prior_block
    known = NormalEquations(np.zeros(1, np.int32), np.zeros(1, np.int32), hessian, np.zeros((1, 7)), 0.0)
    every = np.concatenate([walls, also[None]])
    gradients = np.zeros((4, 6))
    gradients[:, 3:] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]
    found = covariance.bias_reduced(every, gradients, np.zeros(4, np.int64), known)
    # along the first axis two walls and the prior, 425 in all; along the others a wall and the prior, 125
    assert found[0, 3] == pytest.approx(np.sqrt(425 / 325))
    assert found[3, 3] == pytest.approx(-np.sqrt(425 / 125))
    assert found[1, 4] == pytest.approx(np.sqrt(125 / 25))
    assert found[2, 5] == pytest.approx(np.sqrt(5))
