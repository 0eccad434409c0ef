"""A recording on disk as a `Dataset`: the folder that FAST-LIVO2 writes and Global-LVBA reads, matched and checked.

DATASET/
  all_pcd_body/<time>.pcd       lidar_poses.txt   (in the folder or beside it; TUM, body to world)
  all_image/<time>.png|jpg      image_poses.txt   (in the folder or beside it; TUM, camera to world); optional
  config.yaml                   camera and extrinsics; optional without images
"""

import dataclasses
import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.dataset import NO_CAMERA, Dataset, Scan
from lvba.errors import InputError
from lvba.io import camera_config, files, frames, images, kitti, pcd, posed_frames, timestamps, tum, velodyne
from lvba.io.camera_config import Calibration
from lvba.io.frames import Frame
from lvba.io.posed_frames import PosedFrames
from lvba.trajectory import Trajectory, bracket

logger = logging.getLogger(__name__)

SCAN_FOLDERS = ("all_pcd_body", "pcd", "Log/pcd")
"""Where FAST-LIVO2 writes scans: for Global-LVBA, and by itself (seen from its `Log` folder, or from its root)."""
IMAGE_FOLDERS = ("all_image", "image", "Log/image")
SCAN_POSES, IMAGE_POSES = "lidar_poses.txt", "image_poses.txt"
_MAX_DISAGREEMENT_DEG, _MAX_DISAGREEMENT_M = 10.0, 1.0


def open_dataset(path: str | Path) -> Dataset:
    """The recording in a folder: files with matched rough poses and calibration; headers are checked, nothing is loaded.

    Frames that are bad or have no pose near in time are left out with a warning, unless they are the majority.
    The digest covers the contents of all files used; of recordings above `frames.HASHED_BYTES`, the sizes and change
    times of scans and images instead.
    Raises: InputError
    """
    with files.as_input_error(path):
        root = Path(os.path.abspath(path))
        os.stat(root)
    dataset = kitti.open_kitti(root) if kitti.is_kitti(root) else _open_fast_livo(root)
    for warning in dataset.warnings:
        logger.warning(warning)
    return dataset


def _open_fast_livo(root: Path) -> Dataset:
    scan_folder, image_folder = _layout(root)
    scans = _open_frames(root, scan_folder, SCAN_POSES, (".pcd",), "scan")
    calibration = camera_config.read_calibration(root)
    pictures = _open_images(root, image_folder, calibration) if image_folder else None
    dataset = Dataset(
        root=str(root),
        scan_paths=scans.paths,
        scans=scans.poses,
        image_paths=() if pictures is None else pictures.paths,
        images=Trajectory(np.zeros(0), np.zeros((0, 4, 4))) if pictures is None else pictures.poses,
        camera=NO_CAMERA if pictures is None else camera_config.for_size(calibration, pictures.sizes[0]),
        camera_from_scan=_camera_from_scan(calibration),
        sensor_position_scan=calibration.body_from_lidar[:3, 3].copy(),
        warnings=scans.warnings + calibration.warnings + (() if pictures is None else pictures.warnings),
        digest=_digest(calibration, scans, pictures),
    )
    disagreement = _disagreement(dataset, calibration)
    return posed_frames.shifted(dataclasses.replace(dataset, warnings=dataset.warnings + disagreement))


def load_scan(dataset: Dataset, index: int) -> Scan:
    """The points of one scan.

    Raises: InputError if the file has become unreadable or turns out damaged.
    """
    path = dataset.scan_paths[index]
    return velodyne.read_bin(path) if path.endswith(velodyne.SUFFIX) else pcd.read_pcd(path)


def load_scans(dataset: Dataset, indices: Sequence[int] | None = None) -> list[np.ndarray]:
    """The points (N, 3) float32 of the scans, or of those asked for, in order.

    Raises: InputError
    """
    wanted = range(len(dataset.scan_paths)) if indices is None else indices
    with ThreadPoolExecutor(frames.THREADS) as pool:
        return list(pool.map(lambda index: load_scan(dataset, index).points, wanted))


def load_image(dataset: Dataset, index: int) -> np.ndarray:
    """The pixels of one image, (H, W, 3) uint8, RGB, at the size of `dataset.camera`.

    Raises: InputError if the file has become unreadable, turns out damaged, or has another size.
    """
    path, camera = dataset.image_paths[index], dataset.camera
    rgb = images.read_image(path)
    if rgb.shape[:2] != (camera.height, camera.width):
        size = f"{rgb.shape[1]} x {rgb.shape[0]} px instead of {camera.width} x {camera.height}"
        raise InputError(path, size, "put the image of the right size there")
    return rgb


def _layout(root: Path) -> tuple[str, str]:
    """Names of the scan folder and of the image folder (empty: there is none)."""
    if not os.path.isdir(root):
        raise InputError(root, "is a file, not a folder", f"give the folder that holds {SCAN_FOLDERS[0]}")
    scan_folder = _first_folder(root, SCAN_FOLDERS)
    image_folder = _first_folder(root, IMAGE_FOLDERS)
    if scan_folder and not image_folder and os.path.exists(root / IMAGE_POSES):
        missing = root / IMAGE_FOLDERS[0]
        raise InputError(missing, f"is missing beside {IMAGE_POSES}", "add the images, or remove the poses")
    if scan_folder:
        return scan_folder, image_folder
    if root.name in (*SCAN_FOLDERS, *IMAGE_FOLDERS):
        raise InputError(root, "is a part of a recording", f"give the folder above it, {root.parent}")
    missing = root / SCAN_FOLDERS[0]
    raise InputError(missing, "there is no such folder", f"put <seconds>.pcd and {SCAN_POSES} there")


