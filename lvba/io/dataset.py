"""A recording on disk as a `Dataset`: the folder that FAST-LIVO2 writes and Global-LVBA reads, matched and checked.

DATASET/
  all_pcd_body/<time>.pcd       lidar_poses.txt   (in the folder or beside it; TUM, body to world)
  all_image/<time>.png|jpg      image_poses.txt   (likewise; of the body or the camera: see `io.image_poses`); optional
  config.yaml                   camera and extrinsics; optional without images
  imu.csv                       readings of an IMU (`io.imu`); optional
"""

import dataclasses
import hashlib
import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.dataset import CAMERA, Dataset, RigCamera, Scan
from lvba.errors import InputError
from lvba.io import (
    bags,
    camera_config,
    files,
    finite_points,
    frames,
    image_poses,
    images,
    imu,
    input_checks,
    kitti,
    pcd,
    posed_frames,
    scan_poses,
    timestamps,
    tum,
    velodyne,
    yaml_files,
)
from lvba.io.camera_config import Calibration
from lvba.io.frames import Frame
from lvba.io.image_poses import Reading, Statement
from lvba.io.posed_frames import PosedFrames
from lvba.io.tum import PoseFile
from lvba.trajectory import Trajectory

logger = logging.getLogger(__name__)

SCAN_FOLDERS = ("all_pcd_body", "pcd", "Log/pcd")
"""Where FAST-LIVO2 writes scans: for Global-LVBA, and by itself (seen from its `Log` folder, or from its root)."""
IMAGE_FOLDERS = ("all_image", "image", "Log/image")
SCAN_POSES, IMAGE_POSES = "lidar_poses.txt", "image_poses.txt"


