"""`lvba run`: what it writes, that it continues where it was stopped, and that nothing depends on how it got there."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lvba.io import ply, tum

ROOT = Path(__file__).resolve().parents[2]

STAGES = [
    *(
        "survey",
        "sensor-errors",
        "scan-motion",
        "scan-errors",
        "scans",
        "lidar",
        "lidar-entropy",
        "moving-points",
        "photos",
        "lidar-images",
        "lidar-gate",
        "images",
        "visual-planes",
    ),
    *(
        "visual-level-2",
        "visual-level-1",
        "visual",
        "visual-as-calibrated",
        "visual-compared",
        "visual-choice",
        "visual-outliers",
        "visual-mended",
    ),
    *("fusion", "fusion-entropy", "fusion-choice", "fusion-gate", "fused-cameras"),
    *("exposures-between", "exposures"),
    *("evaluate", "visual-gate", "evaluate-result", "expected-error"),
    *("map", "planes", "renderings", "pictures", "facts"),
]
PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply", "config.yaml"]

STOPPED_IN = """
import os, signal, sys
from lvba import plan
real = plan.compute
def compute(step, store, progress):
    if step.name == sys.argv[1]:
        os.kill(os.getpid(), signal.SIGINT)
    return real(step, store, progress)
plan.compute = compute
from service.cli.main import main
sys.exit(main(sys.argv[2:]))
"""
"""The command, with a real SIGINT while the named stage runs."""

STOPPED_WHILE_BUSY = """
import os, signal, sys
from lvba import plan
def compute(step, store, progress):
    os.kill(os.getpid(), signal.SIGINT)
    while True:
        pass
plan.compute = compute
from service.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
"""The command, with a SIGINT in a stage that never says how far it is."""

STOPPED_WRITING = """
import os, signal, sys
from workers import store
real = store._sync
def sync(folder):
    if sys.argv[1] in (folder / "manifest.json").read_text():
        os.kill(os.getpid(), signal.SIGINT)
    return real(folder)
store._sync = sync
from service.cli.main import main
sys.exit(main(sys.argv[2:]))
"""
"""The command, with a real SIGINT while the named stage's artifact is half-written."""


def report_of(out):
    return json.loads((out / "report.json").read_text())


def bytes_of(out):
    return {name: (out / name).read_bytes() for name in PRODUCTS}


def reused(out):
    return {stage["name"]: stage["reused"] for stage in report_of(out)["stages"]}


def test_writes_everything_that_is_promised(undisturbed, recording):
    out, done = undisturbed
    report = report_of(out)
    assert {*PRODUCTS, "report.json", "report.html", "stages"} <= {p.name for p in out.iterdir()}
    assert report["schema"] == 1
    assert {"dataset", "config", "versions", "stages", "lidar", "visual", "evaluation", "reference"} <= set(
        report
    )
    assert [s["name"] for s in report["stages"]][: len(STAGES) + 1] == ["input", *STAGES]
    assert all({"seconds", "peak_memory_mb", "tasks", "reused"} <= set(s) for s in report["stages"])
    for state in ("rough", "refined"):
        assert {"psnr", "ssim", "coverage", "psnr_leave_one_out", "ssim_leave_one_out", "map_entropy"} <= set(
            report["evaluation"][state]
        )
    assert {"cost_initial", "cost_final", "planes", "iterations", "accepted"} <= set(report["lidar"])
    assert {"observations", "accepted", "extrinsic", "time_offset", "degenerate_directions"} <= set(
        report["visual"]
    )
    assert "report.html" in done.stdout


def test_every_fact_of_the_report_is_in_its_reference(undisturbed):
    overview, *sections = re.split(r"(?m)^## ", (ROOT / "docs" / "report.md").read_text())
    known = {section.split("`")[1]: _keys(section) for section in sections}
    report = report_of(undisturbed[0])
    assert set(report) <= _keys(overview)
    facts = {
        key: set(facts)
        for key, facts in report.items()
        if isinstance(facts, dict) and key not in ("config", "versions")
    }
    assert {key: named - known[key] for key, named in facts.items() if named - known[key]} == {}


