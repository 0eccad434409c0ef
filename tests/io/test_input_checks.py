"""What speaks against the files of a recording is counted and told; ordinary recordings are left alone."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import small_recording
from small_recording import START

from lvba import geometry
from lvba.dataset import InputFindings
from lvba.errors import InputError
from lvba.io import images, pcd, tum
from lvba.io.dataset import open_dataset
from lvba.steps import report_data, verdict_data
from lvba.trajectory import Trajectory


def reasons(found) -> list[str]:
    """Texts of the verdict on a result of this recording."""
    facts = report_data.plain({"dataset": report_data.of_dataset(found)})
    return [reason["text"] for reason in verdict_data.add(facts)["verdict"]["reasons"]]


def rewrite(root: Path, name: str, change) -> None:
    """Poses of a file, changed by `change(times, poses)`."""
    path = next(root.rglob(name))
    read = tum.read_trajectory(path)
    tum.write_trajectory(path, Trajectory(*change(read.times, read.world_from_sensor)))


def test_an_ordinary_recording_has_no_findings(tmp_path: Path):
    found = open_dataset(small_recording.write(tmp_path))
    assert found.findings == InputFindings()
    assert found.warnings == ()
    assert "findings" not in report_data.of_dataset(found)


@pytest.mark.parametrize("hours", [1, -1, 400_000])
def test_images_of_another_clock_are_told_with_both_spans(tmp_path: Path, hours: int):
    root = small_recording.write(tmp_path)
    offset = 3600.0 * hours
    for path in small_recording.image_files(root):
        path.rename(path.with_name(f"{float(path.stem) + offset:.6f}.png"))
    rewrite(root, "image_poses.txt", lambda times, poses: (times + offset, poses))
    found = open_dataset(root)
    [warning] = found.warnings
    assert f"images run from {START + offset + 0.05:.3f} to {START + offset + 0.45:.3f} s" in warning
    assert f"scans from {START:.3f} to {START + 0.5:.3f} s" in warning
    assert abs(found.findings.apart_s - abs(offset)) < 1
    assert any("no time in common" in text for text in reasons(found))


def test_an_image_soon_after_the_last_scan_is_of_the_same_clock(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=1, pictures=4)
    assert open_dataset(root).findings == InputFindings()


def test_half_of_the_poses_missing_is_a_reason(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=20, pictures=19)
    for name in ("lidar_poses.txt", "image_poses.txt"):
        rewrite(root, name, lambda times, poses: (times[:10], poses[:10]))
    found = open_dataset(root)
    assert (found.findings.skipped_scans, found.findings.skipped_images) == (10, 9)
    assert "10 of 20 scan files were left out (see the warnings)." in reasons(found)
    assert "9 of 19 image files were left out (see the warnings)." in reasons(found)


def test_bad_files_and_images_of_another_size_count_as_left_out(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=12, pictures=11)
    small_recording.scan_files(root)[3].write_bytes(b"")
    small_recording.image_files(root)[5].write_bytes(b"")
    images.write_image(small_recording.image_files(root)[6], np.zeros((48, 64, 3), np.uint8))
    found = open_dataset(root)
    assert (found.findings.skipped_scans, found.findings.skipped_images) == (1, 2)
    assert not any("scan files were left out" in text for text in reasons(found))  # one of twelve
    assert "2 of 11 image files were left out (see the warnings)." in reasons(found)


def test_scans_with_the_contents_of_the_one_before_are_told(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=20, pictures=0)
    files = small_recording.scan_files(root)
    for path in files[1:]:
        path.write_bytes(files[0].read_bytes())
    found = open_dataset(root)
    assert found.findings.repeated_scans == 19
    assert any("19 of 20 scans have the same contents" in warning for warning in found.warnings)
    assert any("19 of 20 scans have the same contents" in text for text in reasons(found))


def test_of_long_recordings_sizes_and_change_times_say_nothing_of_contents(tmp_path: Path, monkeypatch):
    root = small_recording.write(tmp_path, pictures=0)
    for path in small_recording.scan_files(root):
        os.utime(path, ns=(10**18, 10**18))
    monkeypatch.setattr("lvba.io.frames.HASHED_BYTES", 0)
    assert open_dataset(root).findings == InputFindings()


def test_poses_that_stand_still_are_told(tmp_path: Path):
    root = small_recording.write(tmp_path, scans=20, pictures=0)
    rewrite(root, "lidar_poses.txt", lambda times, poses: (times, poses[np.minimum(np.arange(20), 7)]))
    found = open_dataset(root)
    assert found.findings == InputFindings(repeated_poses=12)
    assert any("there the odometry stood still" in warning for warning in found.warnings)
    assert any("12 of 20 scan poses are identical" in text for text in reasons(found))


def test_poses_in_millimeters_are_named(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)

    def scaled(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses[:, :3, 3] *= 1000
        return times, poses

    rewrite(root, "lidar_poses.txt", scaled)
    found = open_dataset(root)
    assert 500 < found.findings.speed_m_s < 600  # 0.5 m/s forward, 0.2 m/s aside
    assert any("seem to be in millimeters" in warning for warning in found.warnings)
    assert any("seem to be in millimeters" in text for text in reasons(found))


def test_points_in_millimeters_are_named(tmp_path: Path):
    root = small_recording.write(tmp_path, pictures=0)
    for path in small_recording.scan_files(root):
        pcd.write_pcd(path, pcd.read_pcd(path).points * 1000)
    found = open_dataset(root)
    assert 4000 < found.findings.range_m < 6000
    assert any("seem to be in millimeters" in warning for warning in found.warnings)
    assert any("seem to be in millimeters" in text for text in reasons(found))


def test_a_reading_of_the_poses_that_scans_speak_for_is_named(tmp_path: Path, monkeypatch):
    """In the error about images where there is one, else as a warning."""
    root = small_recording.write(tmp_path)
    monkeypatch.setattr("lvba.io.pose_readings.find", lambda poses, load: "inverse")
    found = open_dataset(root)
    assert found.findings == dataclasses.replace(InputFindings(), poses_as="inverse")
    assert any("agree far better with the inverse" in warning for warning in found.warnings)
    turned = geometry.exp(np.array([0, 0, 2.0, 0, 0, 0]))
    rewrite(root, "image_poses.txt", lambda times, poses: (times, turned @ poses))
    with pytest.raises(
        InputError, match=r"lidar_poses.txt: image poses .* inverse of the poses; write poses from body"
    ):
        open_dataset(root)
    monkeypatch.setattr("lvba.io.pose_readings.find", lambda poses, load: "world")
    with pytest.raises(InputError, match=r"image_poses.txt: image poses and scan poses disagree"):
        open_dataset(root)
