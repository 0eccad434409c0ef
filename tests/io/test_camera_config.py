from pathlib import Path

import numpy as np
import pytest
import small_recording

from lvba.errors import InputError
from lvba.io import camera_config
from lvba.io.image_header import ImageSize
from lvba.lens import Lens

CAMERA_ONLY = """\
cam_model: Pinhole
cam_width: 1280
cam_height: 1024
scale: 0.5
cam_fx: 1293.5
cam_fy: 1293.25
cam_cx: 626.75
cam_cy: 522.5
cam_d0: -0.076
cam_d1: 0.123
cam_d2: -0.00113
cam_d3: 2.51e-4
"""
EXTRINSIC_ONLY = """\
common: {img_topic: "/left_camera/image", lidar_en: 1}
extrin_calib:
  extrinsic_T: [0.04165, 0.02326, -0.0284]
  extrinsic_R: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
  Rcl: [0.00610193,-0.999863,-0.0154172,
        -0.00615449,0.0153796,-0.999863,
        0.999962,0.00619598,-0.0060598]
  Pcl: [0.0194384, 0.104689,-0.0251952]
pcd_save: {interval: -1}
"""


def _indent(text: str, by: int = 6) -> str:
    return "".join(f"{' ' * by}{line}\n" for line in text.splitlines())


def _check_fast_livo(folder: Path) -> None:
    found = camera_config.read_calibration(folder)
    assert (found.camera.width, found.camera.height, found.scale) == (1280, 1024, 0.5)
    assert (found.camera.fx, found.camera.fy, found.camera.cx, found.camera.cy) == (
        1293.5,
        1293.25,
        626.75,
        522.5,
    )
    assert found.camera.distortion == (-0.076, 0.123, -0.00113, 2.51e-4)
    rotation = found.camera_from_lidar[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation[0], [0.00610193, -0.999863, -0.0154172], atol=1e-4)
    np.testing.assert_array_equal(found.camera_from_lidar[:3, 3], [0.0194384, 0.104689, -0.0251952])
    np.testing.assert_array_equal(found.body_from_lidar[:3, 3], [0.04165, 0.02326, -0.0284])


def test_one_file(tmp_path: Path):
    lines = CAMERA_ONLY.splitlines(keepends=True)[1:]
    (tmp_path / "config.yaml").write_text(
        "cam_model:\n" + "".join("  " + line for line in lines) + EXTRINSIC_ONLY
    )
    _check_fast_livo(tmp_path)


@pytest.mark.parametrize("folder", ["", "config"])
def test_two_files_as_fast_livo_has_them(tmp_path: Path, folder: str):
    (tmp_path / folder).mkdir(exist_ok=True)
    (tmp_path / folder / "avia.yaml").write_text(EXTRINSIC_ONLY)
    (tmp_path / folder / "camera_pinhole.yaml").write_text(CAMERA_ONLY)
    _check_fast_livo(tmp_path)


def test_ros_2_parameters_with_and_without_the_prefix(tmp_path: Path):
    camera = CAMERA_ONLY.replace("cam_", "")
    extrinsic = EXTRINSIC_ONLY
    (tmp_path / "a.yaml").write_text(f"/node:\n  ros__parameters:\n{_indent(extrinsic, 4)}")
    (tmp_path / "b.yaml").write_text(f"/**:\n  ros__parameters:\n    camera:\n{_indent(camera)}")
    _check_fast_livo(tmp_path)
    (tmp_path / "b.yaml").write_text(f"/**:\n  ros__parameters:\n    camera:\n{_indent(CAMERA_ONLY)}")
    _check_fast_livo(tmp_path)


def test_opencv_s_header_matrices_and_numbers_without_a_point(tmp_path: Path):
    text = "%YAML:1.0\n---\n" + small_recording.CONFIG.replace("cam_d2: 0.001", "cam_d2: 1e-3").replace(
        "Pcl: [0.02, 0.10, -0.03]",
        "Pcl: !!opencv-matrix\n    rows: 3\n    cols: 1\n    dt: d\n    data: [0.02, 0.10, -3e-2]",
    ).replace("Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]", "Rcl: [[0, -1, 0], [0, 0, -1], [1, 0, 0]]")
    (tmp_path / "config.yml").write_text(text)
    found = camera_config.read_calibration(tmp_path)
    assert found.camera.distortion[2] == 1e-3
    np.testing.assert_array_equal(found.camera_from_lidar[:3, 3], small_recording.PCL)
    np.testing.assert_array_equal(found.camera_from_lidar[:3, :3], small_recording.RCL)


