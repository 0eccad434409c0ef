import os
from pathlib import Path

import numpy as np
import pytest
import small_recording
from small_recording import START

from lvba import geometry
from lvba.dataset import NO_CAMERA
from lvba.io import dataset, frames, images, pcd, result_folder, tum
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.trajectory import Trajectory


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("poses_inside", [True, False])
def test_a_recording_opens_with_all_its_frames(
    tmp_path: Path, encoding: str, suffix: str, poses_inside: bool
):
    root = small_recording.write(tmp_path, encoding=encoding, suffix=suffix, poses_inside=poses_inside)
    found = open_dataset(root)
    assert found.warnings == ()
    assert list(found.scan_paths) == [str(path) for path in small_recording.scan_files(root)]
    assert list(found.image_paths) == [str(path) for path in small_recording.image_files(root)]
    np.testing.assert_allclose(found.scans.times, START + 0.1 * np.arange(6), atol=1e-6)
    expected = small_recording.walk(found.scans.times)
    np.testing.assert_allclose(found.scans.world_from_sensor, expected, atol=1e-8)
    np.testing.assert_allclose(found.camera_from_scan, small_recording.camera_from_body(), atol=1e-12)
    np.testing.assert_array_equal(found.sensor_position_scan, small_recording.EXTRINSIC_T)
    np.testing.assert_array_equal(found.origin, 0)
    assert (found.camera.width, found.camera.fx, found.camera.distortion) == (
        32,
        30.5,
        (-0.1, 0.02, 0.001, -0.002),
    )


def test_frames_stream(tmp_path: Path):
    found = open_dataset(small_recording.write(tmp_path))
    scans = dataset.load_scans(found)
    assert [len(scan) for scan in scans] == [50] * 6
    np.testing.assert_array_equal(scans[3], pcd.read_pcd(found.scan_paths[3]).points)
    np.testing.assert_array_equal(dataset.load_scans(found, [4, 1])[1], scans[1])
    assert dataset.load_scan(found, 2).intensity is not None
    image = dataset.load_image(found, 0)
    assert image.shape == (24, 32, 3)
    assert image.dtype == np.uint8


def test_beams_that_did_not_come_back_are_no_points_of_a_scan(tmp_path: Path):
    """Drivers write zeros; in the body frame they lie at zero, or where the sensor is."""
    root = small_recording.write(tmp_path)
    path = small_recording.scan_files(root)[2]
    points = pcd.read_pcd(path).points
    measured = points.copy()
    points[:10], points[10:20] = 0, small_recording.EXTRINSIC_T
    pcd.write_pcd(path, points, np.arange(50))
    scan = dataset.load_scan(open_dataset(root), 2)
    np.testing.assert_array_equal(scan.points, measured[20:])
    np.testing.assert_array_equal(scan.intensity, np.arange(20, 50))
    assert scan.dropped == 20


def test_a_scan_of_zeros_alone_is_left_out(tmp_path: Path):
    root = small_recording.write(tmp_path)
    pcd.write_pcd(small_recording.scan_files(root)[2], np.zeros((50, 3)))
    found = open_dataset(root)
    assert len(found.scan_paths) == 5
    assert any("left out this scan" in warning for warning in found.warnings)


def test_without_images_it_is_a_lidar_recording(tmp_path: Path):
    found = open_dataset(small_recording.write(tmp_path, pictures=0))
    assert found.image_paths == ()
    assert found.images.world_from_sensor.shape == (0, 4, 4)
    assert found.camera == NO_CAMERA
    assert found.warnings == ()


def test_frames_between_poses_are_interpolated_and_those_far_from_poses_left_out(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=20, pictures=0)
    times = START + np.array(
        [0.0, 0.15, 0.3, 0.45, 0.6, 1.3, 1.4]
    )  # a hole of 0.7 s, and nothing after 1.4 s
    tum.write_trajectory(
        root / "all_pcd_body" / "lidar_poses.txt", Trajectory(times, small_recording.walk(times))
    )
    found = open_dataset(root)
    kept = START + 0.1 * np.array([0, 1, 2, 3, 4, 5, 6, 13, 14])
    np.testing.assert_allclose(found.scans.times, kept, atol=1e-6)
    truth = small_recording.walk(kept)
    np.testing.assert_allclose(found.scans.world_from_sensor, truth, atol=2e-3)
    assert any("left out 11 scans" in warning for warning in found.warnings)
    assert any("4 scans were interpolated" in warning for warning in found.warnings)


