"""`lvba evaluate`, `export` and `simulate`."""

import json

import numpy as np
import pytest
from test_bad_use import assert_one_line

from lvba.io import ply, tum


def evaluation(out):
    return json.loads((out / "report.json").read_text())


def test_judging_a_result_finds_what_its_own_run_found(undisturbed, recording, lvba, tmp_path):
    result, _ = undisturbed
    done = lvba(
        "evaluate", recording, "--out", tmp_path / "out", "--reference", recording / "reference",
        "--lidar-poses", result / "lidar_poses.txt", "--image-poses", result / "image_poses.txt",
        "--exposures", result / "exposures.csv", "--calibration", result / "calibration.yaml",
    )  # fmt: skip
    own, judged = evaluation(result), evaluation(tmp_path / "out")
    assert "report.html" in done.stdout
    for state in ("rough", "refined"):
        for name in ("psnr", "ssim", "psnr_leave_one_out", "ssim_leave_one_out", "map_entropy"):
            # poses are written with nine digits
            assert judged["evaluation"][state][name] == pytest.approx(
                own["evaluation"][state][name], abs=2e-3
            ), name
    for part, name in (("lidar", "ate_m"), ("camera", "ate_m"), ("exposure", "rms_percent")):
        assert judged["reference"][part][name] == pytest.approx(
            own["reference"][part][name], rel=1e-3, abs=1e-6
        )


def test_frames_that_the_poses_say_nothing_about_are_left_out_and_said(
    undisturbed, recording, lvba, tmp_path
):
    lines = (undisturbed[0] / "image_poses.txt").read_text().splitlines(keepends=True)
    (tmp_path / "poses.txt").write_text("".join(lines[:-4]))
    lvba("evaluate", recording, "--out", tmp_path / "out", "--image-poses", tmp_path / "poses.txt")
    report = evaluation(tmp_path / "out")
    assert report["dataset"]["images"] == 12
    assert any("4 images are left out" in warning for warning in report["warnings"])


def test_poses_of_another_clock(recording, undisturbed, lvba, tmp_path):
    known = tum.read_trajectory(undisturbed[0] / "lidar_poses.txt")
    tum.write_trajectory(tmp_path / "poses.txt", type(known)(known.times + 1e6, known.world_from_sensor))
    done = lvba(
        "evaluate", recording, "--out", tmp_path / "o", "--lidar-poses", tmp_path / "poses.txt", code=2
    )
    assert_one_line(done, "poses.txt", "another clock")


def test_export_and_its_mistakes(undisturbed, lvba, tmp_path):
    result, _ = undisturbed
    done = lvba("export", result, "ply", "--out", tmp_path / "copy.ply")
    assert done.stdout.strip() == str(tmp_path / "copy.ply")
    written, own = ply.read_ply(tmp_path / "copy.ply"), ply.read_ply(result / "map.ply")
    assert list(written) == list(own)
    assert all(np.array_equal(written[name], own[name]) for name in own)
    assert_one_line(lvba("export", result, "obj", code=2), "obj", "choose one of ply")
    assert_one_line(lvba("export", tmp_path, "ply", code=2), "map.ply")


def test_simulate_and_its_mistakes(lvba, tmp_path):
    options = ["--frames", 3, "--scans", 4, "--points", 500, "--width", 80, "--height", 60, "--length", 5]
    options += ["--vignetting", "--motion-blur", "--shot-noise"]
    lvba("simulate", "plane", "--out", tmp_path / "plane", "--seed", 2, *options)
    assert len(list((tmp_path / "plane" / "all_image").glob("*.png"))) == 3
    assert len(list((tmp_path / "plane" / "all_pcd_body").glob("*.pcd"))) == 4
    facts = json.loads((tmp_path / "plane" / "reference" / "simulation.json").read_text())
    assert (facts["width"], facts["points"], facts["length_m"]) == (80, 500, 5)
    assert (tmp_path / "plane" / "reference" / "lidar_poses.txt").exists()
    assert_one_line(lvba("simulate", "moon", "--out", tmp_path / "moon", code=2), "moon", "courtyard")
    assert not (tmp_path / "moon").exists()


def test_recording_without_images(recording, lvba, tmp_path):
    import shutil

    scans = tmp_path / "scans"
    shutil.copytree(recording / "all_pcd_body", scans / "all_pcd_body")
    shutil.copytree(recording / "reference", scans / "reference")
    if (recording / "lidar_poses.txt").exists():
        shutil.copy(recording / "lidar_poses.txt", scans)
    lvba("run", scans, "--out", tmp_path / "out", "--reference", scans / "reference")
    report = evaluation(tmp_path / "out")
    assert report["visual"]["problem"] == "the recording has no images"
    assert report["evaluation"]["refined"]["map_entropy"] < report["evaluation"]["rough"]["map_entropy"]
    assert report["reference"]["lidar"]["ate_m"] < 0.1 * report["reference"]["rough"]["lidar"]["ate_m"]
    assert not (tmp_path / "out" / "image_poses.txt").exists()
    columns = ply.read_ply(tmp_path / "out" / "map.ply")
    assert len(columns["x"]) > 10_000
    np.testing.assert_array_equal(columns["red"], columns["blue"])
