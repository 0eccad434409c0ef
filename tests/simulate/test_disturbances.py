"""Disturbed recordings: each disturbance changes what it should and nothing else, and is exactly what it says."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from lvba import geometry, lens
from lvba.errors import InputError
from lvba.io import pcd, reference, tum
from lvba.io.dataset import load_image, open_dataset
from lvba.simulate import camera as cameras
from lvba.simulate import disturbances, disturbed, lidar, simulate, simulation, texture
from lvba.simulate.disturbances import ABOUT, Disturbances
from lvba.simulate.people import People
from lvba.simulate.view import Shine, View
from lvba.simulate.world import Builder, EmbreeCaster

SMALL = {"frames": 8, "scans": 8, "width": 96, "height": 72, "points_per_scan": 1500, "seed": 6}
CALIBRATION, SCANS, IMAGES, POSES, TRUTH = "calibration", "scans", "images", "rough poses", "truth"
CHANGES = {
    "focal": {CALIBRATION},
    "principal_point": {CALIBRATION},
    "k1": {CALIBRATION},
    "extrinsic": {CALIBRATION, POSES},
    "rolling_shutter": {IMAGES},
    "vignetting": {IMAGES},
    "response": {IMAGES},
    "srgb": {IMAGES},
    "filmic": {IMAGES},
    "white_balance": {IMAGES},
    "auto_exposure": {IMAGES, TRUTH},
    "highlights": {IMAGES},
    "people": {SCANS, IMAGES},
    "range_noise": {SCANS},
    "range_scale": {SCANS},
    "intensity_bias": {SCANS},
    "incidence_bias": {SCANS},
    "elevation_bias": {SCANS},
    "depth_distortion": {SCANS},
    "motion_left": {SCANS},
    "depth_readout": {SCANS},
    "foliage": {SCANS},
    "mirrors": {SCANS},
    "rain": {SCANS},
    "time_offset": {IMAGES, TRUTH},
    "clock_drift": {IMAGES, TRUTH},
    "stamp_jitter": {IMAGES, TRUTH},
    "gap": {SCANS, POSES, TRUTH},
    "jumps": {POSES},
    "rough_drift": {POSES},
}
"""What of a recording each disturbance changes."""


def contents(folder):
    """By what it is: the bytes of a recording."""

    def files(pattern):
        return [(path.name, path.read_bytes()) for path in sorted(folder.glob(pattern))]

    return {
        CALIBRATION: files("config.yaml"),
        SCANS: files("all_pcd_body/*.pcd"),
        IMAGES: files("all_image/*.png"),
        POSES: files("all_*/*_poses.txt"),
        TRUTH: files("reference/*.txt") + files("reference/*.csv"),
    }


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    out = tmp_path_factory.mktemp("clean") / "courtyard"
    simulate("courtyard", out, **SMALL)
    return contents(out)


@pytest.mark.parametrize("name", ABOUT)
def test_each_changes_what_it_should_and_nothing_else(clean, name, tmp_path):
    size = ABOUT[name]["levels"]["severe"]
    out = tmp_path / "courtyard"
    simulate("courtyard", out, disturb=Disturbances(**{name: size}), **SMALL)
    now = contents(out)
    assert {what for what in clean if now[what] != clean[what]} == CHANGES[name]
    facts = json.loads((out / "reference" / "simulation.json").read_text())
    assert facts["disturbances"] == {name: size}
    assert open_dataset(out).warnings == ()


def test_errors_of_depth_cameras_are_of_one_where_nobody_says_otherwise(tmp_path):
    for name in ("depth_distortion", "depth_readout"):
        assert Disturbances(**{name: 0.01, "people": 1}).usual_lidar == "depth_camera"
    assert Disturbances(range_scale=0.01).usual_lidar == "spinning"
    for given, used in (({}, "depth_camera"), ({"lidar": "non_repetitive"}, "non_repetitive")):
        simulate("courtyard", tmp_path / used, disturb=Disturbances(depth_distortion=0.01), **SMALL, **given)
        facts = json.loads((tmp_path / used / "reference" / "simulation.json").read_text())
        assert facts["lidar"] == used


def test_words_become_numbers():
    found = disturbances.parse(["rolling-shutter=typical", "k1=-0.01", "people=severe"])
    assert found == Disturbances(rolling_shutter=0.015, k1=-0.01, people=10)
    assert found.present == {"rolling_shutter": 0.015, "k1": -0.01, "people": 10}
    assert disturbances.parse([]) == disturbances.NONE


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["smear=1"], "'smear' is not known"),
        (["k1=much"], "'much' is no number"),
        (["k1"], "'' is no number"),
        (["k1=1", "k1=2"], "is given twice"),
        (["rain=-0.1"], "is negative"),
        (["rain=0.9"], "is out of range"),
        (["rain=nan"], "is out of range"),
        (["response=0.5"], "is below 1"),
    ],
)
def test_mistakes_are_named(words, message):
    with pytest.raises(InputError, match=message):
        disturbances.parse(words)


def test_the_page_has_the_table_of_the_code():
    page = (Path(__file__).resolve().parents[2] / "docs" / "simulation.md").read_text()
    assert page.endswith(disturbances.table())


def test_the_command_takes_them(lvba, tmp_path):
    small = ["--frames", 2, "--scans", 2, "--width", 64, "--height", 48, "--points", 300, "--quiet"]
    lvba("simulate", "plane", "--out", tmp_path / "a", *small, "--disturb", "focal=typical", "k1=0.01")
    calibration = yaml.safe_load((tmp_path / "a" / "config.yaml").read_text())["cam_model"]
    facts = json.loads((tmp_path / "a" / "reference" / "simulation.json").read_text())
    true = facts["true_camera"]
    assert calibration["cam_fx"] == pytest.approx(true["fx"] * 1.003, rel=1e-12)
    assert calibration["cam_d0"] == pytest.approx(true["distortion"][0] + 0.01, abs=1e-12)
    assert calibration["cam_cx"] == true["cx"]
    done = lvba("simulate", "plane", "--out", tmp_path / "b", "--disturb", "smear=1", code=2)
    assert "'smear' is not known" in done.stderr


def room():
    """A closed box of 8 m x 6 m x 3 m, with other faces for all that is drawn."""
    builder = Builder(np.random.default_rng(1))
    builder.box((0, 0, 0), (8, 6, 3))
    return builder.build()


def camera_in(world, **things):
    camera = cameras.random_camera(96, 72, np.random.default_rng(2))
    return View.of(EmbreeCaster(world), texture.build(world, np.random.default_rng(3)), camera, **things)


AHEAD = geometry.from_rotation_translation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""scene_from_camera of one that looks along x."""


