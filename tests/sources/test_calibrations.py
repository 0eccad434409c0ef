"""Calibration files of other programs: the same camera in all of them is the same camera."""

import copy

import calibration_writers as writers
import cv2
import numpy as np
import pycolmap
import pytest
import surveys
import yaml

from lvba import geometry, lens
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import calibration as result_calibration
from lvba.io.image_header import ImageSize
from lvba.lens import Lens
from lvba.sources import calibrations
from lvba.sources.importing import rig
from lvba.sources.importing.options import Guess
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.source import KnownGeometry

CAMERA_FROM_LIDAR = geometry.from_rotation_translation(
    geometry.exp(np.array([0.02, -0.01, 0.03, 0, 0, 0]))[:3, :3]
    @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    np.array([0.05, 0.07, -0.06]),
)
BODY_FROM_LIDAR = geometry.exp(np.array([0.3, -0.2, 1.0, 0, 0, 0]))
BODY_FROM_LIDAR[:3, 3] = [0.04165, 0.02326, -0.0284]
POINTS = np.random.default_rng(3).uniform([-2, -1.5, 2], [2, 1.5, 8], (200, 3))
RADIAL = (-0.108, 0.105, -1.2872e-4, 5.7923e-5)
RADIAL_5 = (*RADIAL, -0.0222)
FISHEYE = (-0.0370, -0.0089, 0.0089, -0.0038)
ORB = "Camera.fx: 500\nCamera.fy: 500\nCamera.cx: 320\nCamera.cy: 240\n"
VINS = "image_width: 640\nimage_height: 480\nprojection_parameters: {fx: 500, fy: 500, cx: 320, cy: 240}\n"
EYE = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]"
ALL = (
    *(writers.fast_livo, writers.r3live, writers.kalibr, writers.openvins, writers.m2mapping),
    *(writers.spires, writers.dvlc, writers.opencv, writers.colmap, writers.orb_slam, writers.orb_slam2),
    *(writers.vins, writers.ntu_viral, writers.euroc),
)
ONLY_CAMERA = (writers.opencv, writers.colmap)
CASES = [
    *((writer, RADIAL, False) for writer in ALL),
    *((writer, FISHEYE, True) for writer in ALL if writer is not writers.r3live),
    *((writer, RADIAL_5, False) for writer in ALL),
]


def pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    u, v = lens.distort(
        camera.lens, camera.distortion, points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    )
    return np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1)


def expected_pixels(coefficients, fisheye) -> np.ndarray:
    """By OpenCV."""
    fx, fy, cx, cy = writers.FOCAL
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    zero = np.zeros((1, 1, 3))
    if fisheye:
        projected, _ = project(POINTS[:, None], zero, zero, matrix, np.array(coefficients))
    else:
        projected, _ = project(POINTS[:, None], zero, zero, matrix, np.array(coefficients))
    return projected[:, 0]