def test_config_yaml_is_enough_and_others_are_not_looked_at(tmp_path: Path):
    (tmp_path / "config.yaml").write_text(small_recording.CONFIG)
    (tmp_path / "another.yaml").write_text("{[ no yaml")
    assert camera_config.read_calibration(tmp_path).camera.width == 32


def test_two_cameras_are_not_chosen_between(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(EXTRINSIC_ONLY)
    (tmp_path / "camera_1.yaml").write_text(CAMERA_ONLY)
    (tmp_path / "camera_2.yaml").write_text(CAMERA_ONLY)
    _check_fast_livo(tmp_path)  # the same twice is no question
    (tmp_path / "camera_2.yaml").write_text(CAMERA_ONLY.replace("1293.5\n", "900\n"))
    with pytest.raises(InputError, match=r"camera_2\.yaml: has another fx than camera_1\.yaml"):
        camera_config.read_calibration(tmp_path)
    (tmp_path / "camera_2.yaml").rename(tmp_path / "config.yaml")
    assert camera_config.read_calibration(tmp_path).camera.fx == 900
    (tmp_path / "config.yaml").write_text("left: {cam_fx: 1}\nright: {cam_fx: 2}")
    with pytest.raises(InputError, match="has another fx than the same file"):
        camera_config.read_calibration(tmp_path)


def test_a_folder_without_yaml_has_no_calibration(tmp_path: Path):
    found = camera_config.read_calibration(tmp_path)
    assert found.camera is None
    assert found.camera_from_lidar is None
    np.testing.assert_array_equal(found.body_from_lidar, np.eye(4))


def test_the_size_of_the_images_decides_not_the_scale_key(tmp_path: Path):
    (tmp_path / "config.yaml").write_text(CAMERA_ONLY + EXTRINSIC_ONLY)
    found = camera_config.read_calibration(tmp_path)
    assert camera_config.for_size(found, ImageSize(1280, 1024)) == found.camera
    half = camera_config.for_size(found, ImageSize(640, 512))
    assert half == found.camera.scaled(0.5)
    assert half.cx == (626.75 + 0.5) / 2 - 0.5  # pixel centers
    quarter = camera_config.for_size(found, ImageSize(320, 256))
    assert quarter.fx == 1293.5 / 4


def test_odd_sizes_are_rounded(tmp_path: Path):
    (tmp_path / "config.yaml").write_text(
        CAMERA_ONLY.replace("1280", "1281").replace("1024", "1025") + EXTRINSIC_ONLY
    )
    found = camera_config.read_calibration(tmp_path)
    for width, height in ((640, 512), (641, 513)):
        camera = camera_config.for_size(found, ImageSize(width, height))
        assert (camera.width, camera.height) == (width, height)
        assert camera.fx == 1293.5 / 2


@pytest.mark.parametrize("size", [(1280, 1023), (1279, 1024), (1024, 1280), (640, 500), (640, 480)])
def test_images_that_are_no_scaled_version_are_refused(tmp_path: Path, size: tuple[int, int]):
    (tmp_path / "config.yaml").write_text(CAMERA_ONLY + EXTRINSIC_ONLY)
    with pytest.raises(InputError, match="but the images are"):
        camera_config.for_size(camera_config.read_calibration(tmp_path), ImageSize(*size))


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("  cam_fx: 30.5\n", "", "cam_fx is missing"),
        ("  cam_width: 32\n", "", "cam_width is missing"),
        ("cam_fx: 30.5", "cam_fx: -30.5", "cam_fx is '-30.5'"),
        ("cam_fx: 30.5", "cam_fx: 0", "cam_fx is '0'"),
        ("cam_fx: 30.5", "cam_fx: .nan", "cam_fx is 'nan'"),
        ("cam_fx: 30.5", "cam_fx: true", "cam_fx is 'True'"),
        ("cam_fx: 30.5", "cam_fx: [30.5]", "cam_fx is '[30.5]'"),
        ("cam_fx: 30.5", "cam_fx: about 30", "cam_fx is 'about 30'"),
        ("cam_cx: 15.5", "cam_cx: 1555", "cam_cx is '1555'"),
        ("cam_width: 32", "cam_width: 32.5", "no whole numbers"),
        ("cam_width: 32", "cam_width: 1e99", "cam_width is '1e99'"),
        ("scale: 1.0", "scale: 0", "scale is '0'"),
        ("cam_d3: -0.002", "cam_d3: -0.002\n  cam_d8: 0.1", "cam_d8"),
        ("scale: 1.0", "model: OcamCamera", "'OcamCamera' is not known"),
        ("Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]", "Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0.1]", "Rcl is no rotation"),
        ("Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]", "Rcl: [0, -1, 0, 0, 0, -1, -1, 0, 0]", "a reflection"),
        ("Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]", "Rcl: [0, 0, 0, 0, 0, 0, 0, 0, 0]", "Rcl is no rotation"),
        ("Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]", "Rcl: [0, -1, 0, 0, 0, -1, 1, 0]", "Rcl is not 9 numbers"),
        ("  Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]\n", "", "Rcl is missing"),
        ("Pcl: [0.02, 0.10, -0.03]", "Pcl: [0.02, x, -0.03]", "Pcl is not 3 numbers"),
        ("Pcl: [0.02, 0.10, -0.03]", "Pcl: 5", "Pcl is not 3 numbers"),
        ("extrinsic_R: [1, 0, 0, 0, 1", "extrinsic_R: [1, 0, 0, 0, 2", "extrinsic_R is no rotation"),
        ("cam_model:\n", "cam_model: [\n", "config.yaml:"),
        ("cam_fx: 30.5", "cam_fx: &a 30.5\n  other: *a", "aliases"),
        ("cam_fx: 30.5", "cam_fx: !!python/object/apply:os.system [ls]", "config.yaml:5"),
        ("cam_fx: 30.5", "cam_fx: !!int ''", "config.yaml"),
        ("cam_fx: 30.5", "cam_fx: 2001-13-45", "config.yaml"),
        ("cam_fx: 30.5", "cam_fx: " + "[" * 5000, "nested too deep"),
        ("cam_fx: 30.5", "cam_fx: " + "9" * 5000, "config.yaml"),
        ("cam_fx: 30.5", "cam_fx: 30.5\n" + "# much too long\n" * 10000, "more than 65536"),
    ],
)  # fmt: skip
def test_bad_values_are_named(tmp_path: Path, old: str, new: str, problem: str):
    assert old in small_recording.CONFIG
    (tmp_path / "config.yaml").write_text(small_recording.CONFIG.replace(old, new))
    with pytest.raises(InputError) as caught:
        camera_config.read_calibration(tmp_path)
    assert problem in str(caught.value)
    assert "config.yaml" in str(caught.value)
    assert len(str(caught.value)) < 600


