"""`lvba batch`: one that fails does not stop the others, and the same command continues."""

import contextlib
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

from lvba.errors import InputError
from service.cli import batch_manifest

ROOT = Path(__file__).resolve().parents[2]

GOOD = [f"good-{number:02}" for number in range(4)]


@pytest.fixture
def manifest(tiny_recording, tmp_path):
    """4 small recordings without images (so that they take little time), one that is not there, one that is damaged."""
    recording, shared = tiny_recording, tmp_path / "shared"
    shutil.copytree(recording / "all_pcd_body", shared / "all_pcd_body")
    shutil.copy(recording / "config.yaml", shared)
    for poses in recording.rglob("lidar_poses.txt"):
        if "reference" not in poses.parts:
            shutil.copy(poses, shared / poses.relative_to(recording))
    for name in GOOD:
        (tmp_path / name).symlink_to(shared)
    shutil.copytree(shared, tmp_path / "damaged")
    next((tmp_path / "damaged").rglob("lidar_poses.txt")).write_text("not a pose\n")
    names = [*GOOD[:3], "missing", "damaged", *GOOD[3:]]
    (tmp_path / "batch.yaml").write_text("".join(f"- {{dataset: {name}, name: {name}}}\n" for name in names))
    return tmp_path / "batch.yaml"


def summary(out):
    return {row["name"]: row for row in json.loads((out / "summary.json").read_text())}


def test_killed_and_given_again_good_ones_are_done_and_bad_ones_say_why(lvba, manifest, tmp_path):
    out = tmp_path / "out"
    kill_when_two_are_done(manifest, out)
    finished = manifests(out)
    done = lvba("batch", manifest, "--out", out, "--jobs", 2, code=1)
    now = manifests(out)
    assert [name for name in finished if now[name] != finished[name]] == []
    rows = summary(out)
    expected = {name: "done" for name in GOOD} | {"missing": "failed", "damaged": "failed"}
    assert {name: row["state"] for name, row in rows.items()} == expected
    assert "check the path" in rows["missing"]["message"]
    assert "lidar_poses.txt:1" in rows["damaged"]["message"]
    assert rows[GOOD[0]]["entropy_after"] < rows[GOOD[0]]["entropy_before"]
    maps = {(out / name / "map.ply").read_bytes() for name in GOOD}
    assert len(maps) == 1
    with (out / "summary.csv").open() as lines:
        assert {row["name"]: row["state"] for row in csv.DictReader(lines)} == expected
    assert dict(line.split()[:2] for line in done.stdout.splitlines()[1:]) == expected
    assert done.stderr.splitlines()[-1].startswith("lvba: 2 of 6 failed; see ")


def kill_when_two_are_done(manifest, out):
    """SIGKILL of the batch, whose recordings that are being refined then stop by themselves."""
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "batch", str(manifest), "--out", str(out), "--jobs", "2"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: (out / GOOD[1] / "report.json").exists() and finished_stages(out / GOOD[2]))
    process.send_signal(signal.SIGKILL)
    process.wait()
    running = [name for name, row in summary(out).items() if row["state"] == "running"]
    assert running
    for name in running:
        wait_until(lambda name=name: has_ended(out, name))


def has_ended(out, name):
    said = (out / f"{name}.log").read_text()
    # stopped, or refused by then; one that had just been started says nothing
    spoke = said.startswith("lvba: ") or "\nlvba: " in said
    return spoke or (out / name / "report.json").exists() or not is_running(out / name)


def is_running(folder):
    """Whether a process has this result folder in its command."""
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if os.fsencode(folder) in command.read_bytes().split(b"\0"):
                return True
    return False


def manifests(out):
    """Of all finished stages: they hold times, and are new where a stage was done again."""
    return {path: path.read_bytes() for path in out.glob("*/stages/[!.]*/manifest.json")}


def finished_stages(out):
    return {p.name.rsplit("-", 1)[0] for p in (out / "stages").glob("[!.]*-*")}


def wait_until(condition):
    deadline = time.monotonic() + 180
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_bag_is_imported_as_its_entry_says(lvba, bags, tmp_path):
    """Files of the import are relative to the manifest."""
    (tmp_path / "camera.yaml").write_text("cam0: {}\n")
    entries = [
        f"- {{dataset: {bags / 'walk.bag'}, name: named, import: {{image: none, lidar: /nothing}}}}",
        f"- {{dataset: {bags / 'walk.bag'}, name: filed, import: {{calibration: [camera.yaml]}}}}",
    ]
    (tmp_path / "m.yaml").write_text("\n".join(entries))
    assert batch_manifest.read(tmp_path / "m.yaml")[1].imported.calibration == (
        str(tmp_path / "camera.yaml"),
    )
    lvba("batch", tmp_path / "m.yaml", "--out", tmp_path / "out", code=1)
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())
    said = {row["name"]: row["message"] for row in rows}
    assert "/nothing" in said["named"]
    assert "/lidar/points" in said["named"]
    assert "camera.yaml" in said["filed"]


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
        ("- &a [1]\n- *a", "aliases .* are not read"),
        ("[" * 3000, "nested too deep"),
        ("- name: a", "entry 1: has no `dataset`"),
        ("- {dataset: a, threads: 3}", "unknown field 'threads'"),
        ("- dataset: x/a\n- dataset: y/a", "two entries are named 'a'"),
        ("- {dataset: a, name: ../b}", "cannot be the name of a folder"),
        ("- {dataset: a, set: x=1}", "`set` is not a list"),
        ("- {dataset: a.bag, import: lidar}", "`import` is no list"),
        ("- {dataset: a.bag, import: {lydar: /x}}", "entry 1, import"),
        ("- {dataset: a.bag, import: {conventions: {time: never}}}", "--convention time"),
    ],
)
def test_mistake_in_the_manifest(tmp_path, text, words):
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        batch_manifest.read(tmp_path / "m.yaml")
