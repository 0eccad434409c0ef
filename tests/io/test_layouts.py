"""Other folders than Global-LVBA's that hold the same things."""

from pathlib import Path

import numpy as np
import pytest
import small_recording

from lvba import geometry
from lvba.errors import InputError
from lvba.io import images, tum, velodyne
from lvba.io.dataset import load_image, load_scan, open_dataset
from lvba.trajectory import Trajectory


def test_names_of_folders_as_fast_livo_writes_them(tmp_path: Path):
    plain = small_recording.write(tmp_path / "plain")
    for prefix in ("", "Log"):
        root = tmp_path / f"other{prefix}"
        (root / prefix).mkdir(parents=True)
        (root / "config.yaml").write_text(small_recording.CONFIG)
        (root / prefix / "pcd").symlink_to(plain / "all_pcd_body")
        (root / prefix / "image").symlink_to(plain / "all_image")
        assert open_dataset(root).digest == open_dataset(plain).digest


@pytest.mark.parametrize("start", [0, 1])
def test_numbered_files_take_the_poses_in_order(tmp_path: Path, start: int):
    root = small_recording.write(tmp_path, scans=12, pictures=0)
    expected = open_dataset(root)
    for index, path in enumerate(small_recording.scan_files(root)):
        path.rename(path.with_name(f"{index + start}.pcd"))
    found = open_dataset(root)
    assert [Path(path).stem for path in found.scan_paths] == [str(i + start) for i in range(12)]
    np.testing.assert_array_equal(found.scans.times, expected.scans.times)
    assert len(found.warnings) == 1
    assert "numbered, not timed" in found.warnings[0]


def test_numbered_files_that_are_not_as_many_as_the_poses_are_of_another_clock(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=12, pictures=0)
    for index, path in enumerate(small_recording.scan_files(root)):
        path.rename(path.with_name(f"{index}.pcd"))
    (root / "all_pcd_body" / "11.pcd").unlink()
    with pytest.raises(InputError, match="another clock"):
        open_dataset(root)


CAMERA0_FROM_LIDAR = geometry.from_rotation_translation(small_recording.RCL, np.array([0.01, -0.07, -0.3]))


def _kitti(root: Path, frames: int = 5) -> np.ndarray:
    """Writes a sequence; returns world from camera 0."""
    rng = np.random.default_rng(0)
    (root / "velodyne").mkdir(parents=True)
    (root / "image_2").mkdir()
    times = 0.1 * np.arange(frames)
    poses = small_recording.walk(small_recording.START + times)
    for index in range(frames):
        rng.uniform(-5, 5, (40, 4)).astype("<f4").tofile(root / "velodyne" / f"{index:06d}.bin")
        images.write_image(root / "image_2" / f"{index:06d}.png", rng.integers(0, 255, (24, 32, 3), np.uint8))
    np.savetxt(root / "times.txt", times, "%.6e")
    np.savetxt(root / "poses.txt", poses[:, :3].reshape(-1, 12), "%.12e")
    projection = np.array([[30.0, 0, 16, 30 * 0.06], [0, 30, 12, 0], [0, 0, 1, 0.003]])
    projection[:, 3] = projection[:, :3] @ [0.06, 0.001, 0.003]
    lines = {"P0": projection, "P2": projection, "Tr": CAMERA0_FROM_LIDAR[:3]}
    text = "".join(f"{key}: {' '.join(f'{v:.12e}' for v in value.ravel())}\n" for key, value in lines.items())
    (root / "calib.txt").write_text(text)
    return poses


def test_a_kitti_sequence(tmp_path: Path):
    poses = _kitti(tmp_path)
    found = open_dataset(tmp_path)
    assert found.warnings == ()
    np.testing.assert_allclose(found.scans.world_from_sensor, poses @ CAMERA0_FROM_LIDAR, atol=1e-9)
    camera_from_camera0 = geometry.from_rotation_translation(np.eye(3), np.array([0.06, 0.001, 0.003]))
    expected = poses @ geometry.inverse(camera_from_camera0)
    np.testing.assert_allclose(found.images.world_from_sensor, expected, atol=1e-9)
    np.testing.assert_allclose(
        found.images.world_from_sensor,
        found.scans.world_from_sensor @ geometry.inverse(found.camera_from_scan),
        atol=1e-9,
    )
    assert (found.camera.width, found.camera.fx, found.camera.cy) == (32, 30.0, 12.0)
    raw = np.fromfile(found.scan_paths[2], "<f4").reshape(-1, 4)
    scan = load_scan(found, 2)
    np.testing.assert_array_equal(scan.points, raw[:, :3])
    np.testing.assert_array_equal(scan.intensity, raw[:, 3])
    assert load_image(found, 4).shape == (24, 32, 3)
    assert len(found.digest) == 64