def test_poses_of_a_higher_rate_and_another_length(tmp_path: Path):
    root = small_recording.write(tmp_path)
    times = START + np.arange(-3, 1.5, 0.01)
    tum.write_trajectory(
        root / "all_pcd_body" / "lidar_poses.txt", Trajectory(times, small_recording.walk(times))
    )
    found = open_dataset(root)
    assert len(found.scan_paths) == 6
    np.testing.assert_allclose(
        found.scans.world_from_sensor, small_recording.walk(found.scans.times), atol=1e-7
    )
    assert any("444 of 450 poses belong to no scan file" in warning for warning in found.warnings)


def test_times_rounded_differently_are_the_pose_s(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)
    for index, path in enumerate(small_recording.scan_files(root)):
        path.rename(path.with_name(f"{START + 0.1 * index + 0.0004:.4f}.pcd"))
    found = open_dataset(root)
    np.testing.assert_array_equal(
        found.scans.times, tum.read_trajectory(root / "all_pcd_body/lidar_poses.txt").times
    )
    assert found.warnings == ()


def test_names_in_nanoseconds(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)
    for path in small_recording.scan_files(root):
        path.rename(path.with_name(path.stem.replace(".", "") + "000.pcd"))
    assert len(open_dataset(root).scan_paths) == 6


@pytest.mark.parametrize("style", ["whole", "decimal"])
@pytest.mark.parametrize("poses", ["nanoseconds", "microseconds", "scientific", "between"])
def test_results_have_the_nanoseconds_of_the_names(tmp_path: Path, style: str, poses: str):
    root = small_recording.write(tmp_path / "in")
    for folder in ("all_pcd_body", "all_image"):
        for index, path in enumerate(sorted((root / folder).glob("*.p[cn][dg]"))):
            digits = path.stem.replace(".", "") + f"{123 + index}"
            stem = digits if style == "whole" else f"{digits[:10]}.{digits[10:]}"
            path.rename(path.with_name(stem + path.suffix))
        for path in (root / folder).glob("*_poses.txt"):
            lines = [line.split(" ", 1) for line in path.read_text().splitlines()]
            if poses == "nanoseconds":
                lines = [[f"{float(time):.6f}{123 + i}", rest] for i, (time, rest) in enumerate(lines)]
            elif poses == "scientific":
                lines = [[f"{float(time):.18e}", rest] for time, rest in lines]
            elif poses == "between":
                lines = [
                    [f"{float(time) + (-0.004 if i == 0 else 0.004):.6f}", rest]
                    for i, (time, rest) in enumerate(lines)
                ]
            path.write_text("".join(f"{time} {rest}\n" for time, rest in lines))
    found = open_dataset(root)
    result_folder.write_poses(tmp_path, found, found.scans.world_from_sensor, found.images.world_from_sensor)
    result_folder.write_exposures(tmp_path, found, np.ones(len(found.images)))
    for name, paths in (
        ("lidar_poses.txt", found.scan_paths),
        ("image_poses.txt", found.image_paths),
        ("exposures.csv", found.image_paths),
    ):
        lines = [line for line in (tmp_path / name).read_text().splitlines() if line[0].isdigit()]
        written = [line.replace(",", " ").split()[0].replace(".", "") for line in lines]
        assert len(paths) >= 4
        assert written == [Path(path).stem.replace(".", "") for path in paths]
    opened = result_folder.read_cameras(tmp_path, found)
    np.testing.assert_array_equal(opened.times, found.images.times)


