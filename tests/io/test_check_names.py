"""Names, poses and calibration alone: the same words as from opening, before anything of scans and images is read."""

import shutil
from pathlib import Path

import pytest
import small_recording

from lvba.errors import InputError
from lvba.io.dataset import check_names, open_dataset


def _rename(old, new):
    return lambda root: (root / old).rename(root / new)


def _write(name, text):
    return lambda root: (root / name).write_text(text)


WRONG = {
    "no scans": lambda root: shutil.rmtree(root / "all_pcd_body"),
    "another name": _rename("all_pcd_body", "scans"),
    "no scan poses": lambda root: (root / "all_pcd_body" / "lidar_poses.txt").unlink(),
    "no image poses": lambda root: (root / "all_image" / "image_poses.txt").unlink(),
    "poses without images": lambda root: (
        (root / "all_image" / "image_poses.txt").rename(root / "image_poses.txt"),
        shutil.rmtree(root / "all_image"),
    ),
    "no numbers": _write("all_pcd_body/lidar_poses.txt", "what is this\n"),
    "another clock": _write("all_pcd_body/lidar_poses.txt", "12.0 0 0 0 0 0 0 1\n12.1 0 0 0 0 0 0 1\n"),
    "no YAML": _write("config.yaml", "cam: [\n"),
    "no camera": _write("config.yaml", "extrin_calib: {}\n"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_opening_refuses_for_its_names_is_refused_with_the_same_words(tmp_path: Path, wrong):
    root = small_recording.write(tmp_path)
    WRONG[wrong](root)
    with pytest.raises(InputError) as opened:
        open_dataset(root)
    _empty(root)
    with pytest.raises(InputError) as checked:
        check_names(root)
    assert str(checked.value) == str(opened.value)


@pytest.mark.parametrize("pictures", [0, 4])
def test_a_recording_of_empty_files_passes(tmp_path: Path, pictures):
    root = small_recording.write(tmp_path, pictures=pictures)
    open_dataset(root)
    _empty(root)
    check_names(root)


def _empty(root: Path) -> None:
    for path in root.rglob("*"):
        if path.suffix in (".pcd", ".png"):
            path.write_bytes(b"")