@pytest.mark.parametrize(("folder", "key"), [("image_0", "P0"), ("image_1", "P1"), ("image_3", "P3")])
def test_a_kitti_sequence_of_another_camera(tmp_path: Path, folder: str, key: str):
    poses = _kitti(tmp_path)
    (tmp_path / "image_2").rename(tmp_path / folder)
    for path in (tmp_path / folder).iterdir():
        images.write_image(path, images.read_image(path)[..., 0])
    calibration = tmp_path / "calib.txt"
    offset = {"image_0": 0.0, "image_1": -0.54, "image_3": -0.47}[folder]
    line = f"{key}: 31 0 16 {31 * offset:.6f} 0 31 12 0 0 0 1 0"
    rest = [line for line in calibration.read_text().split("\n") if line[:3] in ("P2:", "Tr:")]
    calibration.write_text("\n".join([line, *rest]))
    found = open_dataset(tmp_path)
    assert (len(found.image_paths), found.camera.fx) == (5, 31.0)
    expected = poses @ geometry.inverse(
        geometry.from_rotation_translation(np.eye(3), np.array([offset, 0, 0]))
    )
    np.testing.assert_allclose(found.images.world_from_sensor, expected, atol=1e-9)
    assert load_image(found, 4).shape == (24, 32, 3)


def test_colors_of_a_kitti_sequence_come_before_gray(tmp_path: Path):
    _kitti(tmp_path)
    before = open_dataset(tmp_path)
    (tmp_path / "image_0").mkdir()
    calibration = tmp_path / "calib.txt"
    calibration.write_text(calibration.read_text().replace("P0:", "P0: not looked at"))
    assert all("image_2" in path for path in open_dataset(tmp_path).image_paths)
    assert len(before.image_paths) == 5


def test_a_kitti_sequence_with_its_poses_where_the_benchmark_has_them(tmp_path: Path):
    root = tmp_path / "sequences" / "07"
    _kitti(root)
    (tmp_path / "poses").mkdir()
    (root / "poses.txt").rename(tmp_path / "poses" / "07.txt")
    (root / "velodyne" / "000003.bin").write_bytes(b"123")
    (root / "image_2" / "000009.png").write_bytes(b"")
    found = open_dataset(root)
    assert (len(found.scan_paths), len(found.image_paths)) == (4, 5)
    assert any("000003.bin" in warning for warning in found.warnings)
    assert any("000009.png" in warning and "beyond the last pose" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    ("name", "old", "new", "where"),
    [
        ("calib.txt", "Tr:", "Tx:", "calib.txt: has no line Tr"),
        ("calib.txt", "P2:", "Px:", "calib.txt: has no line P2"),
        ("calib.txt", "P2: 3", "P2: -3", "calib.txt: a projection is not"),
        ("calib.txt", "Tr: 0", "Tr: x", "calib.txt:3: not only numbers"),
        ("times.txt", "1.000000e-01\n", "nan\n", "times.txt:2: not 1 finite"),
        ("times.txt", "1.000000e-01\n", "5\n", "times.txt: times are not ascending"),
        ("poses.txt", "e+00", "e+01", "poses.txt:1: no rotation"),
        ("poses.txt", None, None, "poses.txt: no poses"),
    ],
)  # fmt: skip
def test_bad_kitti_files_are_named(tmp_path: Path, name: str, old: str | None, new: str | None, where: str):
    _kitti(tmp_path)
    path = tmp_path / name
    if old is None or new is None:
        path.unlink()
    else:
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        open_dataset(tmp_path)
    assert where in str(caught.value)


@pytest.mark.parametrize("size", [0, 15, 33])
def test_bad_bin_files_are_named(tmp_path: Path, size: int):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(size))
    for read in (velodyne.read_bin, velodyne.check_bin):
        with pytest.raises(InputError, match=r"a\.bin"):
            read(path)


def test_a_bin_file_of_nan_is_named_and_some_are_dropped(tmp_path: Path):
    table = np.full((4, 4), np.nan, "<f4")
    table.tofile(tmp_path / "a.bin")
    with pytest.raises(InputError, match="none of its 4 points"):
        velodyne.read_bin(tmp_path / "a.bin")
    table[2] = 1
    table.tofile(tmp_path / "a.bin")
    assert velodyne.read_bin(tmp_path / "a.bin").dropped == 3


def test_an_image_pose_file_can_be_of_another_rate(tmp_path: Path):
    root = small_recording.write(tmp_path)
    times = small_recording.START + np.arange(0, 0.6, 0.02)
    poses = small_recording.walk(times) @ geometry.inverse(small_recording.camera_from_body())
    tum.write_trajectory(root / "all_image" / "image_poses.txt", Trajectory(times, poses))
    found = open_dataset(root)
    expected = small_recording.walk(found.images.times) @ geometry.inverse(found.camera_from_scan)
    np.testing.assert_allclose(found.images.world_from_sensor, expected, atol=1e-5)