def test_rows_of_a_rolling_shutter_are_rows_of_images_at_their_times():
    view = camera_in(room())
    rows = disturbed.row_times(72, 0.02)
    assert rows[0] == -0.01
    assert rows[36] == 0
    poses = AHEAD @ geometry.exp(np.outer(rows, [0.3, 2.0, 0.1, 1.0, 0.2, 0.0]))
    seen = view.radiance(poses[None])
    for row in (0, 20, 36, 71):
        np.testing.assert_allclose(seen[row], view.radiance(poses[row])[row], atol=2e-6)
    assert np.abs(seen[0] - view.radiance(poses[36])[0]).max() > 0.01


def test_highlights_are_where_the_light_is_mirrored_and_move_with_the_camera():
    world = room()
    light = np.array([-1.0, 0.0, 0.0])  # from behind the camera: mirrored back by the wall ahead
    shine = Shine(np.full(len(world), 0.5), world.normal, light)
    plain, shining = camera_in(world), camera_in(world, shine=shine)
    turned = AHEAD @ geometry.exp(np.array([0, 0.2, 0, 0, 0, 0.0]))
    peaks = []
    for pose in (AHEAD, turned):
        more = (shining.radiance(pose) - plain.radiance(pose))[..., 0]
        assert more.max() == pytest.approx(0.5, abs=0.01)
        row, column = np.unravel_index(more.argmax(), more.shape)
        ray = shining.middle[row, column] @ pose[:3, :3].T
        assert ray @ [1, 0, 0] / np.linalg.norm(ray) > 0.999
        peaks.append(column)
    assert peaks[0] - peaks[1] > 5


def standing(center):
    one = np.ones(1)
    return People(np.array([center]), np.zeros((1, 3)), one, 0 * one, np.array([[0.7, 0.2, 0.1]]))