@pytest.mark.parametrize(("writer", "coefficients", "fisheye"), CASES)
def test_the_same_camera_has_the_same_pixels_in_all_formats(tmp_path, writer, coefficients, fisheye):
    path = writer(tmp_path, coefficients, fisheye, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    rig = calibrations.read([path])
    camera = rig.camera_for(ImageSize(writers.WIDTH, writers.HEIGHT))
    np.testing.assert_allclose(
        pixels(camera, POINTS), expected_pixels(coefficients, fisheye), rtol=0, atol=1e-9
    )
    assert (camera.width, camera.height) == (writers.WIDTH, writers.HEIGHT)
    assert rig.origins["camera"] == str(path)


@pytest.mark.parametrize("writer", [writer for writer in ALL if writer not in ONLY_CAMERA])
def test_extrinsics_have_the_direction_of_their_format(tmp_path, writer):
    body = tmp_path / "body.yaml"
    body.write_text(
        yaml.safe_dump(
            {
                "extrinsic_R": writers.flat(BODY_FROM_LIDAR[:3, :3]),
                "extrinsic_T": writers.flat(BODY_FROM_LIDAR[:3, 3]),
            }
        )
    )
    path = writer(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    rig = calibrations.read([path, body])
    np.testing.assert_allclose(rig.camera_from_lidar, CAMERA_FROM_LIDAR, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rig.body_from_lidar, BODY_FROM_LIDAR, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        rig.body_from_camera, BODY_FROM_LIDAR @ geometry.inverse(CAMERA_FROM_LIDAR), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("known", ["transforms", "preset"])
def test_a_camera_on_the_imu_is_on_the_lidar_by_where_the_imu_is(tmp_path, known):
    path = writers.euroc(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    stamps, nothing = np.arange(2), np.zeros((0, 3))
    imu = ImuReadings(np.zeros(0), nothing, nothing) if known == "transforms" else None
    static = {("imu", "lidar"): BODY_FROM_LIDAR} if known == "transforms" else {}
    size = (writers.WIDTH, writers.HEIGHT)
    frames = {"lidar_frame": "lidar", "image_frame": "camera", "imu_frame": "imu"}
    surveyed = surveys.survey(stamps, stamps, imu=imu, image_size=size, static=static, **frames)
    guess = Guess() if static else Guess(by="preset x", imu_from_lidar=BODY_FROM_LIDAR)
    facts = rig.gather((str(path),), KnownGeometry(), surveyed, "/cam0", guess=guess)
    np.testing.assert_allclose(facts.camera_from_lidar, CAMERA_FROM_LIDAR, rtol=0, atol=1e-9)
    assert facts.origins["camera_from_lidar"] == f"{path}, {'static transforms' if static else 'preset x'}"


def test_vins_may_do_without_an_extrinsic(tmp_path):
    path = writers.vins(tmp_path, FISHEYE, True, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    path.write_text(path.read_text().replace("estimate_extrinsic: 0", "estimate_extrinsic: 2"))
    assert calibrations.read([path]).body_from_camera is None


def test_orb_slam_need_not_say_the_size_of_its_images(tmp_path):
    path = writers.orb_slam2(tmp_path, RADIAL_5, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    rig = calibrations.read([path])
    assert (rig.camera.width, rig.camera.height) == (0, 0)
    with pytest.raises(InputError, match=r"orb_slam2\.yaml: the principal point .* is not near the middle"):
        rig.camera_for(ImageSize(640, 480))


def test_the_second_camera_of_orb_slam_is_beside_the_first(tmp_path):
    path = writers.orb_slam(tmp_path, FISHEYE, True, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    first_from_second = geometry.exp(np.array([0.01, 0.02, -0.01, 0.11, 0.0, 0.0]))
    one = path.read_text()
    second = "".join(
        f"{line}\n".replace("Camera1", "Camera2") for line in one.split("\n") if "Camera1." in line
    )
    path.write_text(f"{one}{second}Stereo.T_c1_c2: {writers.opencv_matrix(first_from_second, '   ')}\n")
    with pytest.raises(InputError, match="has 2 cameras: Camera1, Camera2"):
        calibrations.read([path])
    body_from_first = BODY_FROM_LIDAR @ geometry.inverse(CAMERA_FROM_LIDAR)
    for name, expected in (("Camera1", body_from_first), ("Camera2", body_from_first @ first_from_second)):
        np.testing.assert_allclose(
            calibrations.read([path], name).body_from_camera, expected, rtol=0, atol=1e-9
        )


def test_rectification_of_orb_slam_is_a_note(tmp_path):
    path = writers.orb_slam2(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    path.write_text(f"{path.read_text()}LEFT.K: {writers.opencv_matrix(np.eye(3), '   ')}\n")
    [note] = calibrations.read([path]).notes
    assert "rectifies by LEFT.K" in note


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_PINHOLE", [500, 321, 239]),
        ("PINHOLE", [500, 510, 321, 239]),
        ("SIMPLE_RADIAL", [500, 321, 239, -0.1]),
        ("RADIAL", [500, 321, 239, -0.1, 0.02]),
        ("OPENCV", [500, 510, 321, 239, -0.1, 0.02, 1e-3, -2e-3]),
        ("OPENCV_FISHEYE", [500, 510, 321, 239, -0.03, 0.01, -2e-3, 1e-3]),
        ("FULL_OPENCV", [500, 510, 321, 239, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, -0.01, 3e-3]),
        ("SIMPLE_RADIAL_FISHEYE", [500, 321, 239, -0.03]),
        ("RADIAL_FISHEYE", [500, 321, 239, -0.03, 0.01]),
    ],
)
def test_models_of_colmap_have_the_pixels_that_colmap_has(tmp_path, model, parameters):
    path = tmp_path / "cameras.txt"
    path.write_text(f"7 {model} 640 480 {' '.join(map(str, parameters))}\n")
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=parameters)
    expected = np.array([theirs.img_from_cam(point) for point in POINTS]) - 0.5
    ours = pixels(calibrations.read([path]).camera, POINTS)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-9)


def test_kalibr_shift_is_added_to_image_stamps(tmp_path):
    path = writers.kalibr(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR, shift=-0.02)
    rig = calibrations.read([path])
    assert (rig.camera_time_offset_s, rig.clock) == (-0.02, "IMU")  # t_imu = t_cam + shift


def test_fast_livo_offset_is_added_to_image_stamps_and_zero_says_nothing(tmp_path):
    for offset, expected in ((0.1, 0.1), (0.0, None)):
        path = tmp_path / "a.yaml"
        path.write_text(
            "common: {img_topic: /left}\n"
            "extrin_calib: {extrinsic_T: [0, 0, 0], extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
            f"time_offset: {{img_time_offset: {offset}, lidar_time_offset: -0.1, imu_time_offset: 0}}\n"
        )
        rig = calibrations.read([path])
        assert (rig.camera_time_offset_s, rig.topic) == (expected, "/left")
        assert "lidar_time_offset is -0.1 s" in rig.notes[0]


def test_one_of_several_cameras_is_asked_for_by_name_or_topic(tmp_path):
    path = writers.kalibr(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    document = yaml.safe_load(path.read_text())
    step = geometry.exp(np.array([0.01, 0.02, 0, -0.11, 0, 0]))
    second = copy.deepcopy(document["cam0"]) | {
        "rostopic": "/cam1/image_raw",
        "T_cn_cnm1": writers.rows(step),
    }
    second["intrinsics"] = [900.0, 901.0, 640.0, 512.0]
    del second["T_cam_imu"]
    path.write_text(yaml.safe_dump(document | {"cam1": second}))
    with pytest.raises(InputError, match=r"has 2 cameras: cam0 \(/cam0/image_raw\), cam1"):
        calibrations.read([path])
    with pytest.raises(InputError, match="has no camera 'cam9'"):
        calibrations.read([path], "cam9")
    camera_from_body = CAMERA_FROM_LIDAR @ geometry.inverse(BODY_FROM_LIDAR)
    for name in ("cam1", "/cam1/image_raw", "/cam1/image_raw/compressed"):
        rig = calibrations.read([path], name)
        assert rig.camera.fx == 900
        np.testing.assert_allclose(
            geometry.inverse(rig.body_from_camera), step @ camera_from_body, atol=1e-12
        )


def test_cameras_of_kalibr_may_lie_below_another_name(tmp_path):
    path = writers.kalibr(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    path.write_text(yaml.safe_dump({"stereo0": yaml.safe_load(path.read_text())}))
    np.testing.assert_allclose(
        pixels(calibrations.read([path]).camera, POINTS), expected_pixels(RADIAL, False), atol=1e-9
    )


def test_cameras_without_topics_are_found_by_their_names_in_the_topic(tmp_path):
    path = writers.kalibr(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    document = yaml.safe_load(path.read_text())
    del document["cam0"]["rostopic"]
    document["cam1"] = copy.deepcopy(document["cam0"]) | {"intrinsics": [900.0, 901.0, 640.0, 512.0]}
    path.write_text(yaml.safe_dump(document))
    assert calibrations.read([path], "/rig/cam1/image_raw").camera.fx == 900
    with pytest.raises(InputError, match="has no camera '/rig/left'"):
        calibrations.read([path], "/rig/left")


def test_omni_livo_list_has_a_place_for_each_camera(tmp_path):
    path = tmp_path / "omni.yaml"
    other = geometry.exp(np.array([0.1, 0, 0, 0.2, 0, 0])) @ CAMERA_FROM_LIDAR
    cameras = [
        {"cam_id": i, "img_topic": f"/c{i}", "Rcl": writers.flat(t[:3, :3]), "Pcl": writers.flat(t[:3, 3])}
        for i, t in enumerate((CAMERA_FROM_LIDAR, other))
    ]
    body = {
        "extrinsic_T": writers.flat(BODY_FROM_LIDAR[:3, 3]),
        "extrinsic_R": writers.flat(BODY_FROM_LIDAR[:3, :3]),
    }
    path.write_text(yaml.safe_dump({"extrin_calib": body | {"cameras": cameras}}))
    np.testing.assert_allclose(calibrations.read([path], "/c1").camera_from_lidar, other, atol=1e-12)
    np.testing.assert_allclose(calibrations.read([path], "cam0").body_from_lidar, BODY_FROM_LIDAR, atol=1e-12)


def test_t_cam_lidar_takes_the_lidar_to_the_camera(tmp_path):
    path = writers.write(
        tmp_path / "cam-lidar-imu.yaml", {"cam0_lidar": {"T_cam_lidar": writers.rows(CAMERA_FROM_LIDAR)}}
    )
    np.testing.assert_allclose(calibrations.read([path]).camera_from_lidar, CAMERA_FROM_LIDAR, atol=1e-12)


def test_calibration_of_a_result_is_read_again(tmp_path):
    camera = Camera(640, 480, 500.5, 501.5, 320.25, 239.75, FISHEYE, Lens.EQUIDISTANT)
    result_calibration.write(tmp_path, camera, CAMERA_FROM_LIDAR, 0.004, 0.0, {})
    rig = calibrations.read([tmp_path / "calibration.yaml"])
    assert rig.camera == camera
    np.testing.assert_allclose(rig.body_from_camera, geometry.inverse(CAMERA_FROM_LIDAR), atol=1e-12)
    assert (rig.camera_time_offset_s, rig.clock) == (0.004, "LiDAR")


def test_a_clock_that_loses_is_in_the_calibration_of_a_result(tmp_path):
    camera = Camera(640, 480, 500.5, 501.5, 320.25, 239.75)
    result_calibration.write(tmp_path, camera, CAMERA_FROM_LIDAR, 0.004, 0.0, {}, clock=(1e-3, 1.7e9))
    path = tmp_path / "calibration.yaml"
    facts = yaml.safe_load(path.read_text())
    assert (facts["clock_rate"], facts["clock_epoch_s"]) == (1e-3, 1.7e9)
    assert "time_offset_s + clock_rate * (image time - clock_epoch_s) = LiDAR time" in path.read_text()
    assert calibrations.read([path]).camera_time_offset_s == 0.004


def test_images_may_be_scaled_by_one_factor_only(tmp_path):
    rig = calibrations.read([writers.fast_livo(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)])
    half = rig.camera_for(ImageSize(640, 512))
    np.testing.assert_allclose(pixels(half, POINTS), (pixels(rig.camera, POINTS) + 0.5) / 2 - 0.5, atol=1e-9)
    with pytest.raises(InputError, match="1280 x 1024, but the images are 640 x 480"):
        rig.camera_for(ImageSize(640, 480))


def test_principal_point_must_fit_images_whose_size_no_file_says(tmp_path):
    rig = calibrations.read([writers.dvlc(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)])
    with pytest.raises(InputError, match="is not near the middle of 640 x 512"):
        rig.camera_for(ImageSize(640, 512))


def test_files_that_say_the_same_are_merged_and_others_refused(tmp_path):
    first = writers.fast_livo(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    same = writers.dvlc(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    rig = calibrations.read([same, first])
    assert rig.camera.width == writers.WIDTH
    assert rig.origins["camera_from_lidar"] == str(same)
    inverse = writers.dvlc(tmp_path, RADIAL, False, geometry.inverse(CAMERA_FROM_LIDAR), BODY_FROM_LIDAR)
    with pytest.raises(InputError, match=r"calib.json: says another camera_from_lidar than .*its inverse"):
        calibrations.read([first, inverse])
    other = writers.opencv(tmp_path, FISHEYE, False, None, None)
    with pytest.raises(InputError, match=r"opencv\.yaml: says another camera than"):
        calibrations.read([first, other])


def test_three_extrinsics_must_close(tmp_path):
    first = writers.fast_livo(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    turned = geometry.exp(np.array([0.02, 0, 0, 0, 0, 0]))
    second = writers.kalibr(tmp_path, RADIAL, False, turned @ CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    with pytest.raises(InputError, match=r"do not make body_from_lidar .*1\.15 degrees"):
        calibrations.read([first, second])
    near = geometry.exp(np.array([0.002, 0, 0, 0, 0, 0]))
    writers.kalibr(tmp_path, RADIAL, False, near @ CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    np.testing.assert_allclose(
        calibrations.read([first, second]).camera_from_lidar, CAMERA_FROM_LIDAR, atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(camera_model="omni"), r"'omni' \(omnidirectional \(Mei\)\) cannot be used; undistort"),
        (dict(camera_model="ds"), "double sphere"),
        (dict(camera_model="eucm"), "EUCM"),
        (dict(distortion_model="fov"), "FOV"),
        (dict(intrinsics=[500.0, 500.0, 320.0]), "cam0.intrinsics is not 4 finite numbers"),
        (dict(intrinsics=[float("nan"), 500.0, 320.0, 240.0]), "cam0.intrinsics is not 4 finite numbers"),
        (dict(resolution=None), "cam0.resolution is missing"),
        (
            dict(T_cam_imu=writers.rows(np.diag([1.0, 1, -1, 1]))),
            "cam0.T_cam_imu is no rotation: a reflection",
        ),
        (
            dict(T_cam_imu=writers.rows(np.diag([1.0, 1.1, 1, 1]))),
            "cam0.T_cam_imu is no rotation: rows are off",
        ),
        (dict(T_cam_imu=writers.rows(geometry.inverse(CAMERA_FROM_LIDAR).T)), "last row of cam0.T_cam_imu"),
        (dict(T_cam_imu=[[1, 0], [0, 1]]), "cam0.T_cam_imu is not 16 or 12 finite numbers"),
        (dict(timeshift_cam_imu=1e9), "write seconds"),
        (dict(T_imu_cam=writers.rows(np.eye(4))), "cam0.T_cam_imu is not the inverse of cam0.T_imu_cam"),
    ],
)
def test_what_is_wrong_in_a_file_of_kalibr_is_said_in_one_line(tmp_path, change, message):
    path = writers.kalibr(tmp_path, RADIAL, False, CAMERA_FROM_LIDAR, BODY_FROM_LIDAR)
    document = yaml.safe_load(path.read_text())
    document["cam0"].update(change)
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=message) as error:
        calibrations.read([path])
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras.txt", "1 THIN_PRISM_FISHEYE 640 480 1 2 3\n", r"cameras.txt:1: .*thin prism"),
        ("cameras.txt", "1 FOV 640 480 500 500 320 240 0.9\n", "FOV"),
        ("cameras.txt", "1 OPENCV 640 480 500 500 320 240\n", "OPENCV with 8 parameters"),
        ("cameras.txt", "1 PINHOLE 640 480 500 inf 320 240\n", "finite numbers"),
        ("cameras.txt", "# nothing\n", "holds no camera"),
        ("calib.json", "{", "not JSON"),
        ("calib.json", "[]", "holds no names with values"),
        ("calib.json", "{}", "has no section camera"),
        ("calib.json", '{"camera": {"camera_model": "equirectangular"}}', "equirectangular"),
        (
            "calib.json",
            '{"camera": {"camera_model": "plumb_bob", "intrinsics": [500, 500, 320, 240]}, '
            '"results": {"T_lidar_camera": [0, 0, 0, 0, 0, 0, 2]}}',
            "length 2 instead of 1",
        ),
        ("a.yaml", "gyroscope_noise_density: 0.1\n", "neither a camera nor an extrinsic"),
        ("a.yaml", "Camera.fx: 500\nCamera.fy: 500\nCamera.cx: 320\n", "Camera.cy is missing"),
        ("a.yaml", f"{ORB}Camera.width: 640\n", "Camera.height is missing"),
        ("a.yaml", f"{ORB}Camera.width: wide\nCamera.height: 480\n", "Camera.width is not 1 finite numbers"),
        ("a.yaml", f"{ORB}Camera.k4: 0.1\n", "Camera.k4 is not a parameter of a PinHole camera"),
        (
            "a.yaml",
            f"{ORB}Camera.type: KannalaBrandt8\nCamera.p1: 0.1\n",
            "Camera.p1 is not a parameter of a Kannala",
        ),
        ("a.yaml", f"{ORB}Camera.type: Omni\n", "the camera model 'Omni' .*cannot be used"),
        ("a.yaml", f"{ORB}Tbc: [1, 2]\n", "Tbc is not 16 or 12 finite numbers"),
        (
            "a.yaml",
            f"{VINS}model_type: MEI\nmirror_parameters: {{xi: 1.2}}\n",
            "the camera model 'MEI' is not known",
        ),
        (
            "a.yaml",
            f"{VINS}model_type: PINHOLE\nprojection_parameters: {{mu: 1}}\n",
            "projection_parameters.mu is not",
        ),
        ("a.yaml", f"{VINS}T_Body_Cam: [1]\n", "T_Body_Cam is not 16 or 12 finite numbers"),
        (
            "a.yaml",
            f"{VINS}T_Body_Cam: {EYE}\nT_BS: {EYE}\nsensor_type: camera\n",
            "says 2 times where a camera is",
        ),
        ("a.yaml", f"sensor_type: imu\nT_BS: {EYE}\n", "neither a camera nor an extrinsic"),
        ("a.yaml", "- 1\n", "holds no names"),
        ("a.toml", "", "no calibration file of a known kind"),
        ("a.yaml", "camera: {model: 2}\nextrinsic: {T_C_L: [1]}\n", "write 0 \\(pinhole\\) or 1"),
        (
            "a.yaml",
            "camera_ext_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n",
            "camera_ext_t is missing",
        ),
        (
            "a.yaml",
            "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
            "distortion_coefficients: {data: [0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]}\n",
            "thin prism",
        ),
    ],
)
def test_what_is_wrong_in_other_files_is_said_in_one_line(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        calibrations.read([path])
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
