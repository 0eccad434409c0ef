"""`lvba batch`: one that fails does not stop the others, and the same command goes on."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ROOT

from lvba.errors import InputError
from service import batch_manifest


@pytest.fixture
def manifest(recording, tmp_path):
    """Two recordings without images (so that they take little time), one that is not there, one that is damaged."""
    for name in ("first", "second", "damaged"):
        shutil.copytree(recording / "all_pcd_body", tmp_path / name / "all_pcd_body")
        shutil.copy(recording / "config.yaml", tmp_path / name)
        for poses in recording.rglob("lidar_poses.txt"):
            if "reference" not in poses.parts:
                shutil.copy(poses, tmp_path / name / poses.relative_to(recording))
    next((tmp_path / "damaged").rglob("lidar_poses.txt")).write_text("not a pose\n")
    names = (
        "dataset: first",
        "dataset: missing",
        "dataset: damaged",
        "{dataset: second, set: [map.voxel_m=0.2]}",
    )
    (tmp_path / "batch.yaml").write_text("".join(f"- {name}\n" for name in names))
    return tmp_path / "batch.yaml"


def summary(out):
    return {row["name"]: row for row in json.loads((out / "summary.json").read_text())}


def test_killed_and_given_again_good_ones_are_done_and_bad_ones_say_why(lvba, manifest, tmp_path):
    out = tmp_path / "out"
    kill_in_the_first(manifest, out)
    kept = finished_stages(out / "first")
    done = lvba("batch", manifest, "--out", out, "--jobs", 2, code=1)
    rows = summary(out)
    assert {name: row["state"] for name, row in rows.items()} == {
        "first": "done", "missing": "failed", "damaged": "failed", "second": "done",
    }  # fmt: skip
    assert "check the path" in rows["missing"]["message"]
    assert "lidar_poses.txt:1" in rows["damaged"]["message"]
    assert rows["first"]["entropy_after"] < rows["first"]["entropy_before"]
    assert (out / "second" / "map.ply").exists()
    with (out / "summary.csv").open() as lines:
        assert [row["state"] for row in csv.DictReader(lines)] == ["done", "failed", "failed", "done"]
    assert [line.split()[:2] for line in done.stdout.splitlines()[1:]] == [
        ["first", "done"], ["missing", "failed"], ["damaged", "failed"], ["second", "done"],
    ]  # fmt: skip
    assert done.stderr.splitlines()[-1].startswith("lvba: 2 of 4 failed; see ")
    stages = json.loads((out / "first" / "report.json").read_text())["stages"]
    assert {stage["name"] for stage in stages if stage["reused"]} == kept


def kill_in_the_first(manifest, out):
    """SIGKILL of the batch while its first recording is being refined, which then stops by itself."""
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "batch", str(manifest), "--out", str(out)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: finished_stages(out / "first"))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert summary(out)["first"]["state"] == "running"
    wait_until(
        lambda: "stopped" in (out / "first.log").read_text() or (out / "first" / "report.json").exists()
    )


def finished_stages(out):
    return {p.name.rsplit("-", 1)[0] for p in (out / "stages").glob("[!.]*-*")}


def wait_until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_groups_take_turns(tmp_path):
    text = "".join(
        f"- {{dataset: {name}, group: {name[0]}}}\n" for name in ("a1", "a2", "a3", "b1", "b2", "c1")
    )
    (tmp_path / "m.yaml").write_text(text)
    entries = batch_manifest.in_turns(batch_manifest.read(tmp_path / "m.yaml"))
    assert [entry.name for entry in entries] == ["a1", "b1", "c1", "a2", "b2", "a3"]


def test_paths_are_relative_to_the_manifest(tmp_path):
    (tmp_path / "m.yaml").write_text("- {dataset: a/b, config: c.yaml, reference: /truth, set: [x=1]}\n")
    (entry,) = batch_manifest.read(Path(tmp_path / "m.yaml"))
    assert (entry.name, entry.dataset, entry.config) == ("b", tmp_path / "a" / "b", tmp_path / "c.yaml")
    assert entry.reference == Path("/truth")
    assert entry.settings == ("x=1",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not a list"),
        ("dataset: a", "not a list"),
        ("- a: }", "not YAML"),
        ("- name: a", "entry 1: has no `dataset`"),
        ("- {dataset: a, threads: 3}", "unknown field 'threads'"),
        ("- dataset: x/a\n- dataset: y/a", "two entries are named 'a'"),
        ("- {dataset: a, name: ../b}", "cannot be the name of a folder"),
        ("- {dataset: a, set: x=1}", "`set` is not a list"),
    ],
)
def test_mistake_in_the_manifest(tmp_path, text, words):
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        batch_manifest.read(tmp_path / "m.yaml")