def test_a_bomb_of_aliases_does_not_explode(tmp_path: Path):
    levels = "".join(f"l{i}: &l{i} [{','.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 30))
    (tmp_path / "config.yaml").write_text("l0: &l0 [lol]\n" + levels)
    with pytest.raises(InputError, match="aliases"):
        camera_config.read_calibration(tmp_path)


BROWN, FISHEYE = Lens.RADIAL_TANGENTIAL, Lens.EQUIDISTANT
DISTORTION = """\
  cam_d0: -0.1
  cam_d1: 0.02
  cam_d2: 0.001
  cam_d3: -0.002
"""


@pytest.mark.parametrize(
    "distortion",
    [
        "  k1: -0.1\n  k2: 0.02\n  p1: 0.001\n  p2: -0.002\n",
        "  cam_k1: -0.1\n  cam_k2: 0.02\n  cam_p1: 0.001\n  cam_p2: -0.002\n  cam_k3: 0\n",
        "  distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0.0]}\n",
        "  distortion_model: plumb_bob\n  D: [-0.1, 0.02, 0.001, -0.002, 0]\n",
        "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.02, 0.001, -2e-3]\n",
        "  distortion_parameters: {k1: -0.1, k2: 0.02, p1: 0.001, p2: -0.002}\n",
        "  cam_d0: -0.1\n  cam_d1: 0.02\n  cam_d2: 0.001\n  cam_d3: -0.002\n  cam_d4: 0.0\n  cam_name: left\n",
    ],
)
def test_common_names_of_the_distortion(tmp_path: Path, distortion: str):
    assert DISTORTION in small_recording.CONFIG
    (tmp_path / "config.yaml").write_text(small_recording.CONFIG.replace(DISTORTION, distortion))
    camera = camera_config.read_calibration(tmp_path).camera
    assert tuple(map(float, camera.distortion)) == (-0.1, 0.02, 0.001, -0.002)


@pytest.mark.parametrize(
    "section",
    [
        "camera: {width: 32, height: 24, intrinsics: [30.5, 31.0, 15.5, 11.5], distortion: [-0.1, 0.02, 0.001, -0.002]}",
        "cam_model: {cam_width: 32, cam_height: 24, camera_matrix: [30.5, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1], "
        "D: [-0.1, 0.02, 0.001, -0.002]}",
        "image_width: 32\nimage_height: 24\ncamera_name: left\n"  # ROS camera_info
        "camera_matrix: {rows: 3, cols: 3, data: [30.5, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0]}\n"
        "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
        "projection_matrix: {rows: 3, cols: 4, data: [30, 0, 15, 0, 0, 30, 11, 0, 0, 0, 1, 0]}",
        "cam0:\n  camera_model: pinhole\n  intrinsics: [30.5, 31.0, 15.5, 11.5]\n"  # Kalibr
        "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]\n  resolution: [32, 24]\n"
        "  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n  timeshift_cam_imu: 0.01\n"
        "  rostopic: /left\n  cam_overlaps: []",
        "r3live_vio:\n  image_width: 32\n  image_height: 24\n"
        "  camera_intrinsic: [30.5, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]\n"
        "  camera_dist_coeffs: [-0.1, 0.02, 0.001, -0.002, 0]\n  camera_ext_t: [0, 0, 0]",
    ],
)
def test_cameras_as_other_programs_write_them(tmp_path: Path, section: str):
    extrinsic = small_recording.CONFIG[small_recording.CONFIG.index("extrin_calib") :]
    (tmp_path / "config.yaml").write_text(f"{section}\n{extrinsic}")
    camera = camera_config.read_calibration(tmp_path).camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (32, 24, 30.5, 31)
    assert (camera.cx, camera.cy, camera.distortion) == (15.5, 11.5, (-0.1, 0.02, 0.001, -0.002))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (DISTORTION, "  cam_q0: -0.1\n", "cam_model.cam_q0 is not known"),
        (DISTORTION, "  cam_kk1: -0.1\n", "did you mean cam_k1?"),
        (DISTORTION, "  lens: wide\n", "cam_model.lens is not known"),
        (DISTORTION, "  D: [-0.1, 0.02]\n", "D has 2 numbers"),
        (DISTORTION, "  D: [-0.1, 0.02, 0, 0, 0, 0, 0, 0, 0.5, 0, 0, 0]\n", "with such a coefficient is not known"),
        (DISTORTION, "  distortion_model: equidistant\n  D: [0.1, 0, 0, 0, 0.2]\n", "such a coefficient is not known"),
        (DISTORTION, "  distortion_model: equidistant\n  k1: 0.1\n  p1: 0.1\n", "an equidistant lens has no p1"),
        (DISTORTION, "  distortion_model: ftheta\n  D: [-0.1, 0.02, 0.001, -0.002]\n", "'ftheta' is not known"),
        ("scale: 1.0", "model: OcamCamera", "'OcamCamera' is not known"),
        (DISTORTION, "  xi: 1.5\n", "omnidirectional (Mei)"),
        (DISTORTION, DISTORTION + "  k1: -0.2\n", "cam_d0 and k1 say different things"),
        ("cam_fx: 30.5", "camera_matrix: [30.5, 1, 15.5, 0, 31, 11.5, 0, 0, 1]", "no matrix of fx"),
    ],
)  # fmt: skip
def test_what_is_not_known_of_a_camera_is_an_error(tmp_path: Path, old: str, new: str, words: str):
    assert old in small_recording.CONFIG
    (tmp_path / "config.yaml").write_text(small_recording.CONFIG.replace(old, new))
    with pytest.raises(InputError) as caught:
        camera_config.read_calibration(tmp_path)
    assert words in str(caught.value)
    assert "config.yaml" in str(caught.value)


