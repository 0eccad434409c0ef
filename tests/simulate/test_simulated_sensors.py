"""The simulated camera and LiDAR, each alone."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lvba import geometry, lens
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.lens import Lens
from lvba.simulate import camera as cameras
from lvba.simulate import drift, lidar, scenes
from lvba.simulate.camera import Sensor
from lvba.simulate.world import Builder, EmbreeCaster
from lvba.trajectory import pose_error

MODEL = Lens.RADIAL_TANGENTIAL
DISTORTION = (-0.12, 0.04, 8e-4, -6e-4)


def test_rays_surround_the_center_of_their_pixel():
    camera = Camera(40, 30, 35.0, 36.0, 19.0, 15.5, DISTORTION)
    rays = cameras.rays(camera)
    assert rays.shape == (30, 40, 4, 3)
    u, v = lens.distort(MODEL, DISTORTION, rays[..., 0], rays[..., 1])
    column, row = u * camera.fx + camera.cx, v * camera.fy + camera.cy
    np.testing.assert_allclose(column.mean(-1), np.tile(np.arange(40), (30, 1)), atol=1e-9)
    np.testing.assert_allclose(row.mean(-1), np.tile(np.arange(30)[:, None], (1, 40)), atol=1e-9)
    np.testing.assert_allclose(np.ptp(column, axis=-1), 0.5, atol=1e-9)


def test_a_picture_has_the_noise_exposure_and_clipping_it_should():
    sensor = Sensor(gain=100.0)
    picture = sensor.picture(np.full((200, 300, 3), 0.5, np.float32), 1.7, np.random.default_rng(1)).astype(
        float
    )
    assert abs(picture.mean() - 85) < 0.05
    assert abs(picture.std() - np.hypot(2, 12**-0.5)) < 0.03
    bright = sensor.picture(np.full((20, 30, 3), 4.0, np.float32), 1.0, np.random.default_rng(1))
    assert bright.min() == 255


def test_shot_noise_and_vignetting_are_options():
    flat = np.full((200, 300, 3), 1.5, np.float32)
    shot = Sensor(gain=100.0, shot_noise=0.05).picture(flat, 1.0, np.random.default_rng(1))
    assert abs(shot.astype(float).std() - np.sqrt(4 + 7.5)) < 0.05
    dark = Sensor(gain=100.0, vignetting=0.4).picture(flat, 1.0, np.random.default_rng(1)).astype(float)
    assert abs(dark[95:105, 145:155].mean() - 150) < 1
    assert abs(dark[:3, :3].mean() - 92) < 3
    with pytest.raises(ValueError, match="vignetting"):
        Sensor(gain=100.0, vignetting=1.2)


@pytest.mark.parametrize("seed", range(8))
def test_exposures_start_at_one_and_stay_within_half_to_twice(seed):
    exposures = cameras.exposures(100, np.random.default_rng(seed))
    assert exposures[0] == 1
    assert exposures.min() >= 0.5
    assert exposures.max() <= 2
    assert max(exposures.max(), 1 / exposures.min()) > 1.7
    assert len(cameras.exposures(2, np.random.default_rng(seed))) == 2


def box_caster() -> tuple[EmbreeCaster, Builder]:
    world = Builder(np.random.default_rng(0))
    world.box((0, 0, 0), (8, 6, 4))
    return EmbreeCaster(world.build()), world


@pytest.mark.parametrize("name", list(lidar.PATTERNS))
def test_points_lie_on_surfaces_within_the_range_noise(name):
    caster, world = box_caster()
    rng = np.random.default_rng(4)
    pose = geometry.exp(np.array([0.1, 0.2, 0.9, 1.0, -0.5, 0.3]))
    directions = lidar.PATTERNS[name](20_000, rng)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    points, intensity, _ = lidar.scan(lidar.Surroundings(world.build(), caster), pose, directions, rng)
    assert points.dtype == intensity.dtype == np.float32
    assert 0.97 * len(directions) < len(points) < len(directions)
    in_scene = geometry.transform_points(pose, points)
    inside = np.array([4, 3, 2]) - np.abs(in_scene)
    depth = inside[np.arange(len(inside)), np.abs(inside).argmin(1)]
    # along the ray the noise is 2 cm, across the surface less
    assert 0.01 < depth.std() < 0.02
    assert abs(depth.mean()) < 1e-3


def test_the_next_scan_looks_elsewhere():
    for pattern in lidar.PATTERNS.values():
        rng = np.random.default_rng(4)
        first, second = pattern(3000, rng), pattern(3000, rng)
        # beams of a depth camera begin anywhere within a pixel: what moves them is part of a beam's own distance
        spacing = np.median(cKDTree(first).query(first, k=2)[0][:, 1])
        assert np.median(cKDTree(first).query(second)[0]) > 0.1 * spacing


def test_a_rosette_stays_within_35_degrees_and_rings_go_around():
    rng = np.random.default_rng(4)
    rosette, rings = lidar.non_repetitive(5000, rng), lidar.spinning(5000, rng)
    assert np.degrees(np.arccos(rosette[:, 0])).max() < 35.01
    assert np.ptp(np.arctan2(rings[:, 1], rings[:, 0])) > 6.2
    assert len(np.unique(rings[:, 2].round(9))) == 32


def test_beams_into_the_open_give_no_points():
    world = Builder(np.random.default_rng(0))
    world.rectangle((5, -1, -1), (0, 2, 0), (0, 0, 2))
    built = world.build()
    rng = np.random.default_rng(4)
    around = lidar.Surroundings(built, EmbreeCaster(built))
    points, _, _ = lidar.scan(around, np.eye(4), lidar.spinning(20_000, rng), rng)
    assert 0 < len(points) < 2000
    assert points[:, 0].min() > 4.8


def path(count: int) -> tuple[np.ndarray, np.ndarray]:
    times = np.linspace(0, 60, count)
    turn = np.stack(
        [0 * times, 0 * times, times / 9, 5 * np.cos(times / 9), 7 * np.sin(times / 9), 0 * times], -1
    )
    poses = geometry.exp(turn * [0, 0, 1, 0, 0, 0])
    poses[:, :3, 3] = turn[:, 3:]
    return times, poses


@pytest.mark.parametrize("name", ["easy", "medium", "hard"])
def test_rough_scans_are_as_wrong_as_the_difficulty_says(name):
    times, truth = path(100)
    level = drift.difficulty(name)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rough, _ = drift.rough_scans(truth, times, drift.Drift(60.0, rng), level, rng)
        error = pose_error(rough, truth)
        assert 0.8 * level.scan_m < error.ate_m < 1.2 * level.scan_m
        assert 0.75 * level.scan_deg < error.rotation_deg < 1.25 * level.scan_deg
        # smooth: neighbors are wrong together
        assert error.rpe_m < 0.6 * error.ate_m


def test_cameras_are_as_wrong_as_the_difficulty_says():
    level, rng = drift.difficulty("medium"), np.random.default_rng(3)
    motion = geometry.exp(rng.normal(size=(50, 6)) * [1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
    found = drift.camera_error(motion, level, rng)
    error = motion @ geometry.exp(found.extrinsic) @ geometry.exp(found.noise)
    assert np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, 1))) == pytest.approx(0.015, rel=0.02)
    assert np.sqrt(np.mean(geometry.rotation_angle_deg(error) ** 2)) == pytest.approx(0.3, rel=0.02)
    assert np.linalg.norm(found.extrinsic[3:]) > 0.004


def test_an_unknown_difficulty_is_one_clear_line():
    with pytest.raises(InputError, match="easy, medium, hard"):
        drift.difficulty("brutal")


@pytest.mark.parametrize("name", ["courtyard", "rooms", "cabinet"])
def test_motion_goes_on_at_its_velocity_beyond_its_ends(name):
    """A sweep of 0.1 s before the first stamp is measured there."""
    motion = scenes.build(name, np.random.default_rng(5), 40, None).motion
    for end, way in ((0.0, -1.0), (motion.duration, 1.0)):
        times = end + way * np.array([-1e-4, 0.0, 0.05, 0.1])
        poses = motion.poses(times)
        speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.abs(np.diff(times))
        assert speed == pytest.approx(speed[0], rel=0.01)
        turns = np.linalg.norm(geometry.log(geometry.steps(poses))[:, :3], axis=1) / np.abs(np.diff(times))
        assert turns == pytest.approx(turns[0], rel=0.05)
