"""Whole simulated recordings: they open, they are what their truth says, and a seed fixes every byte."""

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lvba import geometry, lens
from lvba.errors import InputError
from lvba.inertial.factor import DOWN, GYROSCOPE, factor
from lvba.io import imu, reference
from lvba.io.dataset import load_image, load_scan, open_dataset
from lvba.simulate import blocks, scenes, simulate, truth
from lvba.simulate.drift import Closing, difficulty
from lvba.simulate.world import EmbreeCaster, PlainCaster
from lvba.trajectory import pose_error

SMALL = {"frames": 6, "width": 96, "height": 72, "points_per_scan": 2000}


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("field")
    simulate("plane", out, seed=4, scans=8, **{**SMALL, "width": 320, "height": 240})
    return out


def test_an_imu_felt_the_true_motion(tmp_path):
    simulate("plane", tmp_path, seed=4, scans=8, imu=True, **SMALL)
    dataset, facts = (
        open_dataset(tmp_path),
        json.loads((tmp_path / "reference" / "simulation.json").read_text()),
    )
    true, felt = reference.read_reference(tmp_path / "reference").scans, imu.read(dataset.imu_path)
    given = factor(felt, true.times, true.world_from_sensor)
    state = given.solve(true.world_from_sensor)
    assert len(given.measured) == 7
    assert state.squares.mean() / 3 < 1.0
    sigma = np.sqrt(np.diag(state.shared_covariance))
    off = state.shared[GYROSCOPE] - facts["imu"]["gyroscope_bias"]
    assert (np.abs(off) < 3 * sigma[GYROSCOPE]).all()
    assert state.shared[DOWN] / 9.81 == pytest.approx(facts["imu"]["down"], abs=0.03)


def test_a_recording_opens_without_warnings(field):
    dataset = open_dataset(field)
    assert dataset.warnings == ()
    assert (len(dataset.images), len(dataset.scans)) == (6, 8)
    assert not set(dataset.images.times) & set(dataset.scans.times)
    assert np.linalg.norm(dataset.sensor_position_scan) > 0.01
    facts = json.loads((field / "reference" / "simulation.json").read_text())
    true = np.array(facts["true_camera_from_body"])
    assert 0 < geometry.rotation_angle_deg(true @ geometry.inverse(dataset.camera_from_scan)) < 1
    assert facts["images_taken_after_stamp_s"] != 0
    assert reference.read_reference(field / "reference").exposures.relative[0] == 1


def test_true_poses_put_the_points_of_all_scans_on_one_plane(field):
    dataset, true = open_dataset(field), reference.read_reference(field / "reference")

    def thickness(poses: np.ndarray) -> float:
        points = np.concatenate(
            [geometry.transform_points(pose, load_scan(dataset, i).points) for i, pose in enumerate(poses)]
        )
        return float(np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[0]))

    assert thickness(true.scans.world_from_sensor) < 0.02
    assert thickness(dataset.scans.world_from_sensor) > 0.03


def test_a_place_has_the_same_radiance_in_every_image(field):
    """Points of the true map, seen in two images at the true poses, divided by the true exposures."""
    dataset, true = open_dataset(field), reference.read_reference(field / "reference")
    points = geometry.transform_points(true.scans.world_from_sensor[4], load_scan(dataset, 4).points)
    seen = [look_up(dataset, i, true, points) for i in range(len(dataset.images))]
    ratios, spreads = [], []
    for first, second in pairwise(seen):
        both = np.isfinite(first) & np.isfinite(second)
        if both.sum() > 100:
            ratios.append(first[both].mean() / second[both].mean())
            spreads.append(np.corrcoef(first[both], second[both])[0, 1])
    assert len(ratios) >= 3
    assert np.abs(np.array(ratios) - 1).max() < 0.01
    assert min(spreads) > 0.8


def look_up(dataset, index: int, true, points_world: np.ndarray) -> np.ndarray:
    """(N,): grey value over exposure at the nearest pixel, nan where a point is not seen."""
    camera, grey = dataset.camera, load_image(dataset, index).mean(axis=2)
    points = geometry.transform_points(geometry.inverse(true.images.world_from_sensor[index]), points_world)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    u, v = lens.distort(camera.lens, camera.distortion, x, y)
    column, row = np.rint(u * camera.fx + camera.cx), np.rint(v * camera.fy + camera.cy)
    inside = (points[:, 2] > 0) & (np.abs(x) < 0.8) & (np.abs(y) < 0.8)
    inside &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    value = np.full(len(points), np.nan)
    value[inside] = grey[row[inside].astype(int), column[inside].astype(int)]
    value[value > 240] = np.nan
    return value / true.exposures.relative[index]