def _keys(section: str) -> set[str]:
    """The keys in the first cells of a section's tables."""
    rows = re.findall(r"(?m)^\| (`[^|]*) \|", section)
    return {key for row in rows for key in re.findall(r"`([\w.]+)`", row)}


def test_the_report_says_how_many_millimeters_to_expect(undisturbed):
    out, _ = undisturbed
    report = report_of(out)
    expected, error = report["expected_error"], ply.read_ply(out / "map.ply")["error"].astype(float)
    for part, frames in (("scans", "scans"), ("cameras", "images")):
        assert len(expected[part]["per_frame_m"]) == report["dataset"][frames]
        assert expected[part]["position_m"] == pytest.approx(
            report["reference"][{"scans": "lidar", "cameras": "camera"}[part]]["predicted_ate_m"]
        )
    assert expected["map"]["position_m"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-5)
    assert expected["map"]["position_p95_m"] == pytest.approx(np.quantile(error, 0.95), rel=0.01)
    assert report["planes"]["thickness_after_m"] < report["planes"]["thickness_before_m"]
    assert report["verdict"]["level"] in ("good", "check", "bad")
    assert "mm in the map" in report["verdict"]["summary"]
    assert report["verdict"]["summary"] in (out / "report.html").read_text().replace("&#x27;", "'")


def test_result_is_better_than_the_input_by_every_measure(undisturbed):
    report = report_of(undisturbed[0])
    rough, refined = (report["evaluation"][state] for state in ("rough", "refined"))
    assert refined["psnr_leave_one_out"] > rough["psnr_leave_one_out"] + 1
    assert refined["ssim_leave_one_out"] > rough["ssim_leave_one_out"]
    assert refined["map_entropy"] < rough["map_entropy"]
    reference = report["reference"]
    for part, figure in (
        ("lidar", "ate_m"), ("lidar", "rotation_deg"), ("camera", "ate_m"), ("camera", "rotation_deg"),
        ("exposure", "rms_percent"),
    ):  # fmt: skip
        assert reference[part][figure] < 0.5 * reference["rough"][part][figure], (part, figure)


def test_poses_have_the_times_of_the_input_and_the_map_its_fields(undisturbed, recording):
    out, _ = undisturbed
    for name, folder in (("lidar_poses.txt", "all_pcd_body"), ("image_poses.txt", "all_image")):
        written = tum.read_trajectory(out / name)
        given = tum.read_trajectory(
            next(p for p in recording.rglob(name) if p.parent.name in (folder, recording.name))
        )
        np.testing.assert_array_equal(written.times, given.times)
    columns = ply.read_ply(out / "map.ply")
    assert list(columns)[:6] == ["x", "y", "z", "red", "green", "blue"]
    assert columns["red"].dtype == np.uint8
    assert columns["error"].dtype == np.float32
    assert np.isfinite(columns["error"]).all()
    lines = (out / "exposures.csv").read_text().splitlines()
    assert lines[0] == "timestamp,relative_exposure"
    assert float(lines[1].split(",")[1]) == 1.0


def test_progress_elsewhere_than_on_a_terminal_is_plain_lines(undisturbed):
    _, done = undisturbed
    assert "\r" not in done.stderr
    assert "\x1b" not in done.stderr
    counted = re.findall(r"^\[(\d+)/(\d+)\] (\S+)$", done.stderr, re.MULTILINE)
    # one count from the first stage to the last: reading the input is the first
    assert [int(place) for place, _, _ in counted] == list(range(2, len(counted) + 2))
    assert {int(total) for _, total, _ in counted} == {len(counted) + 1}
    assert (counted[0][2], counted[-1][2]) == ("survey", "write")


def test_same_command_again_reuses_every_stage(undisturbed, recording, lvba):
    out, _ = undisturbed
    before = bytes_of(out)
    lvba("run", recording, "--out", out, "--reference", recording / "reference")
    assert all(reused(out)[name] for name in STAGES)
    assert bytes_of(out) == before