def test_a_person_hides_what_is_behind_from_camera_and_lidar():
    world, center = room(), np.array([2.0, 0.0, -0.6])
    people = standing(center)
    plain, crowded = camera_in(world), camera_in(world, people=people)
    changed = np.abs(crowded.radiance(AHEAD) - plain.radiance(AHEAD)).max(axis=2) > 1e-6
    camera = crowded.camera
    corners = center + np.array([[-0.25, y, z] for y in (-0.2, 0.2) for z in (-0.875, 0.875)])
    x, y = -corners[:, 1] / corners[:, 0], -corners[:, 2] / corners[:, 0]
    u, v = lens.distort(camera.lens, camera.distortion, x, y)
    rows, columns = np.nonzero(changed)
    assert columns.min() == pytest.approx((u * camera.fx + camera.cx).min(), abs=1)
    assert columns.max() == pytest.approx((u * camera.fx + camera.cx).max(), abs=1)
    assert rows.min() == pytest.approx((v * camera.fy + camera.cy).min(), abs=1)

    around = lidar.Surroundings(world, EmbreeCaster(world), people)
    ahead = np.array([[1.0, 0, -0.1], [1, 0, -0.2], [-1, 0, 0]])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    points, _, beams = lidar.scan(around, np.eye(4), np.repeat(ahead, 400, axis=0), np.random.default_rng(0))
    x = [np.median(points[beams // 400 == n, 0]) for n in range(3)]
    assert x == pytest.approx([1.75, 1.75, -4.0], abs=0.01)


def ranges(world, directions, disturb, seed=0, **more):
    """Of each beam that came back, with the same noise for the same seed: measured minus true."""
    around = lidar.Surroundings(world, EmbreeCaster(world), **more)
    rng = np.random.default_rng(seed)
    points, _, beams = lidar.scan(around, np.eye(4), directions, rng, disturb)
    return np.linalg.norm(points, axis=1), beams


def directions(count=4000):
    return lidar.spinning(count, np.random.default_rng(7))


@pytest.mark.parametrize(
    ("name", "size", "expected"),
    [
        ("range_scale", 0.01, lambda distance, beam, cosine, color: 0.01 * distance),
        ("incidence_bias", 0.1, lambda distance, beam, cosine, color: 0.1 * (1 - cosine)),
        ("intensity_bias", 0.1, lambda distance, beam, cosine, color: 0.1 * (color - 0.5)),
        (
            "depth_distortion",
            0.02,
            lambda distance, beam, cosine, color: (
                0.02 * distance * (1 / np.maximum(beam[:, 0], np.sqrt(0.5)) ** 2 - 1)
            ),
        ),
    ],
)
def test_ranges_are_wrong_by_what_is_said(name, size, expected):
    world, beams = room(), directions()
    clean, heard = ranges(world, beams, disturbances.NONE)
    wrong, again = ranges(world, beams, Disturbances(**{name: size}))
    np.testing.assert_array_equal(heard, again)
    true, quad = EmbreeCaster(world).cast(np.zeros(3), beams)
    cosine = np.abs(np.einsum("ij,ij->i", beams, world.normal[quad]))
    error = expected(true, beams, cosine, world.color[quad].mean(axis=1))[heard]
    # noise and mixed points are of the same draws; the scale takes them along
    np.testing.assert_allclose(wrong - clean, error, atol=0.005)


def test_beams_are_raised_and_said_to_be_where_they_should():
    world, beams = room(), directions()
    clean, _ = ranges(world, beams, disturbances.NONE)
    raised, heard = ranges(world, beams, Disturbances(elevation_bias=1.0))
    across = np.hypot(beams[:, 0], beams[:, 1])
    angle = np.arctan2(beams[:, 2], across) + np.radians(1.0)
    higher = np.column_stack([beams[:, :2] / across[:, None] * np.cos(angle)[:, None], np.sin(angle)])
    true, _ = EmbreeCaster(world).cast(np.zeros(3), higher)
    assert np.median(np.abs(raised - true[heard])) < 0.02
    assert np.abs(clean - raised).max() > 0.1


def test_a_mirror_shows_the_room_behind_itself():
    """A wall at x = 4 that reflects: a beam along x comes back from the wall behind, after 4 m and 8 m more."""
    world = room()
    [ahead] = np.flatnonzero(np.isclose(world.corner[:, 0], 4) & np.isclose(np.abs(world.normal[:, 0]), 1))
    mirror = np.arange(len(world)) == ahead
    beams = np.tile([1.0, 0.0, 0.0], (200, 1))
    found, _ = ranges(world, beams, Disturbances(mirrors=0.1), mirror=mirror)
    assert np.median(found) == pytest.approx(12.0, abs=0.01)


def test_leaves_are_entered_and_rain_is_nearer():
    world, beams = room(), directions()
    clean, _ = ranges(world, beams, disturbances.NONE)
    leafy = np.ones(len(world), bool)
    deeper, _ = ranges(world, beams, Disturbances(foliage=0.1), leafy=leafy)
    assert np.mean(deeper - clean) == pytest.approx(0.1, rel=0.1)
    wet, _ = ranges(world, beams, Disturbances(rain=0.2))
    assert np.mean(wet < clean - 0.05) == pytest.approx(0.2, rel=0.15)


def test_people_have_no_leaves(tmp_path):
    """In a corridor of fewer surfaces than people, in which numbers of people count from the end."""
    disturb = Disturbances(people=10, foliage=0.2)
    simulate("corridor", tmp_path, disturb=disturb, **{**SMALL, "frames": 2, "scans": 6, "length": 8.0})
    assert len(open_dataset(tmp_path).scan_paths) == 6


@pytest.mark.parametrize("pattern", ["spinning", "non_repetitive"])
def test_motion_left_in_a_scan_can_be_undone_by_the_times_of_its_points(tmp_path, pattern):
    """With nothing deskewed, the true motion puts the points where those of a scan are of which all is deskewed."""
    scans = {}
    for left in (1.0, 1e-12):
        out = tmp_path / str(left)
        simulate("courtyard", out, lidar=pattern, disturb=Disturbances(motion_left=left), **SMALL)
        scans[left] = pcd.read_pcd(open_dataset(out).scan_paths[4])
    stamps = open_dataset(out).scans.times
    made = simulation.make("courtyard", SMALL["seed"], "medium", 8, 8, None, None)
    motion, moment = made.scene.motion, float(made.truth.scan_moments[4])
    times = scans[1.0].time - stamps[4]
    assert -0.1 <= times.min() < times.max() - 0.03
    assert times.max() <= 1e-6
    moved = geometry.inverse(motion.poses(np.array([moment]))) @ motion.poses(moment + times)
    straight = np.einsum("nij,nj->ni", moved[:, :3, :3], scans[1.0].points) + moved[:, :3, 3]
    # points are float32, and times to 0.2 us
    np.testing.assert_allclose(straight, scans[1e-12].points, atol=1e-5)
    assert np.abs(scans[1.0].points - scans[1e-12].points).max() > 0.05


def test_stamps_run_ahead_evenly(tmp_path):
    poses = {}
    for name, drift in (("clean", 0.0), ("drifted", 0.4)):
        simulate("street", tmp_path / name, disturb=Disturbances(clock_drift=drift), **SMALL)
        found = reference.read_reference(tmp_path / name / "reference").images
        poses[name] = found
    np.testing.assert_array_equal(poses["clean"].times, poses["drifted"].times)
    moved = np.linalg.norm(
        poses["clean"].world_from_sensor[:, :3, 3] - poses["drifted"].world_from_sensor[:, :3, 3], axis=1
    )
    speed = np.linalg.norm(np.diff(poses["clean"].world_from_sensor[:, :3, 3], axis=0), axis=1).sum()
    speed /= poses["clean"].times[-1] - poses["clean"].times[0]
    part = np.linspace(0, 1, len(moved))
    np.testing.assert_allclose(moved, 0.4 * speed * part, atol=0.15 * 0.4 * speed)


def test_extrinsic_and_clock_are_off_by_what_is_said(tmp_path):
    facts, given = {}, {}
    for name, disturb in (("clean", {}), ("wrong", {"extrinsic": 3.0, "time_offset": 0.1})):
        simulate("courtyard", tmp_path / name, disturb=Disturbances(**disturb), **SMALL)
        facts[name] = json.loads((tmp_path / name / "reference" / "simulation.json").read_text())
        given[name] = open_dataset(tmp_path / name).camera_from_scan
    change = given["clean"] @ geometry.inverse(given["wrong"])
    assert geometry.rotation_angle_deg(change) == pytest.approx(3.0, abs=1e-6)
    calibrated = [np.array(each["rough_camera_from_body"]) for each in facts.values()]
    moved = geometry.log(calibrated[0] @ geometry.inverse(calibrated[1]))
    assert np.linalg.norm(moved[3:]) == pytest.approx(0.05, abs=1e-6)
    late = [each["images_taken_after_stamp_s"] for each in facts.values()]
    assert late[1] - late[0] == pytest.approx(0.1)


def test_a_gap_has_no_scans_and_jumps_are_as_large_as_said(tmp_path):
    simulate("street", tmp_path / "gap", disturb=Disturbances(gap=2.0), **SMALL)
    steps = np.diff(open_dataset(tmp_path / "gap").scans.times)
    assert steps.max() == pytest.approx(2.0 + np.median(steps), abs=0.1 * np.median(steps) + 0.05)
    assert steps.argmax() == 3

    rough = {}
    for name, count in (("clean", 0), ("jumped", 1)):
        simulate("street", tmp_path / name, disturb=Disturbances(jumps=count), **SMALL)
        path = tmp_path / name / "all_pcd_body" / "lidar_poses.txt"
        rough[name] = tum.read_trajectory(path).world_from_sensor
    change = rough["jumped"] @ geometry.inverse(rough["clean"])
    size = geometry.rotation_angle_deg(change)
    first = int(np.flatnonzero(size > 1)[0])
    np.testing.assert_allclose(size, np.where(np.arange(8) < first, 0, 2.0), atol=1e-5)
    jump = np.linalg.norm((rough["jumped"] - rough["clean"])[first, :3, 3])
    assert jump == pytest.approx(1.0, abs=0.2)


def test_white_balance_and_automatic_exposure():
    gains = cameras.white_balances(50, 0.1, np.random.default_rng(0))
    np.testing.assert_array_equal(gains[0], 1)
    np.testing.assert_allclose(np.log(gains).mean(axis=1), 0, atol=1e-12)
    assert 0.1 < np.abs(np.log(gains)).max() < 0.6
    assert np.abs(np.diff(np.log(gains), axis=0)).max() < 0.05
    followed = cameras.automatic_exposures(np.r_[np.full(20, 0.2), np.full(20, 0.4)], 1.0)
    assert followed[19] == pytest.approx(1.0)
    assert followed[20] == pytest.approx(2**-0.5)
    assert followed[-1] == pytest.approx(0.5, rel=1e-3)


def test_a_response_curve_brightens_what_is_dark():
    sensor = cameras.Sensor(gain=255.0, noise=0.0, response=2.2)
    radiance = np.full((2, 2, 3), 0.25, np.float32)
    picture = sensor.picture(radiance, 1.0, np.random.default_rng(0))
    assert picture[0, 0, 0] == round(255 * 0.25 ** (1 / 2.2))
    linear = replace(sensor, response=1.0).picture(radiance, 1.0, np.random.default_rng(0))
    assert linear[0, 0, 0] == round(255 * 0.25)


def test_srgb_and_filmic_curves_are_those_published():
    light = np.array([0.0, 0.002, 0.0031308, 0.18, 0.5, 1.0], np.float32)
    srgb = [0.0, 0.02584, 0.04045, 0.46136, 0.73536, 1.0]  # of IEC 61966-2-1
    np.testing.assert_allclose(cameras.srgb_curve(light), srgb, atol=1e-4)
    filmic = cameras.filmic_curve(light)
    assert filmic[0] == 0
    assert filmic[-1] == pytest.approx(1.0)
    slopes = np.diff(filmic) / np.diff(light)
    assert filmic[1] < srgb[1]
    assert (slopes > 0).all()
    assert slopes[-1] < slopes[-2]
    radiance = np.full((2, 2, 3), 0.18, np.float32)
    sensor = cameras.Sensor(gain=255.0, noise=0.0, srgb=1.0)
    assert sensor.picture(radiance, 1.0, np.random.default_rng(0))[0, 0, 0] == round(255 * 0.46136)


def test_images_of_a_disturbed_recording_are_readable(tmp_path):
    everything = Disturbances(**{name: about["levels"]["typical"] for name, about in ABOUT.items()})
    simulate("rooms", tmp_path / "a", disturb=everything, motion_blur=True, shot_noise=True, **SMALL)
    dataset = open_dataset(tmp_path / "a")
    assert 20 < load_image(dataset, 3).mean() < 235
