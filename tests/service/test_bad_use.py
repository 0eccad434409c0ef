"""Everything a user can get wrong ends with one line on stderr that says what and how to mend it, and exit code 2."""

import os
import shutil
from pathlib import Path

import pytest
from forked import run_forked

AS_SHELL = "import os, sys; os.execvp('bash', ['bash', '-c', sys.argv[1], sys.executable, *sys.argv[2:]])"
"""A program for `lvba` that runs it below a shell command."""

COMMANDS = ["run", "evaluate", "simulate", "inspect", "view", "export"]


@pytest.mark.parametrize("command", [(), *((c,) for c in COMMANDS)])
def test_help_has_examples(lvba, command):
    done = lvba(*command, "--help")
    assert "examples:\n  lvba " in done.stdout
    assert done.stderr == ""


def test_version(lvba):
    assert lvba("--version").stdout.startswith("lvba ")


def assert_one_line(done, *words):
    shown = [line for line in done.stderr.splitlines() if line.startswith("lvba")]
    assert len(shown) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in shown[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["required: COMMAND"]),
        (["rum"], ["invalid choice: 'rum'"]),
        (["run"], ["RECORDING, --out"]),
        (["run", "D", "--out", "O", "--bogus"], ["--bogus"]),
        (["run", "D", "--out", "O", "--threads", "0"], ["--threads"]),
        (["run", "D", "--out", "O", "--threads", "1e9"], ["--threads", "1e9 is no whole number"]),
        (["import", "D", "--out", "O", "--rate", "fast"], ["--rate", "fast is no number"]),
        (["run", "D", "--out", "O", "--workers", "0"], ["--workers", "not 1 or more"]),
        (["run", "D", "--out", "O", "--workers", "1", "--scheduler", "tcp://a:1"], ["not allowed with"]),
        (["run", "D", "--out", "O", "--scheduler", "a:1"], ["a:1", "write tcp://HOST:PORT"]),
        (["run", "D", "--out", "O", "--scheduler", "tls://a:1"], ["tls://a:1", "--tls-ca"]),
        (["run", "D", "--out", "O", "--scheduler", "tls://a:1", "--tls-ca", "f"], ["give all three"]),
        (["run", "D", "--out", "O", "--tls-ca", "f"], ["--tls-ca", "--scheduler"]),
        (["worker", "tcp://a:1", "--memory-limit", "much"], ["much", "8GB"]),
        (["worker", "http://a:1"], ["http://a:1", "write tcp://HOST:PORT"]),
        (["batch", "missing.yaml", "--out", "O"], ["missing.yaml"]),
        (["batch", "typo.yaml", "--out", "O"], ["typo.yaml", "not a list"]),
        (["run", "D", "--out", "O", "--set", "visual.ptch=3"], ["visual.ptch", "did you mean visual.patch?"]),
        (["run", "D", "--out", "O", "--set", "visual.patch=many"], ["visual.patch", "not a whole number"]),
        (["run", "D", "--out", "O", "--set", "visual.patch=4"], ["patch is 4", "odd"]),
        (["run", "D", "--out", "O", "--set", "visual.patch"], ["name=value"]),
        (["run", "D", "--out", "O", "--config", "missing.yaml"], ["missing.yaml"]),
        (["run", "D", "--out", "O", "--config", "bad.yaml"], ["bad.yaml:2", "not YAML"]),
        (["run", "D", "--out", "O", "--config", "typo.yaml"], ["typo.yaml", "lidra", "did you mean lidar?"]),
        (["run", "D", "--out", "O"], ["D: no such", "check the path"]),
        (["evaluate", "D", "--out", "O"], ["D: no such"]),
        (["view", "D"], ["D: no such", "check the path"]),
        (["view", "."], ["holds no report.json", "`lvba run` wrote"]),
        (["view", "bad.yaml"], ["bad.yaml: is no result"]),
        (["run", "empty", "--out", "O"], ["empty"]),
    ],
)  # fmt: skip
def test_mistake_in_one_line(tmp_path, arguments, words):
    (tmp_path / "bad.yaml").write_text("lidar:\n  a: }\n")
    (tmp_path / "typo.yaml").write_text("lidra: {}\n")
    (tmp_path / "empty").mkdir()
    assert_one_line(run_forked(*arguments, code=2, cwd=tmp_path), *words)
    assert not (tmp_path / "O").exists()


