"""`lvba run --events` and `--redo`: what programs read along, and stages made again on demand."""

import errno
import json
import pickle
import shutil
from contextlib import nullcontext

import pytest

from lvba.errors import DegenerateProblemError, InputError, Lack
from lvba.io import files
from service.cli import dispatch, main
from service.cli.event_display import EventDisplay


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def kinds(path):
    return [line["event"] for line in lines(path)]


def test_run_tells_stages_progress_records_and_its_end(undisturbed, recording, lvba, tmp_path):
    out = shutil.copytree(undisturbed[0], tmp_path / "out")
    events = tmp_path / "events.jsonl"
    lvba("run", recording, "--out", out, "--reference", recording / "reference", "--redo", "map",
         "--events", events)  # fmt: skip
    told = lines(events)
    names = next(line["names"] for line in told if line["event"] == "stages")
    assert names[0] == "input"
    assert names[-1] == "write"
    begun = {line["name"]: line["reused"] for line in told if line["event"] == "stage"}
    assert list(begun) == names
    assert [name for name, reused in begun.items() if reused is False] == ["map", "facts"]
    assert any(line["stage"] == "map" for line in told if line["event"] == "progress")
    recorded = {line["name"]: line["reused"] for line in told if line["event"] == "record"}
    assert [name for name, reused in recorded.items() if not reused] == ["input", "map", "facts"]
    assert told[-1]["event"] == "end"
    assert (told[-1]["code"], told[-1]["reason"]) == (0, "done")
    assert (out / "map.ply").read_bytes() == (undisturbed[0] / "map.ply").read_bytes()


def test_redo_makes_what_depends_on_the_stage_again(undisturbed, recording, lvba, tmp_path):
    out = shutil.copytree(undisturbed[0], tmp_path / "out")
    lvba("run", recording, "--out", out, "--reference", recording / "reference", "--redo", "visual-gate")
    stages = json.loads((out / "report.json").read_text())["stages"]
    again = [stage["name"] for stage in stages if not stage["reused"]]
    assert again == [
        *("input", "visual-gate", "evaluate-result", "expected-error"),
        *("map", "planes", "renderings", "pictures", "facts"),
    ]


def test_redo_of_no_stage_names_those_there_are(recording, lvba, tmp_path):
    events = tmp_path / "events.jsonl"
    done = lvba("run", recording, "--out", tmp_path / "out", "--redo", "colour", "--events", events, code=2)
    assert (
        "there is no such stage; one of these: survey, sensor-errors, scan-motion, scan-errors, scans, lidar,"
        in done.stderr
    )
    end = lines(events)[-1]
    assert (end["code"], end["where"], end["problem"]) == (2, "--redo colour", "there is no such stage")
    assert end["reason"] == "input"


@pytest.mark.parametrize(
    ("error", "code", "reason"),
    [
        (InputError("map.ply", "cannot be read", "check it"), 2, "input"),
        (files.input_error("map.ply", OSError(errno.ENOSPC, "pas d'espace disponible")), 2, "disk-full"),
        (files.input_error("map.ply", OSError(errno.ENOMEM, "x")), 2, "out-of-memory"),
        (OSError(errno.EDQUOT, "x", "map.ply"), 2, "disk-full"),
        (DegenerateProblemError("out of memory is not what this is"), 1, "failed"),
        (MemoryError(), 1, "out-of-memory"),
        (KeyboardInterrupt(), 1, "stopped"),
        (ZeroDivisionError(), 1, "unexpected"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_end_tells_why_by_a_word_for_programs(monkeypatch, tmp_path, error, code, reason):
    def fail(*_):
        raise error

    monkeypatch.setattr(dispatch, "_command", lambda name: fail)
    events = tmp_path / "events.jsonl"
    arguments = main.parser().parse_args(["run", "x", "--out", str(tmp_path), "--events", str(events)])
    with pytest.raises(ZeroDivisionError) if reason == "unexpected" else nullcontext():
        assert dispatch.main(arguments) == code
    assert (lines(events)[-1]["code"], lines(events)[-1]["reason"]) == (code, reason)


def test_error_of_a_worker_keeps_what_the_machine_lacked():
    error = pickle.loads(pickle.dumps(files.input_error("map.ply", OSError(errno.ENOSPC, "x"))))
    assert error.lack is Lack.DISK


def test_events_go_on_in_a_file_that_is_there(tmp_path):
    for number in range(2):
        display = EventDisplay(tmp_path / "events", quiet=True)
        display.stage("lidar", number, 2)
    assert [line["index"] for line in lines(tmp_path / "events")] == [0, 1]


def test_progress_of_one_count_is_told_a_few_times_a_second(tmp_path):
    now = [0.0]
    display = EventDisplay(tmp_path / "events", clock=lambda: now[0], quiet=True)
    for done in range(100):
        now[0] += 0.01
        display.progress("points", done, 100)
    display.progress("images", 0, 3)
    told = lines(tmp_path / "events")
    assert 3 <= sum(line["what"] == "points" for line in told) <= 5
    assert told[-1]["what"] == "images"


def test_events_that_cannot_be_written_are_one_line(recording, lvba, tmp_path):
    done = lvba("run", recording, "--out", tmp_path / "out", "--events", tmp_path / "no" / "file", code=2)
    assert done.stderr.count("\n") == 1
    assert "give --events another file" in done.stderr
    with pytest.raises(InputError):
        EventDisplay(tmp_path / "no" / "file")
