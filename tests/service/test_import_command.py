"""`lvba import` as a user types it: a bag to a recording folder, killed in the midst, and what a mistake says."""

import signal
import time
from pathlib import Path

import pytest
from forked import ForkedProcess, run_forked

from lvba.io.dataset import open_dataset
from lvba.simulate import raw
from lvba.simulate.raw import Sensors
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag

SENSORS = Sensors(points=800, width=64, height=48, image_hz=5.0)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "walk.bag"
    source, _ = raw.simulate_raw("courtyard", seconds=2.0, sensors=SENSORS)
    write_bag(source, path, BagForm.ROS1, PointLayout.LIVOX_CUSTOM_2)
    return path


@pytest.fixture(scope="module")
def whole(bag, tmp_path_factory):
    """An import of it."""
    out = tmp_path_factory.mktemp("import") / "whole"
    return run_forked("import", bag, "--out", out), out


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def test_a_bag_becomes_a_recording_folder_and_says_what_was_decided(whole):
    done, out = whole
    dataset = open_dataset(out)
    assert len(dataset.scan_paths) == 20
    assert len(dataset.image_paths) == 10
    assert "20 scans and 10 images, imported" in done.stdout
    assert "times of points: ns, from the stamp of the scan" in done.stdout
    assert "pose_direction: world_from (by the data: " in done.stdout
    assert "Traceback" not in done.stderr


def test_killed_in_the_midst_the_same_command_gives_the_same_bytes(bag, whole, tmp_path):
    out = tmp_path / "killed"
    process = ForkedProcess(["import", bag, "--out", out], tmp_path / "log", {})
    scans = out / "all_pcd_body"
    while process.poll() is None and not (scans.is_dir() and any(scans.glob("*.pcd"))):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    run_forked("import", bag, "--out", out)
    assert contents(out) == contents(whole[1])
    assert "imported before" in run_forked("import", bag, "--out", out).stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--lidar", "/nothing"], "--lidar /nothing"),
        (["--preset", "kitti"], "choose one of hilti-2022, hilti-2023, m2dgr"),
        (["--camera", "cam1"], "give --calibration FILE"),
        (["--odometry", "nowhere.txt"], "no such file"),
        (["--convention", "pose_of=wheel"], "body, lidar, camera"),
        (["--time-convention", "middle", "--convention", "time=none"], "is no answer"),
    ],
)
def test_a_mistake_is_one_line(bag, tmp_path, options, words):
    done = run_forked("import", bag, "--out", tmp_path / "out", *options, code=2)
    [line] = [line for line in done.stderr.splitlines() if line.startswith("lvba:")]
    assert words in line


def test_a_run_of_a_bag_imports_it_first(bag, tmp_path):
    """Settings are looked at before anything is written; the recording is there when the run has begun."""
    out = tmp_path / "out"
    run_forked("run", bag, "--out", out, "--redo", "nothing", code=2)
    assert len(open_dataset(out / "recording").scan_paths) == 20


def test_a_recording_needs_no_import_unless_options_ask_for_a_change(tiny_recording, tmp_path):
    done = run_forked("import", tiny_recording, "--out", tmp_path / "out", code=2)
    [line] = [line for line in done.stderr.splitlines() if line.startswith("lvba:")]
    assert line.endswith(f"run it as it is: lvba run {tiny_recording} --out RESULT")
    assert not (tmp_path / "out").exists()
    change = ["--odometry", "scan_poses", "--lidar", "/nothing"]
    done = run_forked("import", tiny_recording, "--out", tmp_path / "out", *change, code=2)
    assert "no such stream of scans" in done.stderr