def test_far_from_zero_the_world_is_shifted_by_whole_meters_and_back(tmp_path: Path):
    offset = np.array([456_789.25, 5_123_456.5, 312.0])
    root = small_recording.write(tmp_path / "in", offset=offset)
    found = open_dataset(root)
    np.testing.assert_array_equal(found.origin, np.round(offset))
    near = small_recording.walk(found.scans.times)
    near[:, :3, 3] += offset - np.round(offset)
    np.testing.assert_allclose(found.scans.world_from_sensor, near, atol=1e-8)
    result_folder.write_poses(
        tmp_path / "out", found, found.scans.world_from_sensor, found.images.world_from_sensor
    )
    for name, folder in (("lidar_poses.txt", "all_pcd_body"), ("image_poses.txt", "all_image")):
        before, after = (
            tum.read_trajectory(root / folder / name),
            tum.read_trajectory(tmp_path / "out" / name),
        )
        np.testing.assert_array_equal(after.times, before.times)
        np.testing.assert_allclose(after.world_from_sensor, before.world_from_sensor, atol=2e-9)


def test_the_body_of_the_scans_need_not_be_the_lidar(tmp_path: Path):
    """X_camera = Rcl X_lidar + Pcl and X_body = extrinsic_R X_lidar + extrinsic_T."""
    root = small_recording.write(tmp_path)
    text = small_recording.CONFIG.replace(
        "extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]", "extrinsic_R: [0, 1, 0, -1, 0, 0, 0, 0, 1]"
    )
    (root / "config.yaml").write_text(text)
    poses = tum.read_trajectory(root / "all_image" / "image_poses.txt")
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    body_from_lidar = geometry.from_rotation_translation(turn, small_recording.EXTRINSIC_T)
    lidar_from_camera = geometry.inverse(
        geometry.from_rotation_translation(small_recording.RCL, small_recording.PCL)
    )
    cameras = small_recording.walk(poses.times) @ body_from_lidar @ lidar_from_camera
    tum.write_trajectory(root / "all_image" / "image_poses.txt", Trajectory(poses.times, cameras))
    found = open_dataset(root)
    point_lidar = np.array([1.0, 2.0, 3.0])
    point_body = turn @ point_lidar + small_recording.EXTRINSIC_T
    point_camera = small_recording.RCL @ point_lidar + small_recording.PCL
    np.testing.assert_allclose(
        geometry.transform_points(found.camera_from_scan, point_body[None])[0], point_camera
    )
    assert found.warnings == ()


def test_one_bad_frame_among_many_is_left_out_with_a_warning(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=8, pictures=8)
    scans, pictures = small_recording.scan_files(root), small_recording.image_files(root)
    scans[1].write_bytes(scans[1].read_bytes()[:-40])
    scans[2].write_bytes(b"")
    pcd.write_pcd(scans[3], np.full((9, 3), np.nan))
    pictures[4].write_bytes(pictures[4].read_bytes()[:-40])
    pictures[5].unlink()
    pictures[6].unlink()
    pictures[6].symlink_to("nowhere.png")
    found = open_dataset(root)
    assert [Path(path) for path in found.scan_paths] == [scans[i] for i in (0, 4, 5, 6, 7)]
    assert [Path(path) for path in found.image_paths] == [pictures[i] for i in (0, 1, 2, 3, 7)]
    np.testing.assert_allclose(found.images.times, START + 0.05 + 0.1 * np.array([0, 1, 2, 3, 7]), atol=1e-6)
    text = "\n".join(found.warnings)
    for path in (*scans[1:4], pictures[4], pictures[6]):
        assert path.name in text
    assert "1 of 8 poses belong to no image file" in text


def test_images_of_another_size_than_most_are_left_out(tmp_path: Path):
    root = small_recording.write(tmp_path)
    odd = small_recording.image_files(root)[2]
    images.write_image(odd, np.zeros((10, 10, 3), np.uint8))
    found = open_dataset(root)
    assert len(found.image_paths) == 4
    assert any(odd.name in warning and "not 32 x 24" in warning for warning in found.warnings)


