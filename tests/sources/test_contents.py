"""What is said of a folder that is no source: what it holds, and what in it may be meant."""

import os

import pytest
import rgbd_writers as writers
from raw_records import everything, source_of

from lvba.errors import InputError
from lvba.io.dataset import SCAN_FOLDERS, SCAN_POSES
from lvba.sources import contents
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.opening import open_source


def said(path):
    with pytest.raises(InputError, match="is neither a bag nor a folder of a kind that is known") as error:
        open_source(path)
    assert "\n" not in str(error.value)
    return str(error.value)


def files(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text("")


def test_files_are_counted_by_their_endings(tmp_path):
    files(tmp_path / "lidar", *(f"{i:02}.pkl" for i in range(16)))
    files(tmp_path / "camera" / "front", *(f"{i:02}.JPG" for i in range(20)))
    files(tmp_path / "meta", "gps.json", "poses.json", "LICENSE", "a.1", "b.txt", ".hidden.txt")
    assert ": it holds 20 .jpg, 16 .pkl, 2 .json and 3 other files; docs/sources.md lists" in said(tmp_path)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ((), "it holds no files"),
        (("a.bin",), "it holds 1 .bin file;"),
        (("README", "LICENSE"), "it holds 2 files;"),
        (("a.las", "b.las"), "it holds 2 .las files;"),
    ],
)
def test_few_files_are_said_in_words(tmp_path, names, words):
    files(tmp_path, *names)
    assert words in said(tmp_path)


@pytest.mark.parametrize("below", ["walk", "data/walk"])
def test_a_source_one_or_two_folders_down_is_named(tmp_path, below):
    writers.tum(tmp_path / below)
    (tmp_path / "notes").mkdir()
    assert said(tmp_path).endswith(f"; did you mean {tmp_path / below}?")


def test_bags_and_recordings_further_down_are_named(tmp_path):
    (tmp_path / "one").mkdir()
    write_bag(source_of(everything()), tmp_path / "one" / "walk.bag", BagForm.ROS1)
    write_bag(source_of(everything()), tmp_path / "two", BagForm.SQLITE3)
    files(tmp_path / "three" / SCAN_FOLDERS[0], SCAN_POSES)
    mend = f"did you mean {tmp_path / 'one/walk.bag'}, {tmp_path / 'three'} or {tmp_path / 'two'}?"
    assert mend in said(tmp_path)


def test_of_many_sources_some_are_named(tmp_path):
    for number in range(5):
        files(tmp_path / f"walk{number}", "rgb.txt", "depth.txt")
    assert said(tmp_path).endswith(f"{tmp_path / 'walk1'} or {tmp_path / 'walk2'} (2 more)?")


def test_a_source_three_folders_down_or_behind_a_link_is_not_looked_for(tmp_path):
    writers.tum(tmp_path / "elsewhere")
    writers.tum(tmp_path / "here" / "a" / "b" / "c")
    os.symlink(tmp_path / "elsewhere", tmp_path / "here" / "link")
    os.symlink("/", tmp_path / "here" / "a" / "root")
    assert "did you mean" not in said(tmp_path / "here")


def test_what_is_damaged_or_cannot_be_read_further_down_says_nothing_of_itself(tmp_path):
    files(tmp_path / "damaged", "rgb.txt", "depth.txt", "metadata.yaml")
    files(tmp_path / "bag", "a.db3")
    (tmp_path / "closed").mkdir(mode=0)
    try:
        assert "did you mean" in said(tmp_path)
    finally:
        (tmp_path / "closed").chmod(0o700)


def test_no_more_than_some_folders_and_names_are_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "_MOST_FOLDERS", 4)
    monkeypatch.setattr(contents, "_MOST_NAMES", 30)
    looked = []
    scan = os.scandir
    monkeypatch.setattr(contents.os, "scandir", lambda path: looked.append(path) or scan(path))
    for number in range(10):
        files(tmp_path / f"{number}", "a.pkl", "b.pkl")
    assert "it holds at least 8 .pkl files" in said(tmp_path)
    assert looked == [tmp_path, *(tmp_path / f"{number}" for number in range(4))]
    files(tmp_path, *(f"{number}.las" for number in range(100)))
    assert contents.look(tmp_path).partial
    assert contents.look(tmp_path).endings.total() <= 30