def test_fast_livo_s_fisheye_file_opens(tmp_path: Path):
    text = CAMERA_ONLY[: CAMERA_ONLY.index("cam_d0")].replace("Pinhole", "EquidistantCamera")
    coefficients = "k1: -0.037\nk2: -0.009\nk3: 0.009\nk4: -0.004\n"
    (tmp_path / "camera_fisheye.yaml").write_text(text + coefficients)
    (tmp_path / "avia.yaml").write_text(EXTRINSIC_ONLY)
    camera = camera_config.read_calibration(tmp_path).camera
    assert (camera.lens, camera.distortion) == (Lens.EQUIDISTANT, (-0.037, -0.009, 0.009, -0.004))


@pytest.mark.parametrize(
    ("keys", "lens", "distortion"),
    [
        ("  k1: -0.1\n  k2: 0.02\n  p1: 0.001\n  p2: 0\n  k3: 0.1\n", BROWN, (-0.1, 0.02, 0.001, 0, 0.1)),
        ("  D: [-0.1, 0.02, 0.001, -0.002, -0.0222]\n", BROWN, (-0.1, 0.02, 0.001, -0.002, -0.0222)),
        ("  cam_d0: -0.1\n  cam_d4: 0.1\n", BROWN, (-0.1, 0, 0, 0, 0.1)),
        (
            "  distortion_model: rational_polynomial\n  D: [-0.1, 0.02, 0.001, -0.002, 0, 0.5, 0, 0]\n",
            BROWN,
            (-0.1, 0.02, 0.001, -0.002, 0, 0.5, 0, 0),
        ),
        ("  distortion_model: equidistant\n  D: [-0.1, 0.02, 0.001, 0]\n", FISHEYE, (-0.1, 0.02, 0.001, 0)),
        ("  model: EquidistantCamera\n  k1: 0.1\n  k4: 0.2\n", FISHEYE, (0.1, 0, 0, 0.2)),
        ("  model: kannala_brandt\n  cam_d0: 0.1\n  cam_d3: 0.2\n", FISHEYE, (0.1, 0, 0, 0.2)),
    ],
)
def test_lenses_of_more_coefficients_and_fisheyes(tmp_path: Path, keys, lens, distortion):
    text = small_recording.CONFIG.replace(DISTORTION, keys)
    (tmp_path / "config.yaml").write_text(text)
    camera = camera_config.read_calibration(tmp_path).camera
    assert (camera.lens, camera.distortion) == (lens, distortion)