def test_a_seed_fixes_every_byte_and_another_changes_the_world(tmp_path):
    for name, seed in (("first", 3), ("again", 3), ("other", 5)):
        simulate("courtyard", tmp_path / name, seed=seed, lidar="non_repetitive", motion_blur=True, **SMALL)

    def content(name: str) -> dict[str, bytes]:
        files = (path for path in (tmp_path / name).rglob("*") if path.is_file())
        return {str(path.relative_to(tmp_path / name)): path.read_bytes() for path in files}

    assert content("first") == content("again")
    assert not set(content("first")) & {n for n in content("other") if n.endswith((".png", ".pcd"))}


def test_the_same_simulation_may_be_written_again_but_no_other(tmp_path):
    simulate("corridor", tmp_path, seed=1, **SMALL)
    simulate("corridor", tmp_path, seed=1, **SMALL)
    with pytest.raises(InputError, match="not empty"):
        simulate("corridor", tmp_path, seed=2, **SMALL)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scene": "moon"}, "courtyard"),
        ({"lidar": "flash"}, "spinning"),
        ({"difficulty": "brutal"}, "medium"),
        ({"frames": 1}, "frames"),
        ({"seed": -1}, "seed"),
        ({"length": 1.0}, "length"),
        ({"closing": (-1.0, 0.0)}, "closing"),
    ],
)
def test_what_cannot_be_simulated_is_one_clear_line(tmp_path, wrong, message):
    with pytest.raises(InputError, match=message) as error:
        simulate(**{"scene": "plane", "out": tmp_path / "out", **wrong})
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_without_open3d_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d.core", None)
    with pytest.raises(InputError, match=r"pip install 'lvba\[simulate\]'"):
        simulate("plane", tmp_path / "out", **SMALL)


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("name", list(scenes.SCENES))
def test_nobody_walks_through_walls_and_there_is_always_something_to_see(name, seed):
    rng = np.random.default_rng(seed)
    scene = scenes.build(name, rng, 60, None)
    caster = EmbreeCaster(scene.world)
    rig = truth.random_rig(name, rng)
    found = truth.build(scene, rig, difficulty("medium"), 60, 60, rng)
    poses = scene.motion.poses(np.linspace(0, scene.motion.duration, 600))
    centers = poses[:, :3, 3]
    around = rng.normal(size=(500, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert min(caster.cast(center, around)[0].min() for center in centers[::6]) > 0.3
    assert np.all(caster.cast(centers[:-1], np.diff(centers, axis=0))[0] > 1)
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 16), np.linspace(-0.45, 0.45, 12))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    for pose in found.scene_from_camera:
        distance, quad = caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
        assert (quad >= 0).mean() > 0.6
        assert np.median(distance) > 0.4


def test_a_street_is_as_long_as_one_likes():
    for length in (50.0, 400.0):
        motion = scenes.build("street", np.random.default_rng(0), 30, length).motion
        ends = motion.position([0, motion.duration])
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(length, rel=0.02)


def test_a_courtyard_comes_back_to_its_start():
    motion = scenes.build("courtyard", np.random.default_rng(0), 60, None).motion
    ends = motion.position([0, motion.duration])
    assert np.linalg.norm(ends[1] - ends[0]) < 3
    assert np.ptp(motion.position(np.linspace(0, motion.duration, 50))[:, 0]) > 8


def test_a_drive_around_the_block_comes_back_past_its_start():
    motion = scenes.build("block", np.random.default_rng(0), 60, 200.0).motion
    line = motion.position(np.linspace(0, motion.duration, 400))[:, :2]
    assert np.sum(np.linalg.norm(np.diff(line, axis=0), axis=1)) == pytest.approx(208, rel=0.05)
    assert np.linalg.norm(line[20:-40] - line[0], axis=1).min() > 5
    assert np.linalg.norm(line[-40:] - line[0], axis=1).min() < 0.5
    assert np.all(np.ptp(line, axis=0) > 35)


