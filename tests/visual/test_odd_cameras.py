"""Calibrations and image sizes out of the ordinary end in a result or in one InputError, never in a traceback."""

import shutil

import cv2
import numpy as np
import pytest
import yaml

import lvba
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io.image_header import ImageSize
from lvba.io.posed_frames import MIN_IMAGE_SIDE, PosedFrames, of_one_size
from lvba.products.export import export
from lvba.trajectory import Trajectory
from lvba.visual import image

DRAWS = 300
NAMED = [(1, 1), (16, 12), (96, 3), (3, 72), (24, 24), (24, 200), (200, 24), (1000, 24)]


def odd_camera(number: int) -> tuple[tuple[int, int], dict[str, float]]:
    """A size, and calibration keys within what is read as a camera."""
    rng = np.random.default_rng([7, number])
    kind = rng.random()
    if number < len(NAMED):
        size = NAMED[number]
    elif kind < 0.2:
        size = (int(rng.integers(1, 17)), int(rng.integers(1, 13)))
    elif kind < 0.55:
        size = (int(rng.integers(17, 97)), int(rng.integers(13, 73)))
    elif kind < 0.65:
        size = (int(rng.integers(80, 400)), int(rng.integers(24, 60)))
    else:
        size = (96, 72)
    width, height = size
    keys = {
        "cam_cx": float(rng.uniform(-width, 2 * width)) if rng.random() < 0.6 else 0.5 * width,
        "cam_cy": float(rng.uniform(-height, 2 * height)) if rng.random() < 0.6 else 0.5 * height,
        "cam_fx": float(width * 10 ** rng.uniform(-2, 3)) if rng.random() < 0.3 else 0.78 * width,
        "cam_fy": float(height * 10 ** rng.uniform(-2, 3)) if rng.random() < 0.3 else 1.04 * height,
    }
    for index in range(4):
        far = 3 if index < 2 else 1
        drawn = float(rng.normal() * 10 ** rng.uniform(-2, far)) if rng.random() < 0.3 else 0.0
        keys[f"cam_d{index}"] = drawn
    return size, keys


def opened(sizes: list[tuple[int, int]]) -> PosedFrames:
    poses = Trajectory(np.arange(len(sizes), dtype=float), np.tile(np.eye(4), (len(sizes), 1, 1)))
    names = tuple(f"{index}.png" for index in range(len(sizes)))
    return of_one_size(
        PosedFrames(names, poses, ("", *names), tuple(ImageSize(*s) for s in sizes), ()), "all_image"
    )


def test_images_are_refused_or_undistorted_into_a_pyramid():
    rng = np.random.default_rng(0)
    refused = 0
    for number in range(DRAWS):
        (width, height), keys = odd_camera(number)
        if min(width, height) < MIN_IMAGE_SIDE:
            with pytest.raises(InputError, match=r"too small to be matched; give images of 24 px or more"):
                opened([(width, height)] * 2)
            refused += 1
            continue
        assert len(opened([(width, height)] * 2).sizes) == 2
        focal, center = (keys["cam_fx"], keys["cam_fy"]), (keys["cam_cx"], keys["cam_cy"])
        distortion = tuple(keys[f"cam_d{index}"] for index in range(4))
        camera = Camera(width, height, *focal, *center, distortion)
        raw = rng.integers(0, 255, (2, height, width, 3), np.uint8)
        pyramid = image.load_images(raw.__getitem__, 2, camera, image.usable_levels(camera, 6))
        assert np.isfinite(pyramid.noise).all()
        assert all(min(level.shape[1:3]) >= 18 for level in pyramid.levels)
    assert 30 < refused < DRAWS / 2


def test_tiny_levels_have_no_noise_to_read():
    for shape in ((1, 1), (3, 72), (96, 3), (17, 40)):
        assert image.sensor_noise(np.full((3, *shape, 1), 100, np.uint8)) > 0


def test_an_export_of_images_of_which_nothing_is_left_is_one_line(tiny_result, tmp_path):
    shutil.copytree(tiny_result, tmp_path / "out")
    path = tmp_path / "out" / "calibration.yaml"
    config = yaml.safe_load(path.read_text())
    config["cam_model"] |= {"cam_d0": -490.5, "cam_fx": 0.97, "cam_cx": -80.6}
    path.write_text(yaml.safe_dump(config))
    for kind in ("colmap", "nerfstudio"):
        with pytest.raises(InputError, match="nothing is left of its images"):
            export(tmp_path / "out", kind)


def test_they_go_through_the_whole_chain(tiny_recording, tmp_path, request):
    """All of them: --odd-cameras 300 (some minutes)."""
    ended = []
    for number in range(DRAWS - request.config.getoption("--odd-cameras"), DRAWS):
        # the last: a principal point beside the image, after which one scene point is left
        size, keys = ((96, 72), {"cam_cx": -1.0}) if number == DRAWS - 1 else odd_camera(number)
        root = tmp_path / str(number)
        shutil.copytree(tiny_recording, root)
        config = yaml.safe_load((root / "config.yaml").read_text())
        config["cam_model"] |= {"cam_width": size[0], "cam_height": size[1], **keys}
        (root / "config.yaml").write_text(yaml.safe_dump(config))
        for path in (root / "all_image").glob("*.png"):
            cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), size, interpolation=cv2.INTER_AREA))
        try:
            result = lvba.refine(lvba.open_dataset(root), lvba.Config(refine_scans=number % 6 == 0))
            result.write(root / "out")
            ended.append(np.isfinite(result.world_from_camera).all())
        except InputError as error:
            ended.append("too small" in str(error))
        shutil.rmtree(root)
    assert all(ended)
