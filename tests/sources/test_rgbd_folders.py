"""Folders of depth cameras and phones: one wall and one mark on it, written as each program does, must come back."""

from pathlib import Path

import cv2
import known_view as view
import numpy as np
import pytest
import rgbd_writers as writers

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io.dataset import open_dataset
from lvba.sources import folders
from lvba.sources.folders.depth_scans import DepthCamera
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions
from lvba.sources.opening import open_source
from lvba.sources.source import Kind

CASES = {
    "polycam": (writers.polycam, "depth", "images", "poses", 1e-3, 0.3),
    "record3d": (writers.record3d, "depth", "images", "poses", 2e-4, 0.3),
    "tum": (writers.tum, "depth", "rgb", "groundtruth", 2e-4, 0.2),
    "replica": (writers.replica, "depth", "images", "poses", 2e-4, 0.3),
    "scannet": (writers.scannet, "depth", "color", "pose", 1e-3, 0.3),
    "7-scenes": (writers.seven_scenes, "depth", "color", "pose", 1e-3, 0.3),
    "bundle fusion": (writers.bundle_fusion, "depth", "color", "pose", 1e-3, 0.3),
    "stray": (writers.stray, "depth", "rgb", "odometry", 1e-3, 0.5),
}


@pytest.mark.parametrize("name", CASES)
def test_points_and_pixels_are_where_the_wall_and_the_mark_are(tmp_path, name):
    write, scans, images, poses, resolution_m, pixel = CASES[name]
    write(tmp_path)
    source = open_source(tmp_path)
    view.check(source, scans, images, poses, resolution_m, pixel)
    known = source.geometry()
    assert known.deskewed
    described = {stream.name: stream for stream in source.describe().streams}
    assert described[scans].kind is Kind.SCANS
    assert described[scans].count == 4
    assert source.describe().size > 1000


LABELS = [
    (writers.tum, "rgb/?.png", "rgb", {".jpg": "JPEG files", ".png": "PNG files"}),
    (writers.scannet, "color/*.jpg", "color", {".png": "PNG files", ".jpeg": "JPEG files"}),
    (writers.seven_scenes, "*.color.png", "color", {".jpg": "JPEG files", ".png": "PNG files"}),
    (writers.replica, "results/frame*.jpg", "images", {".png": "PNG files", ".jpg": "JPEG files"}),
    (writers.record3d, "rgbd/*.jpg", "images", {".png": "PNG files", ".jpg": "JPEG files"}),
]


@pytest.mark.parametrize(("write", "images", "stream", "labels"), LABELS)
def test_images_are_called_what_their_files_are(tmp_path, write, images, stream, labels):
    for ending, label in labels.items():
        folder = tmp_path / ending
        folder.mkdir()
        write(folder)
        for file in sorted(folder.glob(images)):
            writers.png(file.with_suffix(ending), cv2.imread(str(file)))
            if file.suffix != ending:
                file.unlink()
        if (folder / "rgb.txt").exists():
            names = (folder / "rgb.txt").read_text().replace(".png", ending)
            (folder / "rgb.txt").write_text(names)
        described = {each.name: each for each in open_source(folder).describe().streams}
        assert described[stream].message_type == label


def test_tum_times_keep_all_digits(tmp_path):
    writers.tum(tmp_path)
    stream = folders.find(tmp_path).describe().streams[0]
    assert stream.first == 1305031453_359684000


def test_tum_numbers_of_frames_are_thirtieths_of_a_second(tmp_path):
    writers.tum(tmp_path, counted=True)
    source = folders.find(tmp_path)
    assert [record.stamp for _, record in source.records(["depth"])] == [0, 33333333, 66666666, 100000000]
    assert any("30 frames a second" in note for note in source.describe().notes)


def test_registered_depth_leaves_no_question_of_the_extrinsic(tmp_path):
    writers.tum(tmp_path / "tum")
    report = import_source(open_source(tmp_path / "tum"), tmp_path / "out")
    assert report.facts["conventions"]["extrinsic"]["by"] == "only"
    assert not any(words.startswith("extrinsic") for words in report.warnings)


def test_tum_depth_counts_what_the_camera_file_says(tmp_path):
    writers.tum(tmp_path, units=1000, factor={"RGBD.DepthMapFactor": 1000.0})
    source = open_source(tmp_path)
    view.check(source, "depth", "rgb", "groundtruth", 1e-3, 0.2)
    assert any("1000 a meter, by RGBD.DepthMapFactor" in note for note in source.describe().notes)
    writers.tum(tmp_path, factor={"DepthMapFactor": "many"})
    with pytest.raises(InputError, match=r"camera\.yaml: DepthMapFactor is 'many'"):
        open_source(tmp_path)