def test_config_of_a_result_repeats_it(undisturbed, recording, lvba):
    out, _ = undisturbed
    lvba(
        "run",
        recording,
        "--out",
        out,
        "--reference",
        recording / "reference",
        "--config",
        out / "config.yaml",
    )
    assert all(reused(out)[name] for name in STAGES)


STOPS = ("lidar", "visual-level-1", "visual-gate", "facts")
"""Of each kind: scans, images, judgement, report. Steps of every shape are stopped in `tests/workers`."""


def test_stopped_again_and_again_it_ends_with_the_same_bytes(undisturbed, recording, lvba, tmp_path):
    out = tmp_path / "out"
    run = ["run", recording, "--out", out, "--reference", recording / "reference", "--threads", 1]
    for turn, name in enumerate(STOPS):
        number = STAGES.index(name)
        for finished in (out / "stages").glob(f"{name}-{'[0-9a-f]' * 20}"):
            shutil.rmtree(finished)
        script = STOPPED_WRITING if turn % 2 else STOPPED_IN
        done = lvba(f'"{name}"' if turn % 2 else name, *run, program=("-c", script), code=130)
        assert f"[{number + 2}/{len(STAGES) + 2}] {name}" in done.stderr
        assert done.stderr.splitlines()[-1].startswith("lvba: stopped; finished stages are kept")
        kept = sorted(p.name.rsplit("-", 1)[0] for p in (out / "stages").glob("[!.]*"))
        assert kept in (sorted(STAGES[:number]), sorted(STAGES[: number + 1]))
        assert not (out / "map.ply").exists()
    lvba(*run)
    assert all(reused(out)[name] for name in STAGES[:-1])
    assert bytes_of(out) == bytes_of(undisturbed[0])


def test_interrupt_where_nobody_looks_stops_it_all_the_same(recording, lvba, tmp_path):
    done = lvba("run", recording, "--out", tmp_path / "out", program=("-c", STOPPED_WHILE_BUSY), code=130)
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("lvba: stopped; finished stages are kept")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_from_outside_stops_it_with_one_line(recording, tmp_path, number):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "service.cli", "run", str(recording), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(f"[4/{len(STAGES) + 2}]"):
            break
    time.sleep(0.2)
    process.send_signal(number)
    rest = process.stderr.read()
    assert process.wait(60) == (130 if number == signal.SIGINT else 1)
    assert "Traceback" not in rest
    assert rest.splitlines()[-1].startswith("lvba: stopped; finished stages are kept in")
    assert len([p for p in (tmp_path / "out" / "stages").iterdir() if p.name[0] != "."]) >= 2


def test_damaged_stage_is_made_again_and_said(undisturbed, recording, lvba, tmp_path):
    out = shutil.copytree(undisturbed[0], tmp_path / "out")
    before = bytes_of(out)
    stage = next((out / "stages").glob("visual-gate-*"))
    damaged = stage / "zarr.json"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    done = lvba("run", recording, "--out", out, "--reference", recording / "reference")
    assert "it is made again" in done.stderr
    assert [name for name, again in reused(out).items() if not again and name in STAGES] == ["visual-gate"]
    assert bytes_of(out) == before


def test_changed_setting_redoes_only_what_depends_on_it(undisturbed, recording, lvba, tmp_path):
    # a copy: others compare what they make with the whole of the original
    out = shutil.copytree(undisturbed[0], tmp_path / "out")
    run = ["run", recording, "--out", out, "--reference", recording / "reference"]
    lvba(*run, "--set", "map.voxel_m=0.2")
    assert [name for name, again in reused(out).items() if not again and name in STAGES] == ["map", "facts"]
    lvba(*run)
    assert all(reused(out)[name] for name in STAGES)


def test_python_call_gives_the_same_bytes_as_the_command(undisturbed, recording, tmp_path):
    import lvba

    result = lvba.refine(lvba.open_dataset(recording), lvba.Config())
    result.write(tmp_path / "out")
    assert bytes_of(tmp_path / "out") == bytes_of(undisturbed[0])