@pytest.mark.parametrize("seed", range(3))
def test_a_stairwell_is_climbed_within_its_walls(seed):
    """No beam leaves it, one keeps away from all surfaces, and steps are below the path at the height of the eyes."""
    scene = scenes.build("staircase", np.random.default_rng(seed), 90, None)
    caster, rng = PlainCaster(scene.world), np.random.default_rng(seed)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    path = scene.motion.position(np.linspace(0, scene.motion.duration, 25))
    for place in path:
        reach, _ = caster.cast(place, directions)
        assert np.isfinite(reach).all()
        assert reach.min() > 0.25
        below, _ = caster.cast(place, np.array([[0.0, 0.0, -1.0]]))
        assert 1.0 < below[0] < 1.9
    assert np.ptp(path[:, 2]) > 2 * 2.5
    assert np.linalg.norm(path[0] - path[-1]) < 0.5


def test_all_of_a_terrace_looks_alike_and_its_end_is_a_lane_beside_its_start():
    scene = scenes.build("terrace", np.random.default_rng(0), 60, 120.0)
    ends = scene.motion.position([0, scene.motion.duration])
    np.testing.assert_allclose(ends[1, :2] - ends[0, :2], [0, blocks.LANE_SPACING_M], atol=0.5)
    caster, rng = EmbreeCaster(scene.world), np.random.default_rng(1)
    rays = rng.normal(size=(2000, 3))
    rays[:, 2] = -0.3 * np.abs(rays[:, 2])
    here = np.array([10.0, 0.3, 1.7])
    ranges, quads = caster.cast(here, rays)
    for shift in ([6.0, 0, 0], [0, blocks.LANE_SPACING_M, 0], [12.0, blocks.LANE_SPACING_M, 0]):
        there, others = caster.cast(here + np.array(shift), rays)
        alike = np.isclose(there, ranges, rtol=1e-3) & (
            scene.world.texture[quads] == scene.world.texture[others]
        )
        assert alike.mean() > 0.97


def test_lanes_of_the_site_are_walked_over_and_over():
    """All of them are 800 m long."""
    motion = scenes.build("site", np.random.default_rng(0), 60, 2000.0).motion
    line = motion.position(np.linspace(0, motion.duration, 4000))[:, :2]
    assert np.sum(np.linalg.norm(np.diff(line, axis=0), axis=1)) == pytest.approx(2000, rel=0.1)
    assert np.abs(line).max() < 45
    first, second = line[:2000], line[2000:]
    assert np.all(np.ptp(first, axis=0) > 75)
    again = cKDTree(second).query(first)[0]
    assert np.mean(again < 3.0) > 0.8


@pytest.mark.parametrize("name", ["block", "courtyard"])
def test_the_ends_of_a_loop_miss_each_other_by_as_much_as_is_asked_for(name):
    rig_rng = np.random.default_rng(3)
    rig = truth.random_rig(name, rig_rng)

    def missed(closing):
        rng = np.random.default_rng(2)
        scene = scenes.build(name, rng, 60, None)
        found = truth.build(scene, rig, difficulty("easy"), 60, 80, rng, closing)
        ends = []
        for rough, true in ((found.rough_scans, found.scans), (found.rough_images, found.images)):
            off = rough.world_from_sensor @ geometry.inverse(true.world_from_sensor)
            apart = geometry.inverse(off[0]) @ off[-1]
            at_end = geometry.transform_points(apart, true.world_from_sensor[-1:, :3, 3])
            ends += [
                np.linalg.norm(at_end - true.world_from_sensor[-1, :3, 3]),
                float(geometry.rotation_angle_deg(apart)),
            ]
        return np.array(ends)

    without, little = missed(None), missed(Closing(0.0, 0.0))
    np.testing.assert_allclose(without, little, atol=1e-9)
    np.testing.assert_allclose(missed(Closing(1.0, 2.0)), [1.0, 2.0, 1.0, 2.0], atol=0.2)
    with pytest.raises(InputError, match="50 m"):
        Closing(-1.0, 2.0)


def test_rough_cameras_follow_the_drift_of_the_scans():
    rng = np.random.default_rng(2)
    scene = scenes.build("courtyard", rng, 60, None)
    found = truth.build(scene, truth.random_rig("courtyard", rng), difficulty("medium"), 60, 60, rng)
    scans = pose_error(found.rough_scans.world_from_sensor, found.scans.world_from_sensor)
    images = pose_error(found.rough_images.world_from_sensor, found.images.world_from_sensor)
    assert 0.06 < scans.ate_m < 0.10
    assert 0.15 < scans.rotation_deg < 0.25
    assert abs(images.ate_m - scans.ate_m) < 0.02
