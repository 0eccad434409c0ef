"""Poses of any method are judged as in a run: by corrected scans, and not by images that show nothing."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from lvba import evaluation
from lvba.io.dataset import load_scan, open_dataset
from lvba.io.images import read_image, write_image
from lvba.lidar.scan_errors import ScanErrors
from lvba.pipeline import Config
from lvba.products import map_quality
from lvba.simulate import simulate
from lvba.simulate.disturbances import Disturbances
from lvba.steps.lidar import cloud_of


class Stretched(ScanErrors):
    """Scans that are too long by as many thousandths as their number says."""

    def points(self, scan, index, stamp, cosine=None):
        return scan.points * np.float32(1 + 1e-3 * index)


def test_scans_are_corrected_by_their_numbers_in_the_recording_before_poses_are_judged(
    recording, tmp_path, monkeypatch
):
    shutil.copytree(recording / "all_pcd_body", tmp_path / "scans" / "all_pcd_body")
    dataset = open_dataset(tmp_path / "scans")
    lines = (recording / "reference" / "lidar_poses.txt").read_text().splitlines(keepends=True)
    (tmp_path / "later.txt").write_text("".join(lines[9:]))
    given = evaluation.read_given(dataset, tmp_path / "later.txt")
    assert list(given.scan_numbers) == list(range(len(dataset.scans) - len(lines[9:]), len(dataset.scans)))

    config = Config()
    asked = []
    monkeypatch.setattr(
        evaluation.scan_errors, "measure", lambda *of: asked.append(of[0]) or Stretched(None, None)
    )
    judged = evaluation.report(given, config, None)["evaluation"]
    assert asked == [dataset]  # of all scans, as in a run, not of those that the poses are of
    for state, poses in (
        ("rough", given.dataset.scans.world_from_sensor),
        ("refined", given.world_from_scan),
    ):
        cloud = cloud_of(
            given.dataset,
            poses,
            read=lambda index: (
                load_scan(given.dataset, index).points * np.float32(1 + 1e-3 * given.scan_numbers[index])
            ),
        )
        expected = map_quality.entropy_blocks(cloud, config.evaluate.entropy).mean
        assert judged[state]["map_entropy"] == pytest.approx(expected, abs=1e-12)


def test_a_blank_image_is_not_judged_and_colors_nothing(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "street")
    path = Path(open_dataset(tmp_path / "street").image_paths[7])
    write_image(path, np.zeros_like(read_image(path)))
    config = dataclasses.replace(Config(), refine_scans=False)
    clean, blank = (
        evaluation.report(evaluation.read_given(open_dataset(folder)), config, None)["evaluation"]["refined"]
        for folder in (recording, tmp_path / "street")
    )
    assert set(clean["images"]) - set(blank["images"]) == {7}
    before = dict(zip(clean["images"], clean["per_image"]["psnr_leave_one_out"], strict=True))
    after = dict(zip(blank["images"], blank["per_image"]["psnr_leave_one_out"], strict=True))
    assert max(before[image] - after[image] for image in after) < 2.0


def test_images_that_were_read_row_by_row_are_judged_as_if_at_once(tmp_path):
    """Reference poses are those of the middle rows: they predict images better where the turn while rows are read is
    taken out, and worse where it is put in twice."""
    sizes = {"width": 240, "height": 180, "points_per_scan": 6000, "frames": 12, "scans": 12}
    simulate("rooms", tmp_path / "rooms", seed=7, disturb=Disturbances(rolling_shutter=0.06), **sizes)
    dataset, truth = open_dataset(tmp_path / "rooms"), tmp_path / "rooms" / "reference"
    poses = [truth / name for name in ("lidar_poses.txt", "image_poses.txt", "exposures.csv")]
    psnr = []
    for readout in (0.0, 0.06, -0.06):
        given = evaluation.read_given(dataset, *poses, readout=readout)
        judged = evaluation.report(given, dataclasses.replace(Config(), refine_scans=False), None)
        psnr.append(judged["evaluation"]["refined"]["psnr_leave_one_out"])
    at_once, by_rows, wrong_way = psnr
    assert by_rows > at_once + 0.3
    assert at_once > wrong_way + 0.3
