"""The truth or another solution to compare with: a folder of poses and exposures."""

import dataclasses
import logging
import os
from dataclasses import dataclass
from pathlib import Path

from lvba.dataset import CAMERA, Dataset
from lvba.errors import InputError
from lvba.io import exposures, image_poses, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES
from lvba.io.exposures import Exposures
from lvba.trajectory import Trajectory

logger = logging.getLogger(__name__)

EXPOSURES = "exposures.csv"


@dataclass(frozen=True)
class Reference:
    """Poses in the reference's own world frame, and exposures with a scale of their own; None where there is no file."""

    scans: Trajectory | None
    images: Trajectory | None
    exposures: Exposures | None
    image_poses: str = ""
    """What the file says its image poses are of, `camera` or `body`; "" if it says nothing: `of_cameras` finds out."""


def read_reference(folder: str | Path) -> Reference:
    """What a reference folder holds of lidar_poses.txt, image_poses.txt and exposures.csv.

    Image poses are as in the file: whoever compares them calls `of_cameras` first.
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
    images = None if not os.path.exists(image_path) else tum.read_pose_file(image_path)
    for warning in () if images is None else images.warnings:
        logger.warning(warning)
    return Reference(
        tum.read_trajectory(scan_path) if os.path.exists(scan_path) else None,
        None if images is None else images.trajectory,
        exposures.read_exposures(exposure_path) if os.path.exists(exposure_path) else None,
        "" if images is None else image_poses.stated(images.comments),
    )


def of_cameras(reference: Reference, dataset: Dataset) -> Reference:
    """The reference with the poses of cameras, whatever its image_poses.txt holds.

    The rule is that of a recording, with the reference's own scan poses; without these, by how well its images can be
    laid over the recording's. What neither they nor the file tell is what the recording's file holds.
    Raises: InputError if its image poses do not belong to its scan poses.
    """
    images, extrinsic = reference.images, dataset.camera_from_scan
    if images is None or not dataset.image_paths:
        return reference
    statement = image_poses.Statement(reference.image_poses, "the file")
    if reference.scans is None:
        reading = image_poses.decide_beside(images, dataset, statement)
    else:
        where = f"{IMAGE_POSES} of the reference"
        reading = image_poses.decide(
            *(images, reference.scans, extrinsic, statement, where, dataset.image_poses),
            image_poses.FOREIGN_EXTRINSIC,
        )
        for warning in reading.warnings:
            logger.warning(warning)
    cameras = image_poses.to_camera(images.world_from_sensor, reading.kind, extrinsic)
    return dataclasses.replace(reference, images=Trajectory(images.times, cameras), image_poses=CAMERA)
