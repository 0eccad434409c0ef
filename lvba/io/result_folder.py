"""The result folder: poses, exposures and settings, in the input's world frame and at the input's times."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lvba.arrays import Poses
from lvba.dataset import CAMERA, Dataset
from lvba.errors import InputError
from lvba.io import calibration, exposures, files, image_poses, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES
from lvba.io.exposures import Exposures
from lvba.io.reference import EXPOSURES
from lvba.trajectory import Trajectory

CONFIG, MAP, REPORT = "config.yaml", "map.ply", "report.json"
FILES = (SCAN_POSES, IMAGE_POSES, EXPOSURES, MAP, CONFIG, calibration.NAME, REPORT, "report.html")
"""What is written, and replaced, in a result folder."""
_LOCK, _WRITING = Path("stages") / ".lock", ".writing"
_LARGEST_REPORT = 1 << 30
_SAME_TIME_S = 1e-5


def prepare(out: str | Path) -> Path:
    """The result folder, made if it was not there, after trying that it can be written.

    Raises: InputError if it cannot be: call this before hours of work, not after.
    """
    folder = files.make_folder(out)
    files.try_to_write(folder)
    return folder


def check(out: str | Path) -> None:
    """Passes if nothing in the folder that is not of a result would be replaced.

    Of a result are the files beside our stages, beside our report.json, and those of a writing that was cut short.
    Raises: InputError
    """
    folder = Path(out)
    existing = next((name for name in FILES if os.path.lexists(folder / name)), None)
    if (
        existing is None
        or os.path.exists(folder / _LOCK)
        or os.path.exists(folder / _WRITING)
        or _is_ours(folder)
    ):
        return
    raise InputError(
        folder / existing,
        "is not of a result of lvba, and would be replaced",
        "choose another folder, or move it away",
    )


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Marks the folder as being written, until all of it is."""
    files.write_text(folder / _WRITING, "")
    yield
    with files.as_input_error(folder):
        os.unlink(folder / _WRITING)


def read_report(out: str | Path) -> dict[str, Any] | None:
    """The facts in a result's report.json; None: there is none that can be read."""
    try:
        facts = json.loads(files.read_text(Path(out) / REPORT, _LARGEST_REPORT))
    except (InputError, ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) else None


def _is_ours(folder: Path) -> bool:
    """Whether it holds a report of ours."""
    facts = read_report(folder)
    return facts is not None and "schema" in facts and isinstance(facts.get("dataset"), dict)


def write_poses(out: str | Path, dataset: Dataset, world_from_scan: Poses, world_from_camera: Poses) -> None:
    """Writes lidar_poses.txt and, if there are images, image_poses.txt; each file is the old one or the whole new one.

    image_poses.txt holds poses of what the recording's file holds (`Dataset.image_poses`), and says so in its first line.
    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4), in the dataset's frame (its origin is added here)
    Raises: InputError if a file cannot be written.
    """
    folder = files.make_folder(out)
    _write_trajectory(folder / SCAN_POSES, dataset, dataset.scans.times, world_from_scan, dataset.scan_stamps)
    if dataset.image_paths:
        kind = dataset.image_poses
        poses = image_poses.from_camera(world_from_camera, kind, dataset.camera_from_scan)
        times, comment = dataset.images.times, image_poses.comment(kind)
        _write_trajectory(folder / IMAGE_POSES, dataset, times, poses, dataset.image_stamps, comment)


def read_cameras(out: str | Path, dataset: Dataset) -> Trajectory:
    """world_from_camera of the images in a result's image_poses.txt, in the dataset's frame.

    Results without a comment that says what they hold are older ones, and hold the camera's poses.
    Raises: InputError
    """
    file = tum.read_pose_file(Path(out) / IMAGE_POSES)
    kind = image_poses.stated(file.comments) or CAMERA
    poses = image_poses.to_camera(file.trajectory.world_from_sensor, kind, dataset.camera_from_scan).copy()
    poses[:, :3, 3] -= dataset.origin
    return Trajectory(file.trajectory.times, poses)


def read_scans(out: str | Path, dataset: Dataset) -> Trajectory:
    """world_from_scan of all scans in a result's lidar_poses.txt, in the dataset's frame.

    Raises: InputError, also if it has other times than the recording.
    """
    path = Path(out) / SCAN_POSES
    stored, times = tum.read_trajectory(path), dataset.scans.times
    if len(stored) != len(times) or np.abs(stored.times - times).max(initial=0) > _SAME_TIME_S:
        raise InputError(
            path, "has other times than its recording", "run again on the recording as it is now"
        )
    poses = stored.world_from_sensor.copy()
    poses[:, :3, 3] -= dataset.origin
    return Trajectory(times, poses)


def write_exposures(out: str | Path, dataset: Dataset, relative: np.ndarray) -> None:
    """Writes exposures.csv.

    relative: (I,) float64, scaled here so that the first image has 1

    Raises: InputError if the file cannot be written.
    """
    folder = files.make_folder(out)
    table = Exposures(dataset.images.times, relative / relative[0])
    exposures.write_exposures(folder / EXPOSURES, table, durable=True, stamps=dataset.image_stamps)


def write_config(out: str | Path, text: str) -> None:
    """Writes config.yaml. Raises: InputError if the file cannot be written."""
    files.write_text(files.make_folder(out) / CONFIG, text, durable=True)


def _write_trajectory(
    path: Path,
    dataset: Dataset,
    times: np.ndarray,
    poses: np.ndarray,
    stamps: tuple[str, ...],
    comment: str = "",
) -> None:
    poses = poses.copy()
    poses[:, :3, 3] += dataset.origin
    text = tum.trajectory_text(Trajectory(times, poses), comment=comment, stamps=stamps)
    files.write_text(path, text, durable=True)