def test_other_settings_beside_the_camera_at_top_level_are_passed_over(tmp_path: Path):
    others = """\
rmse_m: 0.004
reprojection_rmse_px: 0.7
img_time_offset: 0.2
resolution: 0.1
type: 3
size: 5
common: {img_topic: "/left_camera/image", lidar_en: 1}
lio: {voxel_size: 0.5, beam_err: 0.05, k1: 7}
seq_name: yard
cam_name: left
"""
    (tmp_path / "config.yaml").write_text(
        others + CAMERA_ONLY + EXTRINSIC_ONLY[EXTRINSIC_ONLY.index("extrin") :]
    )
    _check_fast_livo(tmp_path)
    (tmp_path / "config.yaml").write_text(others + CAMERA_ONLY + "cam_d9: 1\n" + EXTRINSIC_ONLY)
    with pytest.raises(InputError, match="cam_d9"):
        camera_config.read_calibration(tmp_path)


def test_a_calibration_of_ros_beside_fast_livo_s_is_not_looked_at(tmp_path: Path):
    (tmp_path / "avia.yaml").write_text(EXTRINSIC_ONLY)
    (tmp_path / "camera.yaml").write_text(CAMERA_ONLY)
    (tmp_path / "ros.yaml").write_text(
        "image_width: 1280\nimage_height: 1024\ncamera_matrix: {data: [1, 0, 1, 0, 1, 1, 0, 0, 1]}\n"
    )
    _check_fast_livo(tmp_path)
