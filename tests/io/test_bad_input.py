"""Every kind of bad input ends in one line that names the file and the fix."""

import codecs
import errno
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_recording

from lvba.errors import InputError
from lvba.io import files, images, pcd, result_folder
from lvba.io.dataset import load_image, load_scan, load_scans, open_dataset
from lvba.io.reference import read_reference


def _remove(*names: str) -> Callable[[Path], None]:
    return lambda root: [(root / name).unlink() for name in names] and None


def _shift_clock(root: Path) -> None:
    path = root / "all_pcd_body" / "lidar_poses.txt"
    path.write_text(path.read_text().replace("1630577758", "12"))


def _empty_folder(root: Path) -> None:
    for path in small_recording.scan_files(root):
        path.unlink()


def _each(find: Callable[[Path], list[Path]], change: Callable[[Path], object]) -> Callable[[Path], None]:
    return lambda root: [change(path) for path in find(root)] and None


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def _lie(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b" 50\n", b" 40\n"))


def _two_sizes(root: Path) -> None:
    for path in small_recording.image_files(root)[:2]:
        images.write_image(path, np.zeros((12, 16, 3), np.uint8))
    small_recording.image_files(root)[3].unlink()


def _replace(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        text = (root / name).read_text()
        assert old in text
        (root / name).write_text(text.replace(old, new))

    return change


def _bad_rotation(root: Path) -> None:
    path = root / "all_image" / "image_poses.txt"
    lines = path.read_text().splitlines()
    lines[2] = " ".join([*lines[2].split()[:4], "0.5", "0", "0", "0.5"])
    path.write_text("\n".join(lines))


def _write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes(content)


SCANS, PICTURES = small_recording.scan_files, small_recording.image_files
NAN = np.full((20, 3), np.nan)
GARBAGE = bytes(range(256)) * 20

CASES = {
    "no scan poses": (_remove("all_pcd_body/lidar_poses.txt"), "lidar_poses.txt", "no poses"),
    "no image poses": (_remove("all_image/image_poses.txt"), "image_poses.txt", "no poses"),
    "empty poses": (_write("all_pcd_body/lidar_poses.txt", b""), "lidar_poses.txt", "holds no poses"),
    "poses of another clock": (_shift_clock, "lidar_poses.txt", "another clock: they are from 12.000 to 12.500 s"),
    "no scans": (_empty_folder, "all_pcd_body", "holds no scans"),
    "no images": (_each(PICTURES, Path.unlink), "all_image", "holds no images"),
    "truncated scans": (_each(SCANS, _cut), ".pcd", "truncated: 50 points need 800 bytes of data, the file holds 760"),
    "truncated images": (_each(PICTURES, _cut), ".png", "truncated"),
    "lying headers": (_each(SCANS, _lie), ".pcd", "the header says 40 points, the file holds 50"),
    "scans of NaN": (_each(SCANS, lambda path: pcd.write_pcd(path, NAN)), ".pcd", "none of its 20 points has a finite"),
    "empty scans": (_each(SCANS, lambda path: pcd.write_pcd(path, NAN[:0])), ".pcd", "an empty scan"),
    "garbage scans": (_each(SCANS, lambda path: path.write_bytes(GARBAGE)), ".pcd", "no PCD header"),
    "garbage images": (_each(PICTURES, lambda path: path.write_bytes(GARBAGE)), ".png", "neither PNG nor JPEG"),
    "garbage poses": (_write("all_pcd_body/lidar_poses.txt", GARBAGE), "lidar_poses.txt", "binary"),
    "garbage config": (_write("config.yaml", GARBAGE), "config.yaml", "binary"),
    "images of two sizes": (_two_sizes, ".png", "images of different sizes: 32 x 24, but 16 x 12 in"),
    "a rotation that is none": (_bad_rotation, "image_poses.txt:3", "no rotation: its length is 0.707107"),
    "an extrinsic that is none": (_replace("config.yaml", "-1, 1, 0, 0]", "-1, 1, 0, 1]"), "config.yaml", "Rcl is no"),
    "no fx": (_replace("config.yaml", "  cam_fx: 30.5\n", ""), "config.yaml", "cam_fx is missing"),
    "no config": (_remove("config.yaml"), "config.yaml", "no cam_fx"),
    "no extrinsics": (_replace("config.yaml", "cl:", "xx:"), "config.yaml", "no Rcl and Pcl"),
    "another camera's calibration": (_replace("config.yaml", ": 32", ": 40"), "config.yaml", "images are 32 x 24"),
}  # fmt: skip


def _one_line(error: InputError) -> str:
    text = str(error)
    assert len(text.splitlines()) == 1
    assert text == f"{error.where}: {error.problem}; {error.mend}"
    assert error.mend
    return text


@pytest.mark.parametrize("name", CASES)
def test_opening_bad_input_says_what_and_where(tmp_path: Path, name: str):
    damage, where, problem = CASES[name]
    root = small_recording.write(tmp_path)
    damage(root)
    with pytest.raises(InputError) as caught:
        open_dataset(root)
    text = _one_line(caught.value)
    assert where in caught.value.where
    assert str(root) in caught.value.where
    assert problem in text


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("missing", "no such file or directory"),
        ("config.yaml", "is a file, not a folder"),
        ("all_image", "is a part of a recording"),
        ("all_pcd_body", "is a part of a recording"),
        (".", "all_pcd_body: there is no such folder"),
        ("two\nlines", "no such file or directory"),
        ("n" * 300, "too long"),
        ("zero\0byte", "not a path"),
        ("\udcff", "no such file or directory"),
        ("\ud800", "not a path"),
    ],
)
def test_a_wrong_folder_is_named(tmp_path: Path, name: str, problem: str):
    root = small_recording.write(tmp_path / "recording")
    with pytest.raises(InputError) as caught:
        open_dataset(tmp_path if name == "." else f"{root}/{name}")
    assert problem in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    str(caught.value).encode()


