"""Inputs that a refinement could only spoil: the result is never worse, and the report says what happened."""

import shutil

import cv2
import numpy as np
import pytest

import lvba
from lvba.io import images, reference
from lvba.io.dataset import open_dataset


@pytest.fixture
def copy(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "recording")


def pose_file(folder, name):
    return next(p for p in folder.rglob(name) if p.parent.name != "reference")


def picture_paths(folder):
    return sorted(p for p in (folder / "all_image").iterdir() if p.suffix == ".png")


def refined(folder):
    truth = reference.read_reference(folder / "reference")
    return lvba.refine(open_dataset(folder), reference=truth).report


def assert_not_worse(report):
    """A sharper map, and images predicted better or, said so, no worse than chance."""
    rough, after = (report["evaluation"][state] for state in ("rough", "refined"))
    assert after["map_entropy"] <= rough["map_entropy"]
    # whichever state the result is
    assert None not in [after[name] for name in ("psnr", "psnr_leave_one_out", "ssim", "ssim_leave_one_out")]
    if after["psnr_leave_one_out"] < rough["psnr_leave_one_out"]:
        assert after["psnr_leave_one_out"] > rough["psnr_leave_one_out"] - 0.2
        assert any("within chance" in warning for warning in report["warnings"])


def test_perfect_poses(copy):
    for name in ("lidar_poses.txt", "image_poses.txt"):
        shutil.copy(copy / "reference" / name, pose_file(copy, name))
    report = refined(copy)
    assert_not_worse(report)
    # a gain within chance moves nothing
    assert report["reference"]["lidar"]["ate_m"] < 1e-6
    assert report["reference"]["camera"]["ate_m"] < 1e-6


def test_textureless_images(copy):
    for path in picture_paths(copy):
        images.write_image(path, np.full((240, 320, 3), 120, np.uint8))
    report = refined(copy)
    assert_not_worse(report)
    assert report["lidar"]["accepted"]
    assert not report["visual"]["accepted"]
    assert "no scene point" in report["visual"]["reason"]


def test_images_of_another_place(copy):
    rng = np.random.default_rng(0)
    for path in picture_paths(copy):
        blobs = cv2.resize(rng.uniform(0, 255, (12, 16, 3)), (320, 240), interpolation=cv2.INTER_CUBIC)
        images.write_image(path, blobs.clip(0, 255).astype(np.uint8))
    report = refined(copy)
    assert_not_worse(report)
    assert not report["visual"]["accepted"]


def test_images_one_whole_frame_late(copy):
    paths = picture_paths(copy)
    pictures = [p.read_bytes() for p in paths]
    for path, content in zip(paths[1:], pictures[:-1], strict=True):
        path.write_bytes(content)
    report = refined(copy)
    assert_not_worse(report)
    # half a second of driving, found as a time offset
    if report["visual"]["accepted"]:
        times = [float(path.stem) for path in paths]
        assert report["visual"]["time_offset"]["seconds"] == pytest.approx(times[0] - times[1], rel=0.2)
