"""The import of a raw recording with known truth: what it writes, and what it makes of each wrong convention."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from lvba import geometry
from lvba.dataset import DESKEWED_BY
from lvba.errors import InputError
from lvba.inertial import consistency
from lvba.inertial.readings import Imu
from lvba.io import imu, tum
from lvba.io.dataset import load_scan, open_dataset
from lvba.simulate import raw
from lvba.simulate.raw import Conventions, Moment, PoseOf, Sensors
from lvba.sources.importing import readings, thickness
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions, parse_conventions
from lvba.trajectory import Trajectory

SENSORS = Sensors(points=2500, width=160, height=120)
PLAIN = Conventions()


@pytest.fixture(scope="module")
def truth():
    return raw.measure("courtyard", seconds=3.0, sensors=SENSORS)


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch):
    monkeypatch.setattr(readings, "MOST_PAIRS", 10)
    monkeypatch.setattr(thickness, "_QUERIES", 300)


def written(truth, **conventions):
    return raw.written(truth, replace(PLAIN, **conventions), SENSORS)


def stamps(paths):
    return np.array([int(Path(path).stem.replace(".", "")) for path in paths])


def scans_with_truth(dataset, truth):
    """Scans as they are and where their points were measured (N, 3), m, and when their sweep began, ns."""
    for number in range(len(dataset.scan_paths)):
        scan = load_scan(dataset, number)
        sweep = int(np.argmin([abs(times.mean() * 1e-9 - scan.time.mean()) for times in truth.point_times]))
        poses = truth.scene_from_body(truth.point_times[sweep]) @ truth.rig.body_from_lidar
        true = np.einsum("nij,nj->ni", poses[:, :3, :3], truth.points[sweep].astype(float)) + poses[:, :3, 3]
        yield scan, true, truth.scans[sweep]


def points_off(dataset, truth):
    """m: root mean square of how far points are from where they were measured."""
    squares = []
    poses = dataset.scans.world_from_sensor
    for pose, (scan, true, _) in zip(poses, scans_with_truth(dataset, truth), strict=True):
        here = geometry.transform_points(pose, scan.points) + dataset.origin
        squares.append(((here - true) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def bent(dataset, truth):
    """m: root mean square of how far points are from where the body sees them at the stamp."""
    squares = []
    for scan, true, stamp in scans_with_truth(dataset, truth):
        body_from_scene = geometry.inverse(truth.scene_from_body(np.array([stamp])))[0]
        squares.append(((scan.points - geometry.transform_points(body_from_scene, true)) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def cameras_off(dataset, truth):
    """m and degrees, root mean squares."""
    known = {encoded: number for number, encoded in enumerate(truth.encoded)}
    numbers = [known[Path(path).read_bytes()] for path in dataset.image_paths]
    true = truth.scene_from_body(truth.images[numbers]) @ geometry.inverse(truth.rig.camera_from_body)
    off = geometry.inverse(true) @ dataset.images.world_from_sensor
    return np.sqrt(np.mean(np.linalg.norm(off[:, :3, 3], axis=1) ** 2)), np.sqrt(
        np.mean(geometry.rotation_angle_deg(off) ** 2)
    )


def assert_right(out, truth, factor=1.0):
    """The noise of the odometry is left, 5 mm and 0.05 degrees."""
    dataset = open_dataset(out)
    assert len(dataset.scan_paths) >= 28
    assert len(dataset.image_paths) >= 27
    assert points_off(dataset, truth) < 0.012 * factor
    meters, degrees = cameras_off(dataset, truth)
    assert meters < 0.008 * factor
    assert degrees < 0.08 * factor
    return dataset


def test_a_raw_recording_becomes_a_folder_that_opens(tmp_path, truth):
    source = written(truth)
    report = import_source(source, tmp_path / "out")
    dataset = assert_right(tmp_path / "out", truth)
    assert report.warnings == []
    assert dataset.image_poses == "body"
    # bytes of images, and digits of times, are kept
    assert {Path(path).read_bytes() for path in dataset.image_paths} <= set(truth.encoded)
    assert set(stamps(dataset.scan_paths)) <= set(truth.scans)
    facts = yaml.safe_load((tmp_path / "out" / "recording.yaml").read_text())
    assert facts == report.facts
    for question in ("pose_direction", "pose_of", "points", "time", "extrinsic", "image_offset"):
        decided = facts["conventions"][question]
        assert decided["by"] == "data"
        assert decided["scores"][decided["taken"]] == min(decided["scores"].values())
    lines = (tmp_path / "out" / "imu.csv").read_text().splitlines()
    felt = [record for stream, record in source.items if stream == raw.IMU]
    assert lines[0] + "\n" == imu.HEADER
    assert len(lines) == len(felt) + 1
    assert lines[1].startswith(
        f"{felt[0].stamp // 10**9}.{felt[0].stamp % 10**9:09d},{felt[0].gyroscope[0]:.9g},"
    )


WRONG = {
    "stamps at the end, poses of the middle; times in ms since 1970": {
        "header": Moment.END,
        "pose_moment": Moment.MIDDLE,
        "unit": 1e-3,
        "absolute": True,
    },
    "poses of the camera, inverse; times in s": {
        "pose_of": PoseOf.CAMERA,
        "inverse": True,
        "unit": 1.0,
        "time_type": "float32",
    },
    "poses of the LiDAR, of the end; LiDAR from camera; images 100 ms late": {
        "pose_of": PoseOf.LIDAR,
        "pose_moment": Moment.END,
        "extrinsic_inverse": True,
        "image_delay": 0.1,
    },
}
"""Several at once: one at a time is in benchmarks/import_conventions.py."""


@pytest.mark.parametrize("name", WRONG)
def test_wrong_conventions_are_found_and_mended(tmp_path, truth, name):
    import_source(written(truth, **WRONG[name]), tmp_path / "out")
    assert_right(tmp_path / "out", truth)


def test_an_offset_in_time_that_is_no_convention_is_measured(tmp_path, truth):
    report = import_source(written(truth, odometry_delay=0.03, image_delay=0.03), tmp_path / "out")
    # 30 ms are 13 cm; these 3 s tell them to 5 ms
    assert_right(tmp_path / "out", truth, 3.0)
    measured = report.facts["evidence"]["poses_hold_after_their_stamp_s"]
    assert abs(measured["measured"] + 0.03) < 3 * measured["standard_deviation"]
    assert any("time: poses hold" in words for words in report.warnings)
    assert any("image_offset" in words for words in report.warnings)


def test_poses_may_be_of_any_frame_whose_extrinsic_is_known(tmp_path, truth):
    """Without an IMU nobody says which of the frames the body is."""
    report = import_source(written(truth), tmp_path / "out", ImportOptions(imu="none"))
    assert_right(tmp_path / "out", truth)
    assert report.facts["conventions"]["pose_of"]["taken"] == "frame:imu"


def as_file(path, source, order):
    samples = [record for stream, record in source.items if stream == raw.ODOMETRY]
    poses = np.array([sample.parent_from_child for sample in samples])
    if order == "wxyz":
        turned = np.roll(geometry.quaternion(poses), 1, axis=-1)
        poses = geometry.from_quaternion_translation(turned, poses[:, :3, 3])
    tum.write_trajectory(path, Trajectory(np.array([sample.stamp * 1e-9 for sample in samples]), poses))
    items = tuple(item for item in source.items if item[0] != raw.ODOMETRY)
    streams = tuple(each for each in source.description.streams if each.name != raw.ODOMETRY)
    return replace(source, items=items, description=replace(source.description, streams=streams))


def test_quaternions_in_a_file_may_be_written_w_first(tmp_path, truth):
    source = as_file(tmp_path / "poses.txt", written(truth), "wxyz")
    with pytest.raises(InputError, match=r"has no poses.*--odometry FILE"):
        import_source(source, tmp_path / "without")
    report = import_source(source, tmp_path / "out", ImportOptions(odometry=str(tmp_path / "poses.txt")))
    assert_right(tmp_path / "out", truth)
    assert report.facts["conventions"]["quaternions"]["taken"] == "wxyz"


@pytest.mark.parametrize("said", ["time=end", "image_offset=0.1"])
def test_what_is_said_against_the_data_is_refused(tmp_path, truth, said):
    options = ImportOptions(conventions=parse_conventions([said]))
    with pytest.raises(InputError, match=f"--convention {said} contradicts the data"):
        import_source(written(truth), tmp_path / "out", options)


def test_a_preset_that_the_data_contradict_is_a_warning(tmp_path, truth):
    """It says that stamps are of the end of a sweep, and they are of its begin."""
    report = import_source(written(truth), tmp_path / "out", ImportOptions(preset="ntu-viral"))
    assert_right(tmp_path / "out", truth)
    assert report.facts["conventions"]["time"]["by"] == "data"
    assert any("time: preset ntu-viral says end, the data say begin" in words for words in report.warnings)
    assert any(
        "image_offset: preset ntu-viral says +0.1, the data say +0" in words for words in report.warnings
    )


def test_poses_of_another_recording_are_refused(tmp_path, truth):
    source = written(truth)
    samples = [record for stream, record in source.items if stream == raw.ODOMETRY]
    # all the way back, and twice as fast
    turned = {
        sample.stamp: other.parent_from_child.copy()
        for sample, other in zip(samples, samples[::-1], strict=True)
    }
    for pose in turned.values():
        pose[:3, 3] *= 2
    items = tuple(
        (
            stream,
            replace(record, parent_from_child=turned[record.stamp]) if stream == raw.ODOMETRY else record,
        )
        for stream, record in source.items
    )
    with pytest.raises(InputError, match="lays the scans on each other"):
        import_source(replace(source, items=items), tmp_path / "out")


APART = (0.4, -1.1, 2.0, 0.15, -0.3, 0.08)
"""Where an IMU is on the body, turned and shifted."""


@pytest.mark.parametrize("pose_of", [PoseOf.BODY, PoseOf.LIDAR])
def test_an_imu_that_is_not_the_body_is_used_where_it_is(tmp_path, truth, pose_of):
    import_source(written(truth, imu=APART, pose_of=pose_of), tmp_path / "out")
    dataset = assert_right(tmp_path / "out", truth)
    body_from_scan = np.eye(4) if pose_of is PoseOf.BODY else truth.rig.body_from_lidar
    assert dataset.scan_from_imu == pytest.approx(
        geometry.inverse(body_from_scan) @ geometry.exp(np.array(APART)), abs=1e-9
    )
    poses = truth.scene_from_body(stamps(dataset.scan_paths)) @ body_from_scan
    exact = np.tile(1e-8 * np.eye(6), (len(poses) - 1, 1, 1))
    held = np.ones(len(poses), bool)
    readings_of = imu.read(dataset.imu_path)
    for extrinsic, used in ((dataset.scan_from_imu, True), (np.eye(4), False)):
        felt = Imu(readings_of, stamps(dataset.scan_paths) * 1e-9, extrinsic)
        factor = consistency.built(felt, poses, exact).factor
        assert (consistency.before(factor, poses, exact, held).factor is not None) is used


def test_images_whose_frame_is_a_link_of_the_camera_are_turned(tmp_path, truth):
    """x forward, y left, z up, as a driver without an optical frame says it."""
    optical_from_link = np.eye(4)
    optical_from_link[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    source = written(truth)
    items = [
        (
            name,
            replace(record, parent_from_child=record.parent_from_child @ optical_from_link)
            if name == raw.TF_STATIC and record.child == raw.CAMERA_FRAME
            else record,
        )
        for name, record in source.items
    ]
    report = import_source(replace(source, items=tuple(items)), tmp_path / "out")
    assert_right(tmp_path / "out", truth)
    decided = report.facts["conventions"]["extrinsic"]
    assert (decided["taken"], decided["by"]) == ("camera_link_from_lidar", "data")
    assert any("looks along x" in words for words in report.warnings)
    said = ImportOptions(conventions=parse_conventions(["extrinsic=camera_link_from_lidar"]))
    with pytest.raises(InputError, match="contradicts the data"):
        import_source(source, tmp_path / "said", said)


def with_info(source, change):
    """The source with another camera info."""
    items = [(name, change(record) if name == raw.CAMERA_INFO else record) for name, record in source.items]
    return replace(source, items=tuple(items))


@pytest.mark.parametrize("ahead_s", [0, 18])
def test_rectified_images_that_are_called_raw_have_the_camera_of_rectified_ones(tmp_path, truth, ahead_s):
    """As kitti2bag writes them: K and D of other images than those that are there. ahead_s: stamps of images"""
    raw_camera = replace(
        truth.camera, fx=1.33 * truth.camera.fx, fy=1.33 * truth.camera.fy, distortion=(-0.37, 0.2, 0.0, 0.0)
    )
    mixed = with_info(written(truth), lambda info: replace(info, camera=raw_camera, other=truth.camera))
    items = [
        (name, replace(record, stamp=record.stamp + ahead_s * 10**9) if name == raw.IMAGES else record)
        for name, record in mixed.items
    ]
    mixed = replace(mixed, items=tuple(items))
    report = import_source(mixed, tmp_path / "out")
    dataset = assert_right(tmp_path / "out", truth)
    assert dataset.camera.fx == pytest.approx(truth.camera.fx)
    assert report.facts["conventions"]["images"]["taken"] == "rectified"
    assert float(report.facts["conventions"]["image_offset"]["taken"]) == -ahead_s
    assert any("images: by their topic they are raw" in words for words in report.warnings)
    said = ImportOptions(conventions=parse_conventions(["images=raw"]))
    with pytest.raises(InputError, match="--convention images=raw contradicts the data"):
        import_source(mixed, tmp_path / "said", said)


def test_raw_images_keep_their_camera_beside_that_of_rectified_ones(tmp_path, truth):
    pinhole = replace(truth.camera, distortion=(0.0,) * 4)
    source = with_info(written(truth), lambda info: replace(info, other=pinhole))
    report = import_source(source, tmp_path / "out")
    assert open_dataset(tmp_path / "out").camera.distortion == pytest.approx(truth.camera.distortion)
    assert report.facts["conventions"]["images"]["taken"] == "raw"
    assert report.warnings == []
    import_source(written(truth), tmp_path / "alone")
    for name in ("config.yaml", "image_poses.txt", "lidar_poses.txt"):
        if (tmp_path / "alone" / name).exists():
            assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


def test_a_recording_says_that_its_scans_were_deskewed_by_its_poses(tmp_path, truth):
    import_source(written(truth), tmp_path / "out")
    assert open_dataset(tmp_path / "out").deskewed_by == DESKEWED_BY
    import_source(written(truth, time_type=""), tmp_path / "untimed")
    assert open_dataset(tmp_path / "untimed").deskewed_by == ()


def swaying(source, truth):
    """The source with an odometry that turns about by 0.6 degrees within half a second, as those that bend scans do."""

    def sway(record):
        seconds = (record.stamp - truth.scans[0]) * 1e-9
        turned = geometry.exp(np.radians([0.0, 0.0, 0.6 * np.sin(4 * np.pi * seconds), 0, 0, 0]))
        return replace(record, parent_from_child=record.parent_from_child @ turned)

    return replace(
        source,
        items=tuple(
            (name, sway(record) if name == raw.ODOMETRY else record) for name, record in source.items
        ),
    )


def test_poses_that_sway_bend_no_scan_where_an_imu_says_how_it_moved(tmp_path, truth):
    source = swaying(written(truth), truth)
    report = import_source(source, tmp_path / "out")
    assert report.facts["conventions"]["motion"]["taken"] == "inertial"
    import_source(source, tmp_path / "poses", ImportOptions(imu="none"))
    straight, by_poses = (open_dataset(tmp_path / name) for name in ("out", "poses"))
    assert straight.deskewed_by == by_poses.deskewed_by == DESKEWED_BY
    assert bent(straight, truth) < 0.01 < 0.03 < bent(by_poses, truth)
    assert points_off(straight, truth) < 0.02 < 0.05 < points_off(by_poses, truth)


def test_images_are_rectified_only_where_a_camera_info_says_how(tmp_path, truth):
    said = ImportOptions(conventions=parse_conventions(["images=rectified"]))
    with pytest.raises(InputError, match="images=rectified: is not possible here"):
        import_source(written(truth), tmp_path / "out", said)


def first_reading(out):
    return int((out / "imu.csv").read_text().splitlines()[1].split(",")[0].replace(".", ""))


def test_an_imu_whose_stamps_are_a_sweep_early_is_put_onto_the_clock_of_the_points(tmp_path, truth):
    source = written(truth, imu=APART)
    early = [
        (name, replace(record, stamp=record.stamp - 100_000_000) if name == raw.IMU else record)
        for name, record in source.items
    ]
    report = import_source(replace(source, items=tuple(early)), tmp_path / "out")
    assert_right(tmp_path / "out", truth)
    assert report.facts["conventions"]["imu_offset"]["taken"] == "+0.1"
    assert report.facts["conventions"]["imu_offset"]["by"] == "data"
    assert report.warnings == []
    felt = [record.stamp for name, record in source.items if name == raw.IMU]
    assert first_reading(tmp_path / "out") == felt[0]
    said = ImportOptions(conventions=parse_conventions(["imu_offset=0"]))
    with pytest.raises(InputError, match="imu_offset=0 contradicts the data"):
        import_source(replace(source, items=tuple(early)), tmp_path / "said", said)


def test_an_imu_with_another_extrinsic_than_given_is_a_warning(tmp_path, truth):
    source = written(truth)
    turned = [
        (name, replace(record, gyroscope=record.gyroscope[[1, 2, 0]]) if name == raw.IMU else record)
        for name, record in source.items
    ]
    report = import_source(replace(source, items=tuple(turned)), tmp_path / "out")
    assert any("axes are rotated by" in words for words in report.warnings)


def rewritten(source, change):
    """The source with other readings of its IMU."""
    items = [(name, change(record) if name == raw.IMU else record) for name, record in source.items]
    return replace(source, items=tuple(items))


def test_an_imu_of_other_units_and_sign_is_written_as_it_is_meant(tmp_path, truth):
    """Three seconds are too short to find the sign."""
    source = written(truth)
    other = rewritten(
        source,
        lambda read: replace(read, gyroscope=np.degrees(read.gyroscope), accelerometer=-read.accelerometer),
    )
    import_source(source, tmp_path / "right")
    said = ImportOptions(conventions=parse_conventions(["accelerometer=down"]))
    report = import_source(other, tmp_path / "mended", said)
    assert yaml.safe_load((tmp_path / "mended" / "recording.yaml").read_text()) == report.facts
    assert report.facts["applied"]["imu_rates_times"] == pytest.approx(np.pi / 180)
    assert report.facts["applied"]["imu_forces_times"] == -1.0
    assert any("taken for degrees per second" in words for words in report.warnings)
    right, mended = (imu.read(tmp_path / name / "imu.csv") for name in ("right", "mended"))
    np.testing.assert_allclose(mended.rates, right.rates, atol=1e-8)
    np.testing.assert_allclose(mended.forces, right.forces, atol=1e-8)


def test_an_imu_of_another_extrinsic_is_not_written(tmp_path, truth):
    order, signs = [1, 0, 2], [1, -1, 1]
    other = rewritten(
        written(truth, imu=APART),
        lambda read: replace(
            read,
            gyroscope=read.gyroscope[order] * signs,
            accelerometer=read.accelerometer[order] * signs,
        ),
    )
    report = import_source(other, tmp_path / "out")
    assert report.facts["applied"]["imu"] == "left out"
    assert any("it is left out" in words for words in report.warnings)
    assert not (tmp_path / "out" / "imu.csv").exists()
    assert not open_dataset(tmp_path / "out").imu_path
    assert report.facts["conventions"]["motion"]["taken"] in ("poses", "smooth")