def open_dataset(path: str | Path) -> Dataset:
    """The recording in a folder: files with matched rough poses and calibration; headers are checked, nothing is loaded.

    Frames that are bad or have no pose near in time are left out with a warning; bad ones may not be the majority.
    What speaks against the files otherwise is told in warnings and `Dataset.findings`; a few scans are read for it.
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


def check_names(path: str | Path) -> None:
    """What `open_dataset` finds wrong before it looks into scans and images: names, poses, calibration.

    Scans and images may be empty files: only their names count.
    Raises: InputError
    """
    with files.as_input_error(path):
        root = Path(os.path.abspath(path))
        os.stat(root)
    if kitti.is_kitti(root):
        kitti.check_names(root)
        return
    scan_folder, image_folder = _layout(root)
    scans = _matched(root, scan_folder, _poses_of(root, scan_folder, SCAN_POSES), (".pcd",), "scan")
    calibration = camera_config.read_calibration(root)
    if image_folder:
        poses = _poses_of(root, image_folder, IMAGE_POSES)
        pictures = _matched(root, image_folder, poses, images.SUFFIXES, "image")
        _need_camera(root, calibration)
        _decide(poses, pictures.poses, scans.poses, calibration)


def _open_fast_livo(root: Path) -> Dataset:
    scan_folder, image_folder = _layout(root)
    poses = _poses_of(root, scan_folder, SCAN_POSES)
    scans = _open_frames(root, scan_folder, poses, (".pcd",), "scan")
    calibration = camera_config.read_calibration(root)
    dataset = Dataset(
        root=str(root),
        scan_paths=scans.paths,
        scans=scans.poses,
        image_paths=(),
        images=Trajectory(np.zeros(0), np.zeros((0, 4, 4))),
        scan_stamps=scans.stamps,
        cameras=(),
        deskewed_by=scan_poses.deskewed_by(poses.file.comments),
        sensor_position_scan=calibration.body_from_lidar[:3, 3].copy(),
        sensor_axes_scan=calibration.body_from_lidar[:3, :3].copy(),
        warnings=scans.warnings + calibration.warnings,
        digest=_digest(calibration, scans),
    )
    image_poses_file = _poses_of(root, image_folder, IMAGE_POSES) if image_folder else None
    pictures = _open_images(root, image_folder, image_poses_file, calibration) if image_poses_file else None
    dataset = input_checks.add(dataset, poses.path, scans, pictures)
    dataset = input_checks.with_points(dataset, poses.path, load_scan)
    if image_poses_file and pictures:
        dataset = _with_images(dataset, image_poses_file, pictures, calibration, scans, poses.path)
    return posed_frames.shifted(_with_imu(dataset, root, calibration))


def _with_imu(dataset: Dataset, root: Path, calibration: Calibration) -> Dataset:
    """The recording with the readings of its IMU, if there are any."""
    path = imu.find(root)
    if not path:
        return dataset
    imu.read(path)  # what is wrong with it is told before anything is computed
    both = f"{dataset.digest}\nimu {files.sha256(path)}\n"
    extrinsic = calibration.body_from_imu
    if extrinsic is not None:
        both += f"mounted {extrinsic.tobytes().hex()}\n"  # digests stay as they were
    return dataclasses.replace(
        dataset,
        imu_path=path,
        scan_from_imu=np.eye(4) if extrinsic is None else extrinsic,
        digest=hashlib.sha256(both.encode()).hexdigest(),
    )


def _with_images(
    dataset: Dataset,
    poses: "_Poses",
    pictures: PosedFrames,
    calibration: Calibration,
    scans: PosedFrames,
    scan_poses: Path,
) -> Dataset:
    """The recording of the scans with its images, whose poses become the camera's.

    poses: the file of the image poses; scan_poses: that of the scan poses, which may be the one to blame
    """
    try:
        reading = _decide(poses, pictures.poses, scans.poses, calibration)
    except InputError as error:
        raise input_checks.blamed(error, scan_poses, dataset.findings) from error
    # without common times nothing is compared
    undecided = () if dataset.findings.apart_s else reading.warnings
    camera_from_scan = _camera_from_scan(calibration)
    poses_of_camera = image_poses.to_camera(pictures.poses.world_from_sensor, reading.kind, camera_from_scan)
    return dataclasses.replace(
        dataset,
        image_paths=pictures.paths,
        images=Trajectory(pictures.poses.times, poses_of_camera),
        cameras=(RigCamera(camera_config.for_size(calibration, pictures.sizes[0]), camera_from_scan),),
        image_stamps=pictures.stamps,
        image_poses=reading.kind,
        image_poses_reason=reading.reason,
        warnings=dataset.warnings + pictures.warnings + undecided,
        digest=_digest(calibration, scans, pictures, reading.kind),
    )


def _decide(poses: "_Poses", pictures: Trajectory, scans: Trajectory, calibration: Calibration) -> Reading:
    """What the image poses are of."""
    itself = image_poses.stated(poses.file.comments)
    said = Statement(itself, f"{IMAGE_POSES} itself") if itself else calibration.image_poses
    return image_poses.decide(pictures, scans, _camera_from_scan(calibration), said, poses.path)


def load_scan(dataset: Dataset, index: int) -> Scan:
    """The points of one scan, without those at the sensor's own position: beams that did not come back.

    Raises: InputError if the file has become unreadable or turns out damaged.
    """
    path = dataset.scan_paths[index]
    scan = velodyne.read_bin(path) if path.endswith(velodyne.SUFFIX) else pcd.read_pcd(path)
    return finite_points.without_no_returns(path, scan, dataset.sensor_position_scan)


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
        _refuse_bag(root)
        raise InputError(root, "is a file, not a folder", f"give the folder that holds {SCAN_FOLDERS[0]}")
    scan_folder = _first_folder(root, SCAN_FOLDERS)
    image_folder = _first_folder(root, IMAGE_FOLDERS)
    if scan_folder and not image_folder and os.path.exists(root / IMAGE_POSES):
        missing = root / IMAGE_FOLDERS[0]
        raise InputError(missing, f"is missing beside {IMAGE_POSES}", "add the images, or remove the poses")
    if scan_folder:
        return scan_folder, image_folder
    _refuse_bag(root)
    if root.name in (*SCAN_FOLDERS, *IMAGE_FOLDERS):
        raise InputError(root, "is a part of a recording", f"give the folder above it, {root.parent}")
    missing = root / SCAN_FOLDERS[0]
    raise InputError(missing, "there is no such folder", f"put <seconds>.pcd and {SCAN_POSES} there")


def _refuse_bag(root: Path) -> None:
    if kind := bags.kind(root):
        raise InputError(root, f"is a {kind}, no recording folder", bags.MEND)


def _first_folder(root: Path, names: tuple[str, ...]) -> str:
    return next((name for name in names if os.path.isdir(root / name)), "")


@dataclass(frozen=True)
class _Poses:
    """A pose file, where it is and what it is called."""

    path: Path
    name: str
    file: PoseFile


def _poses_of(root: Path, folder: str, name: str) -> _Poses:
    """The pose file in the folder or beside it."""
    inside, beside = root / folder / name, root / name
    exists = name in files.names_in(root / folder)  # of a folder that is closed to us, `exists` says no
    if not exists and not os.path.exists(beside):
        raise InputError(
            inside, "no poses: there is no such file", "write one pose a line: t tx ty tz qx qy qz qw"
        )
    path = inside if exists else beside
    return _Poses(path, name, tum.read_pose_file(path))


@dataclass(frozen=True)
class _Matched:
    """Files with a pose; their times with all digits; what to say of the others, and how many these are."""

    frames: list[Frame]
    poses: Trajectory
    stamps: list[str]
    warnings: list[str]
    skipped: int


def _matched(root: Path, folder: str, poses: _Poses, suffixes: tuple[str, ...], kind: str) -> _Matched:
    """The files of a folder by their names and the pose file; nothing of the files is read."""
    on_disk, warnings = frames.find(root / folder, suffixes, kind)
    rough = poses.file.trajectory
    match = timestamps.match(np.array([frame.time for frame in on_disk]), rough, poses.path)
    matched = [on_disk[index] for index in match.files]
    warnings += [*poses.file.warnings, *_match_warnings(on_disk, match, len(rough), poses.path, kind)]
    stamps, timed = _stamps(matched, match, poses.file)
    return _Matched(matched, timed, stamps, warnings, len(on_disk) - len(matched))


def _stamps(matched: list[Frame], match: timestamps.Match, file: PoseFile) -> tuple[list[str], Trajectory]:
    """Times with all digits that names and pose file have, and the poses at these times."""
    texts = []
    for frame, pose in zip(matched, match.own, strict=True):
        name = "" if match.by_order else frame.stamp
        if pose < 0:
            texts.append(tum.padded(name))
            continue
        written = file.stamps[pose] or tum.time_text(file.trajectory.times[pose])
        texts.append(tum.padded(timestamps.merged(name, written)))
    times = np.array([float(text) for text in texts])
    if (np.diff(times) <= 0).any():
        times = match.poses.times
        texts = [tum.time_text(time) for time in times]
    return texts, Trajectory(times, match.poses.world_from_sensor)


def _open_frames(root: Path, folder: str, poses: _Poses, suffixes: tuple[str, ...], kind: str) -> PosedFrames:
    matched = _matched(root, folder, poses, suffixes, kind)
    check = pcd.check_pcd if kind == "scan" else images.check_image
    fingerprint = f"{poses.name} {files.sha256(poses.path)}"
    return posed_frames.checked(
        matched.frames,
        matched.poses,
        check,
        kind,
        fingerprint,
        tuple(matched.warnings),
        matched.stamps,
        matched.skipped,
    )


def _match_warnings(
    listed: list[Frame], match: timestamps.Match, poses: int, pose_path: Path, kind: str
) -> list[str]:
    matched = set(match.files.tolist())
    without = [frame.path.name for index, frame in enumerate(listed) if index not in matched]
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


def _open_images(root: Path, folder: str, poses: _Poses, calibration: Calibration) -> PosedFrames:
    """Images of the size that most of them have."""
    opened = _open_frames(root, folder, poses, images.SUFFIXES, "image")
    _need_camera(root, calibration)
    return posed_frames.of_one_size(opened, root / folder)


def _need_camera(root: Path, calibration: Calibration) -> None:
    if calibration.camera is None:
        raise _not_in_config(root, "cam_fx and other camera keys", "cam_model with cam_fx, ...")
    if calibration.camera_from_lidar is None:
        raise _not_in_config(root, "Rcl and Pcl", "extrin_calib with Rcl and Pcl")


def _not_in_config(root: Path, what: str, wanted: str) -> InputError:
    path = root / "config.yaml"
    if os.path.exists(path):
        return InputError(path, f"has no {what}", f"add {wanted}")
    others = yaml_files.find(root)
    if others:
        names = ", ".join(other.name for other in others[:3])
        return InputError(root, f"none of its YAML files ({names}) has {what}", f"add {wanted}")
    mend = f"write it: cam_model with cam_fx, ..., and extrin_calib with Rcl and Pcl; or remove {IMAGE_FOLDERS[0]}"
    return InputError(path, f"there is no such file, and so the images have no {what}", mend)


def _camera_from_scan(calibration: Calibration) -> np.ndarray:
    """camera_from_lidar @ lidar_from_body (the scans are in the body frame); identity without camera."""
    if calibration.camera_from_lidar is None:
        return np.eye(4)
    return np.asarray(calibration.camera_from_lidar @ geometry.inverse(calibration.body_from_lidar))


def _digest(
    calibration: Calibration, scans: PosedFrames, pictures: PosedFrames | None = None, kind: str = CAMERA
) -> str:
    paths = sorted({calibration.camera_path, calibration.extrinsic_path})
    lines = [f"calibration {files.sha256(path)}" for path in paths if os.path.isfile(path)]
    return posed_frames.digest(
        scans, pictures, [*lines, *([f"image poses {kind}"] if kind != CAMERA else [])]
    )
