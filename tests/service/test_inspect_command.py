"""`lvba inspect`: text and JSON on bags and folders, one line where there is nothing, and nothing is written."""

import json

import pytest
from raw_records import everything, source_of
from test_bad_use import assert_one_line

from lvba.sources.bags.writing import BagForm, write_bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspect")
    write_bag(source_of(everything()), folder / "a walk.bag", BagForm.ROS1)
    return folder / "a walk.bag"


def test_text_has_streams_conventions_and_the_line_to_type(lvba, bag):
    before = bag.read_bytes()
    shown = lvba("inspect", bag).stdout
    assert "ROS 1 bag, " in shown.splitlines()[0]
    assert (
        "times of points: offset_time, ns from the stamp; a sweep takes 0.098 s; the stamp is start of the sweep"
        in shown
    )
    assert "missing: no camera: give its intrinsics, --calibration FILE" in shown
    last = shown.splitlines()[-1]
    assert last.startswith(f"next:  lvba import '{bag}' --lidar /livox --image /")
    assert last.endswith("--odometry /odometry --imu /imu --calibration FILE --out RECORDING")
    assert list(bag.parent.iterdir()) == [bag]
    assert bag.read_bytes() == before


def test_json_has_the_same(lvba, bag):
    facts = json.loads(lvba("inspect", bag, "--json").stdout)
    assert facts["format"] == "ROS 1 bag"
    scans = next(stream for stream in facts["streams"] if stream["kind"] == "scans")
    assert (scans["name"], scans["count"], scans["time_unit"]) == ("/livox", 3, "ns")
    assert facts["next"].startswith("lvba import ")


def test_recording_that_needs_no_import_says_how_to_run_it(lvba, tiny_recording):
    shown = lvba("inspect", tiny_recording).stdout
    assert "recording folder" in shown.splitlines()[0]
    assert shown.splitlines()[-1] == f"next:  lvba run {tiny_recording} --out RESULT"
    facts = json.loads(lvba("inspect", tiny_recording, "--json").stdout)
    assert next(stream for stream in facts["streams"] if stream["kind"] == "scans")["count"] > 0
    assert facts["missing"] == []


def test_what_is_none_is_one_line(lvba, tmp_path):
    (tmp_path / "a.txt").write_text("nothing")
    assert_one_line(lvba("inspect", tmp_path / "a.txt", code=2), "a.txt", "is neither a bag nor a folder")
    assert_one_line(lvba("inspect", tmp_path / "none", code=2), "none")
    (tmp_path / "b.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert_one_line(lvba("inspect", tmp_path / "b.bag", code=2), "b.bag", "its first record is damaged")


@pytest.mark.parametrize("command", [["inspect"], ["import", "--out", "out"]])
def test_a_folder_above_a_source_is_one_line_that_names_it(lvba, tmp_path, command):
    (tmp_path / "walk").mkdir()
    for name in ("rgb.txt", "depth.txt", "1.pkl"):
        (tmp_path / "walk" / name).write_text("")
    done = lvba(command[0], tmp_path, *command[1:], code=2)
    assert_one_line(done, "it holds 2 .txt and 1 .pkl files", f"did you mean {tmp_path / 'walk'}?")


def test_names_of_topics_do_not_rule_the_terminal(lvba, tmp_path):
    items = [(f"/{name[1:]}\x1b[31m\n", record) for name, record in everything()]
    write_bag(source_of(items), tmp_path / "b.bag", BagForm.ROS1)
    shown = lvba("inspect", tmp_path / "b.bag").stdout
    assert "\x1b" not in shown
    assert "/livox\\x1b[31m\\x0a" in shown
