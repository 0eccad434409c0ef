"""The result folder: poses, exposures and settings, in the input's world frame and at the input's times."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lvba.dataset import Dataset
from lvba.io import exposures, files, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES
from lvba.io.exposures import Exposures
from lvba.io.reference import EXPOSURES
from lvba.trajectory import Trajectory

CONFIG = "config.yaml"


def prepare(out: str | Path) -> Path:
    """The result folder, made if it was not there, after trying that it can be written.

    Raises: InputError if it cannot be: call this before hours of work, not after.
    """
    folder = files.make_folder(out)
    files.try_to_write(folder)
    return folder


def write_poses(
    out: str | Path, dataset: Dataset, world_from_scan: np.ndarray, world_from_camera: np.ndarray
) -> None:
    """Writes lidar_poses.txt and, if there are images, image_poses.txt; each file is the old one or the whole new one.

    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4), in the dataset's frame (its origin is added here)
    Raises: InputError if a file cannot be written.
    """
    folder = files.make_folder(out)
    _write_trajectory(folder / SCAN_POSES, dataset, dataset.scans.times, world_from_scan)
    if dataset.image_paths:
        _write_trajectory(folder / IMAGE_POSES, dataset, dataset.images.times, world_from_camera)


def write_exposures(out: str | Path, dataset: Dataset, relative: np.ndarray) -> None:
    """Writes exposures.csv.

    relative: (I,), scaled here so that the first image has 1
    Raises: InputError if the file cannot be written.
    """
    folder = files.make_folder(out)
    table = Exposures(dataset.images.times, relative / relative[0])
    exposures.write_exposures(folder / EXPOSURES, table, durable=True)


def write_config(out: str | Path, config: Mapping[str, Any]) -> None:
    """Writes config.yaml: nested plain values (numbers, texts, lists, mappings), in their order.

    Raises: InputError if the file cannot be written.
    """
    text = yaml.safe_dump(
        dict(config), sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    files.write_text(files.make_folder(out) / CONFIG, text, durable=True)


def _write_trajectory(path: Path, dataset: Dataset, times: np.ndarray, poses: np.ndarray) -> None:
    poses = poses.copy()
    poses[:, :3, 3] += dataset.origin
    files.write_text(path, tum.trajectory_text(Trajectory(times, poses)), durable=True)