def test_images_that_fast_livo_shrank_have_the_shrunk_camera(tmp_path: Path):
    root = small_recording.write(tmp_path)
    text = small_recording.CONFIG.replace("cam_width: 32", "cam_width: 64").replace(
        "cam_height: 24", "cam_height: 48"
    )
    (root / "config.yaml").write_text(text.replace("scale: 1.0", "scale: 0.5"))
    camera = open_dataset(root).camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (32, 24, 30.5 / 2, 31 / 2)
    assert (camera.cx, camera.cy) == (16 / 2 - 0.5, 12 / 2 - 0.5)


def test_symbolic_links_are_followed(tmp_path: Path):
    root = small_recording.write(tmp_path / "real")
    (tmp_path / "link").symlink_to(root)
    assert len(open_dataset(tmp_path / "link").scan_paths) == 6


def test_hostile_names_are_left_out(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)
    content = small_recording.scan_files(root)[0].read_bytes()
    folder = os.fsencode(root / "all_pcd_body")
    for name in (
        b"1\n2.pcd",
        b"\xff\xfe1.pcd",
        b"no number.pcd",
        b"." + b"9" * 200 + b".pcd",
        b"9" * 250 + b".pcd",
    ):
        with open(folder + b"/" + name, "wb") as file:
            file.write(content)
    found = open_dataset(root)
    assert len(found.scan_paths) == 6
    assert all(len(warning.splitlines()) == 1 for warning in found.warnings)
    "\n".join(found.warnings).encode("ascii")


def test_pipes_and_devices_are_no_frames(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)
    scans = small_recording.scan_files(root)
    scans[0].unlink()
    os.mkfifo(scans[0])  # opening it would wait forever
    scans[1].unlink()
    scans[1].symlink_to("/dev/zero")
    scans[2].unlink()
    scans[2].mkdir()
    assert len(open_dataset(root).scan_paths) == 3


def test_the_digest_tells_whether_the_input_is_the_same(tmp_path: Path):
    first = small_recording.write(tmp_path / "a")
    second = small_recording.write(tmp_path / "elsewhere" / "b")
    digest = open_dataset(first).digest
    assert len(digest) == 64
    assert open_dataset(second).digest == digest
    for path in (
        small_recording.scan_files(second)[2],
        second / "config.yaml",
        second / "all_image/image_poses.txt",
    ):
        content = path.read_bytes()
        path.write_bytes(content.replace(b"0", b"1", 1) if path.suffix != ".pcd" else content[:-1] + b"\x41")
        try:
            changed = open_dataset(second).digest
        finally:
            path.write_bytes(content)
        assert changed != digest, path
    small_recording.scan_files(second)[2].unlink()
    assert open_dataset(second).digest != digest


def test_above_the_limit_the_digest_takes_sizes_and_change_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(frames, "HASHED_BYTES", 0)
    root = small_recording.write(tmp_path)
    digest = open_dataset(root).digest
    assert open_dataset(root).digest == digest
    os.utime(small_recording.scan_files(root)[0], ns=(1, 1))
    assert open_dataset(root).digest != digest
    image = small_recording.image_files(root)[1]
    image.write_bytes(image.read_bytes()[:-20])
    assert any("truncated" in warning for warning in open_dataset(root).warnings)


def test_a_reference_comes_back(tmp_path: Path):
    found = open_dataset(small_recording.write(tmp_path / "in"))
    result_folder.write_poses(tmp_path, found, found.scans.world_from_sensor, found.images.world_from_sensor)
    result_folder.write_exposures(tmp_path, found, np.array([2.0, 1, 3, 4, 2]))
    result_folder.write_config(tmp_path, "lidar:\n  voxel_size: 0.5\n")
    reference = read_reference(tmp_path)
    np.testing.assert_allclose(reference.scans.world_from_sensor, found.scans.world_from_sensor, atol=2e-9)
    np.testing.assert_array_equal(reference.images.times, found.images.times)
    np.testing.assert_array_equal(reference.exposures.relative, [1, 0.5, 1.5, 2, 1])
    assert "voxel_size: 0.5" in (tmp_path / "config.yaml").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "config.yaml", "exposures.csv", "image_poses.txt", "in", "lidar_poses.txt"
    ]  # fmt: skip