def _first_folder(root: Path, names: tuple[str, ...]) -> str:
    return next((name for name in names if os.path.isdir(root / name)), "")


def _pose_path(root: Path, folder: str, name: str) -> Path:
    """The pose file in the folder or beside it."""
    inside, beside = root / folder / name, root / name
    if not os.path.exists(inside) and not os.path.exists(beside):
        raise InputError(
            inside, "no poses: there is no such file", "write one pose a line: t tx ty tz qx qy qz qw"
        )
    return inside if os.path.exists(inside) else beside


def _open_frames(
    root: Path, folder: str, pose_name: str, suffixes: tuple[str, ...], kind: str
) -> PosedFrames:
    found, warnings = frames.find(root / folder, suffixes, kind)
    pose_path = _pose_path(root, folder, pose_name)
    rough, pose_warnings = tum.read_trajectory_and_warnings(pose_path)
    match = timestamps.match(np.array([frame.time for frame in found]), rough, pose_path)
    matched = [found[index] for index in match.files]
    warnings = [*warnings, *pose_warnings, *_match_warnings(found, match, len(rough), pose_path, kind)]
    check = pcd.check_pcd if kind == "scan" else images.check_image
    fingerprint = f"{pose_name} {posed_frames.sha256(pose_path)}"
    return posed_frames.checked(matched, match.poses, check, kind, fingerprint, tuple(warnings))


def _match_warnings(
    found: list[Frame], match: timestamps.Match, poses: int, pose_path: Path, kind: str
) -> list[str]:
    matched = set(match.files.tolist())
    without = [frame.path.name for index, frame in enumerate(found) if index not in matched]
    warnings = frames.left_out(without, f"{kind}s that no pose is near in time to", pose_path)
    if match.by_order:
        warnings.append(
            f"{pose_path}: the {kind} files are numbered, not timed; the first has the first pose, and so on."
        )
    if match.interpolated:
        warnings.append(f"{pose_path}: the poses of {match.interpolated} {kind}s were interpolated.")
    if match.unused_poses:
        warnings.append(f"{pose_path}: {match.unused_poses} of {poses} poses belong to no {kind} file.")
    return warnings


def _open_images(root: Path, folder: str, calibration: Calibration) -> PosedFrames:
    """Images of the size that most of them have."""
    opened = _open_frames(root, folder, IMAGE_POSES, images.SUFFIXES, "image")
    if calibration.camera is None:
        raise InputError(
            root / "config.yaml", "has no cam_fx and other camera keys", "add cam_model with cam_fx, ..."
        )
    if calibration.camera_from_lidar is None:
        raise InputError(root / "config.yaml", "has no Rcl and Pcl", "add extrin_calib with Rcl and Pcl")
    return posed_frames.of_one_size(opened, root / folder)


def _camera_from_scan(calibration: Calibration) -> np.ndarray:
    """camera_from_lidar @ lidar_from_body (the scans are in the body frame); identity without camera."""
    if calibration.camera_from_lidar is None:
        return np.eye(4)
    return calibration.camera_from_lidar @ geometry.inverse(calibration.body_from_lidar)


def _digest(calibration: Calibration, scans: PosedFrames, pictures: PosedFrames | None) -> str:
    paths = sorted({calibration.camera_path, calibration.extrinsic_path})
    lines = [f"calibration {posed_frames.sha256(path)}" for path in paths if os.path.isfile(path)]
    return posed_frames.digest(scans, pictures, lines)


def _disagreement(dataset: Dataset, calibration: Calibration) -> tuple[str, ...]:
    """A warning if image poses are far from where the scan poses and the extrinsics put the camera."""
    times, scans = dataset.images.times, dataset.scans
    inside = (times >= scans.times[0]) & (times <= scans.times[-1])
    if not inside.any():
        return ()
    before, fraction = bracket(scans.times, times[inside])
    after = np.minimum(before + 1, len(scans) - 1)
    carriers = geometry.interpolate(scans.world_from_sensor[before], scans.world_from_sensor[after], fraction)
    expected = carriers @ geometry.inverse(dataset.camera_from_scan)
    error = geometry.inverse(expected) @ dataset.images.world_from_sensor[inside]
    angle_deg = float(np.median(geometry.rotation_angle_deg(error)))
    distance = float(np.median(np.linalg.norm(error[:, :3, 3], axis=1)))
    if angle_deg <= _MAX_DISAGREEMENT_DEG and distance <= _MAX_DISAGREEMENT_M:
        return ()
    return (
        f"{calibration.extrinsic_path}: image poses and scan poses disagree by {angle_deg:.1f} degrees and "
        f"{distance:.2f} m (medians) under Rcl, Pcl: check that X_camera = Rcl X_lidar + Pcl, and that image poses are "
        "camera to world with z forward.",
    )