@pytest.mark.parametrize(("version", "factor"), [(0, "DepthMapFactor"), (1, "RGBD.DepthMapFactor")])
def test_settings_of_orb_slam_are_a_camera_file_of_the_tum_layout(tmp_path, version, factor):
    writers.tum(tmp_path, units=1000)
    name = "Camera1" if version else "Camera"
    lines = ["%YAML:1.0", 'Camera.type: "PinHole"', f"{factor}: 1000.0", "Viewer.PointSize:2"]
    values = (*writers.FOCAL, *writers.CENTER)
    lines += [f"{name}.{key}: {value}" for key, value in zip(("fx", "fy", "cx", "cy"), values, strict=True)]
    lines.append("LEFT.K: 1")
    (tmp_path / "camera.yaml").write_text("\n".join(lines))
    source = open_source(tmp_path)
    view.check(source, "depth", "rgb", "groundtruth", 1e-3, 0.2)
    notes = source.describe().notes
    assert any(f"1000 a meter, by {factor}" in note for note in notes)
    assert any("are of images that ORB-SLAM rectifies by LEFT.K" in note for note in notes)


def test_settings_of_orb_slam_are_a_calibration_to_import_with(tmp_path):
    """The size of the images is in no such file."""
    writers.tum(tmp_path / "tum")
    (tmp_path / "orb.yaml").write_text(
        "%YAML:1.0\nCamera.fx: 60.5\nCamera.fy: 61.5\nCamera.cx: 31.5\nCamera.cy: 24.0\nCamera.k1: 0.01\n"
    )
    options = ImportOptions(calibration=(str(tmp_path / "orb.yaml"),))
    import_source(open_source(tmp_path / "tum"), tmp_path / "out", options)
    camera = open_dataset(tmp_path / "out").camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (*writers.SIZE, 60.5, 24.0)
    assert camera.distortion[0] == 0.01


