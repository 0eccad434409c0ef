"""The truth or another solution to compare with: a folder of poses and exposures."""

import os
from dataclasses import dataclass
from pathlib import Path

from lvba.errors import InputError
from lvba.io import exposures, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES
from lvba.io.exposures import Exposures
from lvba.trajectory import Trajectory

EXPOSURES = "exposures.csv"


@dataclass(frozen=True)
class Reference:
    """Poses in the reference's own world frame, and exposures with a scale of their own; None where there is no file."""

    scans: Trajectory | None
    images: Trajectory | None
    exposures: Exposures | None


def read_reference(folder: str | Path) -> Reference:
    """What a reference folder holds of lidar_poses.txt, image_poses.txt and exposures.csv.

    Raises: InputError if it holds no poses, or a file is malformed.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise InputError(
            folder, "there is no such folder", f"give the folder that holds the reference's {SCAN_POSES}"
        )
    scan_path, image_path, exposure_path = (folder / name for name in (SCAN_POSES, IMAGE_POSES, EXPOSURES))
    if not os.path.exists(scan_path) and not os.path.exists(image_path):
        raise InputError(folder, "holds no poses", f"put {SCAN_POSES} or {IMAGE_POSES} there")
    return Reference(
        tum.read_trajectory(scan_path) if os.path.exists(scan_path) else None,
        tum.read_trajectory(image_path) if os.path.exists(image_path) else None,
        exposures.read_exposures(exposure_path) if os.path.exists(exposure_path) else None,
    )