def test_what_turns_bad_after_opening_is_named_when_it_streams(tmp_path: Path):
    found = open_dataset(small_recording.write(tmp_path))
    Path(found.scan_paths[1]).unlink()
    _cut(Path(found.scan_paths[2]))
    images.write_image(found.image_paths[0], np.zeros((9, 9, 3), np.uint8))
    _cut(Path(found.image_paths[1]))
    for load, index, problem in (
        (load_scan, 1, "no such file"),
        (load_scan, 2, "truncated"),
        (load_image, 0, "9 x 9 px instead of 32 x 24"),
        (load_image, 1, "truncated"),
    ):
        with pytest.raises(InputError, match=problem) as caught:
            load(found, index)
        assert _one_line(caught.value)
    with pytest.raises(InputError, match="no such file"):
        load_scans(found)


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_reference_without_poses_is_named(tmp_path: Path, name: str):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=name):
        read_reference(tmp_path / name)


def test_a_result_below_a_file_cannot_be_written(tmp_path: Path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / "file" / "a" / "b"):
        with pytest.raises(InputError) as caught:
            result_folder.prepare(out)
        assert str(out) in _one_line(caught.value)


@pytest.fixture
def no_root():
    """Runs the test without the rights of root, which may write anywhere."""
    before = os.geteuid()
    for codec in ("ascii", "utf-8-sig"):  # read from files at first use, which may be of root alone
        codecs.lookup(codec)
    if before == 0:
        os.seteuid(65534)
    yield
    os.seteuid(before)


def test_a_result_without_permission_cannot_be_written(no_root: None):
    with tempfile.TemporaryDirectory() as folder:
        locked = Path(folder) / "locked"
        locked.mkdir(mode=0o500)
        for out in (locked, locked / "out"):
            with pytest.raises(InputError, match="permission denied; give yourself permission"):
                result_folder.prepare(out)


def test_a_recording_without_permission_cannot_be_read(no_root: None):
    with tempfile.TemporaryDirectory() as folder:
        root = small_recording.write(Path(folder) / "in")
        first, *_, last = small_recording.scan_files(root)
        first.chmod(0)
        assert len(open_dataset(root).scan_paths) == 5
        poses = root / "all_pcd_body" / "lidar_poses.txt"
        poses.chmod(0)
        with pytest.raises(InputError, match=r"lidar_poses\.txt: permission denied"):
            open_dataset(root)
        (root / "all_pcd_body").chmod(0)
        with pytest.raises(InputError, match="permission denied"):
            open_dataset(root)
        (root / "all_pcd_body").chmod(0o700)
        assert last.exists()


def test_a_place_that_even_root_cannot_write_is_named():
    with pytest.raises(InputError, match="/proc/lvba"):
        result_folder.prepare("/proc/lvba")


def test_a_full_disk_is_named_and_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "poses.txt"
    files.write_text(path, "old")

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="no space left on device; free some space"):
        files.write_text(path, "new", durable=True)
    with pytest.raises(InputError, match="no space left on device; free some space"):
        result_folder.prepare(tmp_path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.txt"]


_WRITES_TOO_MUCH = """
import resource, sys
from lvba.errors import InputError
from lvba.io import files
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
try:
    files.write_bytes(sys.argv[1], bytes(100_000))
except InputError as error:
    sys.exit(str(error))
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limits on this system")
def test_a_real_limit_of_the_system_is_named_too(tmp_path: Path):
    path = tmp_path / "map.ply"
    path.write_bytes(b"old")
    done = subprocess.run(
        [sys.executable, "-c", _WRITES_TOO_MUCH, path], capture_output=True, text=True, check=False
    )
    assert "map.ply: file too large" in done.stderr
    assert done.returncode == 1
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.ply"]


def test_written_files_can_be_read_by_others_as_the_umask_says(tmp_path: Path):
    files.write_text(tmp_path / "a", "a")
    (tmp_path / "b").write_text("b")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_other_errors_pass_and_are_not_taken_for_bad_paths(tmp_path: Path):
    with pytest.raises(ValueError, match="broadcast"), files.as_input_error(tmp_path):
        np.zeros(2) + np.zeros(3)


def test_a_huge_file_is_not_read(tmp_path: Path):
    """A sparse file of a terabyte takes no disk, and no memory either."""
    root = small_recording.write(tmp_path)
    for path in (small_recording.scan_files(root)[0], small_recording.image_files(root)[0]):
        with open(path, "r+b") as file:
            file.truncate(2**40)
    found = open_dataset(root)
    assert (len(found.scan_paths), len(found.image_paths)) == (5, 4)
    for name in ("all_pcd_body/lidar_poses.txt", "config.yaml"):
        with open(root / name, "r+b") as file:
            file.truncate(2**40)
        with pytest.raises(InputError, match="more than"):
            open_dataset(root)


@pytest.mark.parametrize("below", ["", "x", "x/y"])
def test_a_folder_through_a_link_to_nothing_names_the_link(tmp_path: Path, below: str):
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(
        InputError, match=r"dangling: is a symbolic link to .*nowhere, which does not exist; make"
    ):
        files.make_folder(tmp_path / "dangling" / below)
    (tmp_path / "nowhere").mkdir()
    assert files.make_folder(tmp_path / "dangling" / below).is_dir()