def test_benchmark_sequences_have_their_cameras_by_name(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_rpy"
    writers.tum(folder)
    (folder / "camera.yaml").unlink()
    with pytest.raises(InputError, match=r"camera\.yaml there"):  # 64 x 48 px are no images of a Kinect
        folders.find(folder)
    for file in (folder / "rgb").iterdir():
        writers.png(file, np.zeros((480, 640, 3), np.uint8))
    camera = folders.find(folder).geometry().camera
    assert (camera.fx, camera.distortion[4]) == (517.306408, 1.163314)


def test_points_that_the_phone_does_not_trust_are_left_out(tmp_path):
    writers.stray(tmp_path)
    source = folders.find(tmp_path)
    scan = next(record for _, record in source.records(["depth"]))
    assert len(scan.points) == (writers.SMALL[0] - 1) * writers.SMALL[1]
    _, reading = next(source.records(["imu"]))
    np.testing.assert_array_equal(reading.gyroscope, [0.1, 0.2, 0.3])


def test_lost_poses_of_scannet_are_left_out_and_told(tmp_path):
    writers.scannet(tmp_path)
    assert "1 of 5 poses are not finite" in " ".join(folders.find(tmp_path).describe().notes)


def test_lost_poses_of_numbered_frames_and_pixels_that_say_nothing_are_left_out(tmp_path):
    writers.seven_scenes(tmp_path)
    source = folders.find(tmp_path)
    assert "1 of 5 poses are not finite" in " ".join(source.describe().notes)
    scan = next(record for _, record in source.records(["depth"]))
    assert len(scan.points) == writers.SMALL[0] * writers.SMALL[1] - 2


def test_a_kinect_without_calibration_has_the_usual_one_and_says_so(tmp_path):
    writers.seven_scenes(tmp_path)
    for name in ("camera.yaml", "camera-intrinsics.txt"):
        (tmp_path / name).unlink()
    with pytest.raises(InputError, match="are not those of a Kinect"):
        folders.find(tmp_path)
    for file in tmp_path.glob("*.png"):
        channels = (3,) if "color" in file.name else ()
        writers.png(file, np.ones((480, 640, *channels), np.uint8 if channels else np.uint16))
    source = folders.find(tmp_path)
    known = source.geometry()
    assert known.camera.fx == 525
    np.testing.assert_allclose(known.camera_from_lidar[:3, 3], [-0.025, 0, 0])
    assert "as of any Kinect: no file has it" in " ".join(source.describe().notes)


def test_one_damaged_depth_image_is_counted_and_most_are_an_error(tmp_path):
    writers.tum(tmp_path)
    whole = (tmp_path / "depth/1.png").read_bytes()
    (tmp_path / "depth/1.png").write_bytes(whole[: len(whole) // 2])
    source = folders.find(tmp_path)
    assert len(list(source.records(["depth"]))) == 3
    assert "1 of 4 records of depth could not be decoded" in source.losses()[0]
    for i in (0, 2):
        (tmp_path / f"depth/{i}.png").write_bytes(whole[:100])
    with pytest.raises(InputError, match=r"depth/0\.png"):
        list(source.records(["depth"]))


DAMAGES = [
    (writers.polycam, "keyframes/corrected_cameras/100.json", "{", r"100\.json: not JSON"),
    (writers.polycam, "keyframes/corrected_cameras/100.json", '{"t_00": 1}', r"100\.json: t_01 is no number"),
    (writers.record3d, "metadata", "[]", "metadata: holds no names"),
    (
        writers.record3d,
        "metadata",
        '{"w": 64, "h": 48, "dw": 32, "dh": 24, "K": [1]}',
        "metadata: K: not 9 finite numbers",
    ),
    (
        writers.record3d,
        "rgbd/0.depth",
        "bvx2....",
        r"0\.depth: is compressed by LZFSE, which is not read; decompress",
    ),
    (writers.tum, "rgb.txt", "x rgb/0.png\n", r"rgb\.txt:1: 'x' is no time"),
    (writers.tum, "depth.txt", "1.0\n", r"depth\.txt:1: 1 words instead of 2"),
    (writers.tum, "groundtruth.txt", "1 2 3\n", r"groundtruth\.txt:1"),
    (writers.tum, "rgb.txt", "# none\n", "names no files"),
    (writers.tum, "rgb.txt", "0.001 rgb/0.png\n0.0012 rgb/1.png\n", r"rgb\.txt: times are 0\.2 ms apart"),
    (writers.replica, "traj.txt", "1 2\n", r"traj\.txt:1: not 16 finite numbers"),
    (writers.replica, "traj.txt", " ".join(["0"] * 16) + "\n", "no rotation"),
    (writers.replica, "cam_params.json", "{}", "has no section camera"),
    (writers.replica, "cam_params.json", '{"camera": {"w": 64}}', r"camera\.h is no number"),
    (writers.scannet, "intrinsic/intrinsic_depth.txt", "1 2 3\n", r"intrinsic_depth\.txt"),
    (
        writers.scannet,
        "intrinsic/extrinsic_color.txt",
        writers.matrix_text(np.diag([2.0, 1, 1, 1])),
        "is not the identity",
    ),
    (writers.scannet, "pose/9.txt", "1 2\n", r"9\.txt: is no 4x4 matrix"),
    (writers.seven_scenes, "camera-intrinsics.txt", "1 2\n", r"camera-intrinsics\.txt: is no 3x3 matrix"),
    (writers.seven_scenes, "camera.yaml", "x: 1\n", r"camera\.yaml"),
    (writers.seven_scenes, "frame-000009.pose.txt", "1 2\n", r"000009\.pose\.txt: is no 4x4 matrix"),
    (writers.bundle_fusion, "info.txt", "m_depthShift = 1000\n", r"info\.txt: not 16 finite numbers"),
    (writers.stray, "odometry.csv", "1, 2\n", r"odometry\.csv:1: not 9 finite numbers"),
    (writers.stray, "odometry.csv", "1, 0, 0, 0, 0, 0, 0, 0, 3\n", "length 3 instead of 1"),
    (writers.stray, "camera_matrix.csv", "1, 2, 3\n", r"camera_matrix\.csv: is no 3x3 matrix"),
    (writers.stray, "rgb.mp4", "no video", r"rgb\.mp4: is no video"),
]


@pytest.mark.parametrize(("write", "name", "text", "message"), DAMAGES)
def test_a_damaged_folder_is_refused_in_one_line(tmp_path, write, name, text, message):
    write(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as error:
        folders.find(tmp_path)
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize(
    ("write", "names"),
    [
        (writers.tum, ("depth/0.png", "rgb/0.png")),
        (writers.scannet, ("depth/9.png", "color/9.jpg")),
        (writers.seven_scenes, ("frame-000009.depth.png", "frame-000009.color.png")),
        (writers.stray, ("depth/000000.png",)),
    ],
)
def test_a_first_image_that_is_damaged_is_one_of_many(tmp_path, write, names):
    write(tmp_path)
    for name in names:
        (tmp_path / name).write_bytes(b"")
    source = folders.find(tmp_path)
    assert len(list(source.records(["depth"]))) == 3
    assert "1 of 4 records of depth could not be decoded" in source.losses()[0]


def test_other_folders_are_none(tmp_path):
    assert folders.find(tmp_path) is None
    assert folders.find(tmp_path / "missing") is None


@pytest.mark.parametrize(("size", "step"), [((320, 320), 1), ((640, 480), 2), ((1280, 720), 3)])
def test_of_large_depth_images_some_rows_and_columns_become_points(size, step):
    camera = Camera(width=size[0], height=size[1], fx=500.0, fy=500.0, cx=size[0] / 2, cy=size[1] / 2)
    values = np.zeros((size[1], size[0]), np.uint16)
    row, column = 7 * step + step // 2, 5 * step + step // 2
    values[row, column] = 2000
    scan = DepthCamera(camera, 1e-3).scan_of(Path("d.png"), values, 0)
    told = {1: "", 2: "every second row", 3: "every third row"}[step]
    assert "".join(DepthCamera(camera, 1).notes).startswith(told)
    assert bool(DepthCamera(camera, 1).notes) == (step > 1)
    assert scan.points == pytest.approx(
        np.array([[2 * (column - camera.cx) / 500, 2 * (row - camera.cy) / 500, 2]])
    )
    assert scan.rows.tolist() == [row]
    full = DepthCamera(camera, 1e-3).scan_of(Path("d.png"), np.full_like(values, 1000), 0)
    assert len(full.points) == len(range(step // 2, size[0], step)) * len(range(step // 2, size[1], step))
    assert len(full.points) <= 1.01 * 102_400
