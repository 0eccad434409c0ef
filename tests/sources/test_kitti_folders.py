"""Drives of KITTI raw and KITTI-360: a wall, a mark on it, and a car at known poses, in the files of the data sets."""

import known_view as view
import numpy as np
import pytest
from kitti_writers import DAY, DRIVE, DRIVE_360, START, VELODYNE_FROM_IMU, date, kitti360, kitti_raw, text

from lvba.errors import InputError
from lvba.sources import folders
from lvba.sources.folders.velodyne_sweeps import azimuth_times
from lvba.sources.opening import open_source
from lvba.sources.source import Kind


def check(source, images, poses, sweep_half_ns, world_from_given=None):
    """Scans on the wall, and the mark where images show it; poses are matched by number."""
    records = list(source.records(["velodyne_points", images, poses]))
    known = source.geometry()
    by = {
        name: [record for stream, record in records if stream == name]
        for name in ("velodyne_points", images, poses)
    }
    assert [len(each) for each in by.values()] == [3, 3, 3]
    for scan_record, image, pose in zip(*by.values(), strict=True):
        world_from_lidar = (
            np.eye(4) if world_from_given is None else world_from_given
        ) @ pose.parent_from_child
        assert pose.child == scan_record.frame
        world = scan_record.points @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]
        np.testing.assert_allclose(world[0], view.MARK, atol=1e-5)
        seen = known.camera_from_lidar @ np.append(scan_record.points[0], 1)
        camera = known.camera
        pixel = [camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy]
        np.testing.assert_allclose(view.spot_in(image), pixel, atol=0.2)
        assert image.stamp - scan_record.stamp == sweep_half_ns


def test_kitti_raw_drive(tmp_path):
    drive, first_imu = kitti_raw(tmp_path)
    for path in (drive, drive.parent):
        source = open_source(path)
        world = np.eye(4)
        world[:3, 3] = first_imu[:3, 3]  # the world of the OXTS begins at its first position
        check(source, "image_02", "oxts", 51_000_000, world)
    known = source.geometry()
    assert not known.deskewed
    np.testing.assert_allclose(known.body_from_lidar, np.linalg.inv(VELODYNE_FROM_IMU), atol=1e-9)
    fixes = [record for _, record in source.records(["gnss"])]
    assert (fixes[0].latitude, fixes[0].longitude, fixes[0].altitude) == (49.01, 8.43, 112.0)


@pytest.mark.parametrize("poses", ["poses.txt", "cam0_to_world.txt"])
def test_kitti_360_drive(tmp_path, poses):
    root = kitti360(tmp_path, poses)
    for path in (root, root / "data_3d_raw", root / "data_3d_raw" / DRIVE_360):
        check(open_source(path), "image_00", "poses", 50_000_000)


@pytest.mark.parametrize(
    ("ending", "label"), [(".png", "PNG files, rectified"), (".jpg", "JPEG files, rectified")]
)
def test_images_are_called_what_their_files_are(tmp_path, ending, label):
    drive, _ = kitti_raw(tmp_path / "raw")
    root = kitti360(tmp_path / "360", "poses.txt")
    for folder, images in ((drive, drive / "image_02/data"), (root, root / "data_2d_raw")):
        for file in sorted(images.rglob("*.png")):
            file.rename(file.with_suffix(ending))
        streams = open_source(folder).describe().streams
        assert [stream.message_type for stream in streams if stream.kind is Kind.IMAGES] == [label]


def test_sweeps_are_clockwise_from_behind():
    left_first = np.array([[-1, 1e-9, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-9, 0]], np.float32)
    np.testing.assert_array_equal(azimuth_times(left_first, 100_000_000), np.arange(5) * 25_000_000)


def test_wall_seen_by_a_driving_car_is_flat_by_the_times(tmp_path):
    """Points measured one after the other on the way, as a sweep does, lie on the wall by their times and the speed."""
    speed, sweep_s, wall = np.array([15.0, 0, 0]), 0.1, 5.0
    azimuth = np.radians(np.linspace(179, 1, 80))  # clockwise, along the wall on the left
    seconds = sweep_s * (np.pi - azimuth) / (2 * np.pi)
    origin = seconds[:, None] * speed
    ray = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(80)])
    points = ray * ((wall - origin[:, 1]) / ray[:, 1])[:, None]  # in the frame of the sensor at that time
    world = points + origin
    times = azimuth_times(points.astype(np.float32), 100_000_000) / 1e9
    np.testing.assert_allclose(points + times[:, None] * speed, world, atol=1e-4)


DAMAGES = [
    (kitti_raw, f"{DAY}/calib_cam_to_cam.txt", "R_rect_00: 1 2 3\n", r"calib_cam_to_cam\.txt:1: not 9 finite numbers"),
    (kitti_raw, f"{DAY}/calib_cam_to_cam.txt", "x\n", "has no line P_rect_02"),
    (kitti_raw, f"{DAY}/calib_velo_to_cam.txt", "R: 2 0 0 0 1 0 0 0 1\nT: 0 0 0\n", "no rotation: rows off"),
    (kitti_raw, f"{DAY}/{DRIVE}/velodyne_points/timestamps_start.txt", "monday\n", "is no date"),
    (kitti_raw, f"{DAY}/{DRIVE}/velodyne_points/timestamps_end.txt", date(START) * 3, "the sweep takes"),
    (kitti_raw, f"{DAY}/{DRIVE}/image_02/timestamps.txt", date(START), "has 1 times, but there is file 2"),
    (kitti_raw, f"{DAY}/{DRIVE}/oxts/data/0000000001.txt", "1 2 3", "not 30 finite numbers"),
    (kitti360, "calibration/calib_cam_to_velo.txt", "1 2 3\n", r"calib_cam_to_velo\.txt: 3 numbers instead of 12"),
    (kitti360, "calibration/calib_cam_to_pose.txt", "image_01: 1\n", "has no line image_00"),
    (kitti360, f"data_poses/{DRIVE_360}/poses.txt", f"9 {text(np.eye(4)[:3])}\n", "no time for frame 9"),
    (kitti360, f"data_3d_raw/{DRIVE_360}/velodyne_points/timestamps.txt", "", "is empty"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "name", "content", "message"), DAMAGES)
def test_a_damaged_drive_is_refused_in_one_line(tmp_path, make, name, content, message):
    made = make(tmp_path)
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        folders.find(made[0] if isinstance(made, tuple) else made)


def test_calibration_of_the_day_is_asked_for(tmp_path):
    drive, _ = kitti_raw(tmp_path)
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(InputError, match="unpack the calibration of the day"):
        folders.find(drive)


def test_one_of_several_drives_must_be_given(tmp_path):
    root = kitti360(tmp_path)
    (root / "data_3d_raw/other/velodyne_points").mkdir(parents=True)
    with pytest.raises(InputError, match="has 2 drives"):
        folders.find(root)