@pytest.fixture
def copy(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "recording")


@pytest.mark.parametrize("out", [".", "all_image", "all_pcd_body/deeper"])
def test_out_cannot_be_the_recording(copy, out):
    before = sorted(copy.rglob("*"))
    assert_one_line(run_forked("run", copy, "--out", copy / out, code=2), "is the recording itself")
    assert sorted(copy.rglob("*")) == before


def test_out_cannot_be_another_recording(copy, recording):
    assert_one_line(run_forked("run", recording, "--out", copy, code=2), "holds a recording")


@pytest.mark.parametrize("name", ["map.ply", "image_poses.txt", "report.json", "config.yaml"])
def test_out_holds_such_a_file_of_somebody_else(recording, tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("{}")
    for command in ("run", "evaluate"):
        done = run_forked(command, recording, "--out", tmp_path / "out", code=2)
        assert_one_line(done, name, "is not of a result of lvba", "choose another folder")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert (tmp_path / "out" / name).read_text() == "{}"


def test_a_run_that_makes_nothing_leaves_no_stages(recording, tmp_path):
    done = run_forked("run", recording, "--out", tmp_path / "out", "--redo", "nothing", code=2)
    assert_one_line(done, "--redo nothing")
    assert not (tmp_path / "out" / "stages").exists()


@pytest.mark.parametrize("name", ["walk.bag", "walk.mcap", "walk_0.db3", "walk/metadata.yaml"])
def test_a_bag_that_is_none_is_told(tmp_path, name):
    given = tmp_path / name
    given.parent.mkdir(exist_ok=True)
    given.write_text("")
    if given.name == "metadata.yaml":
        given = given.parent
        (given / "walk_0.db3").write_text("")
    done = run_forked("run", given, "--out", tmp_path / "out", code=2)
    assert_one_line(done, tmp_path.name, "walk", ";")


def test_a_missing_config_is_reported_as_missing(copy, tmp_path):
    (copy / "config.yaml").unlink()
    done = run_forked("run", copy, "--out", tmp_path / "out", code=2)
    assert_one_line(done, "config.yaml: there is no such file, and so the images have no cam_fx")
    (copy / "other.yaml").write_text("a: 1\n")
    done = run_forked("run", copy, "--out", tmp_path / "out", code=2)
    assert_one_line(done, "none of its YAML files (other.yaml) has cam_fx")


def test_out_is_a_file(recording, tmp_path):
    (tmp_path / "out").write_text("keep me")
    assert_one_line(run_forked("run", recording, "--out", tmp_path / "out", code=2), "out")
    assert (tmp_path / "out").read_text() == "keep me"


def test_out_that_cannot_be_written(recording, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o555)
    # permissions do not bind root, but not even root may make folders in /proc
    out = Path("/proc/out") if os.getuid() == 0 else tmp_path / "locked" / "out"
    assert_one_line(run_forked("run", recording, "--out", out, code=2), str(out), "; ")


def test_full_disk_loses_nothing_and_the_same_command_goes_on(lvba, recording, undisturbed, tmp_path):
    # after `undisturbed`: the limit would also keep compiled kernels from being cached
    out = tmp_path / "out"
    command = 'ulimit -f 200; exec "$0" -m service.cli "$@"'
    run = ["run", recording, "--out", out, "--reference", recording / "reference"]
    done = lvba(*run, program=("-c", AS_SHELL, command), code=2)
    assert_one_line(done, str(out), "file")
    assert not list((out / "stages").glob(".partial*"))
    kept = {p.name for p in (out / "stages").glob("[!.]*")}
    lvba(*run)
    assert kept < {p.name for p in (out / "stages").iterdir()}
    assert (out / "map.ply").read_bytes() == (undisturbed[0] / "map.ply").read_bytes()


def test_two_runs_into_one_folder(recording, tmp_path):
    from workers.store import lock

    out = tmp_path / "out"
    with lock(out / "stages"):
        assert_one_line(run_forked("run", recording, "--out", out, code=2), "another run is writing here")


def test_reference_without_poses(recording, tmp_path):
    (tmp_path / "truth").mkdir()
    done = run_forked("run", recording, "--out", tmp_path / "out", "--reference", tmp_path / "truth", code=2)
    assert_one_line(done, "truth", "holds no poses")
