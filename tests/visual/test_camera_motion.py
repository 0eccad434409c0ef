"""How a camera moves while its rows are read: told by the rows where the trajectory does not tell it."""

from dataclasses import replace

import numpy as np
import pytest
import textured_planes

from lvba import geometry, spline
from lvba.camera import Camera
from lvba.trajectory import Trajectory
from lvba.visual import (
    bundle_adjustment,
    calibration_shifts,
    camera_motion,
    photometric,
    trajectory_prior,
    trajectory_rates,
)
from lvba.visual.photometric import PhotometricState
from lvba.visual.states import Calibration, CameraStates, VisualState

CAMERA = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)
COUNT, READOUT, EVERY_S = 8, 0.03, 0.2
SHAKEN_DEG = 3.0
"""By what the path turns from image to image, so that a spline through it tells little of the rates."""


def rolled(world, poses, twist, noise):
    """Images whose rows are seen from where the camera is when they are read; twist: (I, 6) of the camera, per second."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    images = []
    for pose, rate in zip(poses, twist, strict=True):
        total = np.zeros(u.shape)
        for row in range(CAMERA.height):
            seen = pose @ geometry.exp(rate * READOUT * (row / CAMERA.height - 0.5))
            total[row] = textured_planes.radiance(
                world, *textured_planes.cast(world, seen, CAMERA, u[row], v[row])
            )
        images.append(np.clip(np.round(total + noise * rng.normal(size=u.shape)), 0, 255).astype(np.uint8))
    return np.stack(images)[..., None]


class Scene:
    """Images in a room whose camera moves otherwise than a spline through its poses says."""

    def __init__(self) -> None:
        world = textured_planes.room()
        rng = np.random.default_rng(11)
        turns = np.concatenate(
            [np.radians(SHAKEN_DEG) * rng.normal(size=(COUNT, 3)), np.zeros((COUNT, 3))], 1
        )
        self.poses = textured_planes.walk(COUNT) @ geometry.exp(turns)
        times = EVERY_S * np.arange(COUNT)
        path = Trajectory(times, self.poses)
        self.prior = trajectory_prior.build(path, self.poses, path, np.eye(4))
        velocity, rate = camera_motion.rates(self.prior, self.state(0.0))
        local = np.einsum("nji,nj->ni", self.poses[:, :3, :3], velocity)
        self.known = np.concatenate([rate, local], axis=1)
        self.more = np.concatenate([rng.normal(0, 0.3, (COUNT, 3)), rng.normal(0, 0.05, (COUNT, 3))], axis=1)
        images = rolled(world, self.poses, self.known + self.more, noise=1.0)
        points, observations = textured_planes.scene_points(world, self.poses, CAMERA, step=10)
        points = replace(points, sigma_plane=np.full(len(points), 0.001))
        self.images, self.points, self.observations = images, points, observations
        self.shifts = calibration_shifts.of_observations(
            CAMERA, CAMERA, points, observations, self.prior, True
        )

    def state(self, readout, motion=None, poses=None):
        poses = self.poses if poses is None else poses
        cameras = CameraStates(poses, np.zeros(COUNT))
        return VisualState(cameras, Calibration(np.eye(4), readout=readout), motion)

    def problem(self, state):
        known = photometric.prepare(self.images, CAMERA, self.points, self.observations, 7, sigma=2.0)
        return replace(known, shifts=self.shifts(state))

    def at(self, state):
        """The problem at a state, the photometric part of the state, and its sums."""
        problem = self.problem(state)
        now = PhotometricState(state.cameras, np.zeros(len(self.points)), np.zeros(Calibration.layout().size))
        return problem, now, photometric.sums(problem, now)


@pytest.fixture(scope="module")
def scene():
    return Scene()


def test_rates_are_known_as_well_as_samples_that_are_left_out(scene):
    times = np.linspace(0.0, 12.0, 31)

    def turning(t):
        turn = np.zeros((len(t), 6))
        turn[:, 2], turn[:, 3] = 0.5 * np.sin(4.0 * t), 0.8 * t
        return geometry.exp(turn)

    middle = times[:-1] + 0.2
    apart = spline.leave_one_out_rates(Trajectory(times, turning(times)), middle, np.zeros(2))
    near = np.linspace(0.0, 12.0, 301)
    close = spline.leave_one_out_rates(Trajectory(near, turning(near)), middle, np.zeros(2))
    off = trajectory_rates.rates_of(Trajectory(times, turning(times)), middle)[1][:, 2] - 2.0 * np.cos(
        4.0 * middle
    )
    part = np.sqrt(np.mean(off[3:-3] ** 2) / np.mean(apart[3:-3, 0] ** 2))
    assert 0.05 < part < 1.0
    assert close[:, 0].max() < 0.02 * np.median(apart[:, 0])


def test_the_equations_are_those_of_the_cost(scene):
    """By differences of the cost with patches where the motion moves them.

    Where cameras hardly move: derivatives leave out that another row is read elsewhere.
    """
    state = scene.state(READOUT, 0.1 * scene.more - scene.known)
    problem, now, sums = scene.at(state)
    found = camera_motion.equations(problem, now, sums, state.motion)
    blocks = found.diagonal_blocks()
    for image, part in ((1, 0), (3, 1), (5, 2), (4, 3)):
        step = np.zeros((COUNT, 6))
        step[image, part] = 0.02 * READOUT
        costs = []
        for sign in (1, -1):
            there = scene.at(replace(state, motion=state.motion + sign * step / READOUT))
            costs.append(photometric.cost(there[0], there[2]))
        slope = (costs[0] - costs[1]) / (0.04 * READOUT)
        scale = np.sqrt(blocks[image, 6 + part, 6 + part])
        assert found.gradient[image, 6 + part] / scale == pytest.approx(slope / scale, rel=0.05, abs=0.5)


def test_rows_tell_the_motion_that_the_trajectory_does_not(scene):
    state, truth = scene.state(READOUT), scene.shifts(scene.state(READOUT, scene.more)).at
    before = np.sqrt(np.mean((scene.shifts(state).at - truth) ** 2))
    for _ in range(3):
        state = camera_motion.by_rows(*scene.at(state), scene.prior, state)
    after = np.sqrt(np.mean((scene.shifts(state).at - truth) ** 2))
    assert before > 0.25
    assert after < 0.3 * before
    assert state.calibration.readout == pytest.approx(READOUT, rel=0.1)


@pytest.mark.parametrize("begun", [0.7, 1.3])
def test_the_readout_is_that_by_which_rows_shift_as_the_trajectory_says(scene, begun):
    """Not a longer one, with which the motion beyond the trajectory would be smaller, and likelier: 33 to 129 ms."""
    state = scene.state(begun * READOUT)
    for _ in range(8):
        state = camera_motion.by_rows(*scene.at(state), scene.prior, state)
    assert state.calibration.readout == pytest.approx(READOUT, rel=0.04)


def test_the_readout_is_known_as_well_as_the_trajectory(scene):
    """Twice as well known rates tell it twice as well; no motion, nothing to know."""
    state, known = scene.state(READOUT, scene.more), []
    for factor in (1.0, 0.5):
        with pytest.MonkeyPatch.context() as patch:
            sigma = factor * np.tile([0.3, 0.3, 0.3, 0.05, 0.05, 0.05], (COUNT, 1))
            patch.setattr(camera_motion, "rate_sigmas", lambda prior, state, sigma=sigma: sigma)
            known.append(np.sqrt(camera_motion.readout_variance(*scene.at(state), scene.prior, state)))
    assert 1e-4 < known[1] < 0.8 * known[0]
    assert known[0] < 0.01
    still = replace(state, motion=None)
    assert camera_motion.readout_variance(*scene.at(still), scene.prior, still) == 0.0


def test_nothing_is_told_of_rows_that_are_read_at_once(scene):
    state = scene.state(0.0, scene.more)
    assert camera_motion.by_rows(*scene.at(state), scene.prior, state).motion is None


def test_poses_do_not_follow_the_motion_during_their_images(scene, monkeypatch):
    rough = scene.state(0.0, poses=textured_planes.disturbed(scene.poses, 0.002, 0.1))

    def errors():
        """Of rotations and positions, after what all have in common."""
        solved = bundle_adjustment.solve(
            scene.images, CAMERA, scene.points, scene.observations, rough, scene.prior, shifts=scene.shifts
        )
        off = geometry.log(geometry.inverse(scene.poses) @ solved.state.cameras.world_from_camera)
        off = off - off.mean(axis=0)
        return np.sqrt(np.square(off).mean(axis=0)), solved

    with_motion, solved = errors()
    assert "readout" not in solved.fixed
    monkeypatch.setattr(
        camera_motion, "by_rows", lambda problem, at, sums, prior, state: replace(state, motion=None)
    )
    without, _ = errors()
    assert with_motion[:3].max() < 0.5 * without[:3].max()
