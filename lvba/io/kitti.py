"""A sequence of the KITTI odometry benchmark as a `Dataset`.

    SEQUENCE/
      velodyne/000000.bin   image_2/000000.png (or image_3; gray: image_0, image_1; rectified)
      times.txt             one time (s) a line, of scan and image of that number
      poses.txt             12 numbers a line, world from camera 0 (row by row); also ../../poses/SEQUENCE.txt
      calib.txt             P0 to P3: 3x4 projections from camera 0; Tr: 3x4, camera 0 from LiDAR

The world is camera 0 at the start: x right, y down, z forward.
Source: Geiger, Lenz, Urtasun 2012, and the readme of its development kit.
"""

import os
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera, Scan
from lvba.errors import InputError
from lvba.io import files, frames, images, input_checks, posed_frames, velodyne
from lvba.io.frames import Frame
from lvba.io.posed_frames import PosedFrames
from lvba.trajectory import Trajectory

SCAN_FOLDER, CALIBRATION, TIMES, POSES = "velodyne", "calib.txt", "times.txt", "poses.txt"
IMAGE_FOLDERS = {"image_2": "P2", "image_3": "P3", "image_0": "P0", "image_1": "P1"}
"""With the projection of each; the first that is there is taken: colors before gray."""
_TOLERANCE = 1e-3


def is_kitti(root: Path) -> bool:
    """Whether the folder looks like a KITTI odometry sequence."""
    return os.path.isdir(root / SCAN_FOLDER) and os.path.isfile(root / CALIBRATION)


def _image_folder(root: Path) -> str | None:
    return next((name for name in IMAGE_FOLDERS if os.path.isdir(root / name)), None)


def open_kitti(root: Path) -> Dataset:
    """The sequence in a folder; bad frames are left out as in `lvba.io.dataset.open_dataset`.

    Raises: InputError
    """
    calibration, times, pose_path, world_from_camera0 = _tables(root)
    world_from_scan = world_from_camera0 @ calibration["Tr"]
    scans = _open_frames(root / SCAN_FOLDER, (velodyne.SUFFIX,), "scan", times, world_from_scan, pose_path)
    image_folder = _image_folder(root)
    cameras: tuple[RigCamera, ...] = ()
    if image_folder is None:
        pictures = None
    else:
        intrinsics, camera_from_camera0 = _split_projection(root, calibration, IMAGE_FOLDERS[image_folder])
        world_from_camera = world_from_camera0 @ geometry.inverse(camera_from_camera0)
        opened = _open_frames(
            root / image_folder, images.SUFFIXES, "image", times, world_from_camera, pose_path
        )
        pictures = posed_frames.of_one_size(opened, root / image_folder)
        fx, fy, cx, cy = intrinsics
        size = pictures.sizes[0]
        camera = Camera(width=size.width, height=size.height, fx=fx, fy=fy, cx=cx, cy=cy)
        cameras = (RigCamera(camera, camera_from_camera0 @ calibration["Tr"]),)
    dataset = Dataset(
        root=str(root),
        scan_paths=scans.paths,
        scans=scans.poses,
        image_paths=() if pictures is None else pictures.paths,
        images=Trajectory(np.zeros(0), np.zeros((0, 4, 4))) if pictures is None else pictures.poses,
        cameras=cameras,
        warnings=scans.warnings + (() if pictures is None else pictures.warnings),
        digest=posed_frames.digest(
            scans, pictures, [files.sha256(root / name) for name in (CALIBRATION, TIMES)]
        ),
    )
    dataset = input_checks.add(dataset, pose_path, scans, pictures)
    return posed_frames.shifted(input_checks.with_points(dataset, pose_path, _load_scan, readings=False))


def _load_scan(dataset: Dataset, index: int) -> Scan:
    return velodyne.read_bin(dataset.scan_paths[index])


def check_names(root: Path) -> None:
    """What `open_kitti` finds wrong before it looks into scans and images.

    Raises: InputError
    """
    calibration, times, pose_path, poses = _tables(root)
    _timed(root / SCAN_FOLDER, (velodyne.SUFFIX,), "scan", len(times), len(poses), pose_path)
    image_folder = _image_folder(root)
    if image_folder is not None:
        _split_projection(root, calibration, IMAGE_FOLDERS[image_folder])
        _timed(root / image_folder, images.SUFFIXES, "image", len(times), len(poses), pose_path)


def _tables(root: Path) -> tuple[dict[str, np.ndarray], np.ndarray, Path, np.ndarray]:
    """Calibration, times (N,) s, and the pose file with its poses (M, 4, 4), world from camera 0."""
    calibration = _read_calibration(root / CALIBRATION, IMAGE_FOLDERS.get(_image_folder(root) or "", ""))
    times = _table(root / TIMES, 1)[:, 0]
    if (np.diff(times) <= 0).any():
        raise InputError(root / TIMES, "times are not ascending", "sort them")
    pose_path = _pose_path(root)
    return calibration, times, pose_path, _poses(pose_path)


def _timed(
    folder: Path, suffixes: tuple[str, ...], kind: str, times: int, poses: int, pose_path: Path
) -> tuple[dict[int, Frame], list[str], int]:
    """Frames by number; those beyond the times or poses are left out, told and counted."""
    on_disk, warnings = frames.find(folder, suffixes, kind)
    count = min(times, poses)
    numbers = [int(frame.time) for frame in on_disk]
    without = [frame.path.name for frame, number in zip(on_disk, numbers, strict=True) if number >= count]
    numbers = [number for number in numbers if number < count]
    if not numbers:
        raise InputError(
            pose_path, f"has no poses for the {kind}s in {folder.name}", "give a pose for each frame"
        )
    warnings = [*warnings, *frames.left_out(without, f"{kind}s beyond the last pose", pose_path)]
    by_number = {int(frame.time): frame for frame in on_disk}
    return {number: by_number[number] for number in numbers}, warnings, len(without)


def _open_frames(
    folder: Path, suffixes: tuple[str, ...], kind: str, times: np.ndarray, poses: np.ndarray, pose_path: Path
) -> PosedFrames:
    by_number, warnings, skipped = _timed(folder, suffixes, kind, len(times), len(poses), pose_path)
    numbers = list(by_number)
    timed = [Frame(frame.path, float(times[number])) for number, frame in by_number.items()]
    check = velodyne.check_bin if kind == "scan" else images.check_image
    fingerprint = f"{POSES} {files.sha256(pose_path)}"
    return posed_frames.checked(
        timed,
        Trajectory(times[numbers], poses[numbers]),
        check,
        kind,
        fingerprint,
        tuple(warnings),
        skipped=skipped,
    )


def _pose_path(root: Path) -> Path:
    inside, outside = root / POSES, root.parent.parent / "poses" / f"{root.name}.txt"
    if not os.path.exists(inside) and not os.path.exists(outside):
        raise InputError(
            inside, "no poses: there is no such file", "write 12 numbers a line: world from camera 0"
        )
    return inside if os.path.exists(inside) else outside


def _poses(path: Path) -> np.ndarray:
    """(N, 4, 4), rotations made orthonormal."""
    table = _table(path, 12).reshape(-1, 3, 4)
    off = np.abs(table[:, :, :3] @ np.swapaxes(table[:, :, :3], 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = ~(off <= 1e-2) | (np.linalg.det(table[:, :, :3]) < 0)
    if bad.any():
        raise InputError(
            f"{path}:{bad.argmax() + 1}", "no rotation", "write 12 numbers a line: world from camera 0"
        )
    return geometry.orthonormalize(geometry.from_rotation_translation(table[:, :, :3], table[:, :, 3]))


def _table(path: Path, columns: int) -> np.ndarray:
    """(N, columns) float64 of the lines of a file."""
    rows = []
    for number, line in enumerate(files.read_text(path).rstrip().split("\n"), 1):
        rows.append(_row(f"{path}:{number}", line.split(), columns))
    return np.array(rows)


def _row(where: str, words: list[str], columns: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise InputError(where, "not only numbers", f"write {columns} numbers a line") from error
    if len(values) != columns or not np.isfinite(values).all() or np.abs(values).max() > 1e12:
        raise InputError(where, f"not {columns} finite numbers", f"write {columns} numbers a line")
    return values


def _read_calibration(path: Path, used: str) -> dict[str, np.ndarray]:
    """Tr as (4, 4), and as (3, 4) P2, P3 and the projection that is used, where they are there."""
    matrices: dict[str, np.ndarray] = {}
    for number, line in enumerate(files.read_text(path).split("\n"), 1):
        key, _, rest = line.partition(":")
        if key.strip() in ("P2", "P3", "Tr", used):
            matrices[key.strip()] = np.array(_row(f"{path}:{number}", rest.split(), 12)).reshape(3, 4)
    if "Tr" not in matrices:
        raise InputError(path, "has no line Tr", "add Tr: 12 numbers, camera 0 from LiDAR")
    rotation = matrices["Tr"][:, :3]
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() <= _TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(path, "Tr is no rotation", "correct its numbers")
    matrices["Tr"] = geometry.orthonormalize(
        geometry.from_rotation_translation(rotation, matrices["Tr"][:, 3])
    )
    return matrices


def _split_projection(
    root: Path, calibration: dict[str, np.ndarray], key: str
) -> tuple[tuple[float, float, float, float], np.ndarray]:
    """fx, fy, cx, cy, and the (4, 4) camera from camera 0, of P = K [I | t]."""
    if key not in calibration:
        raise InputError(
            root / CALIBRATION, f"has no line {key}", f"add {key}: 12 numbers, the projection from camera 0"
        )
    projection = calibration[key]
    matrix = projection[:, :3]
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if not (fx > 0 and fy > 0) or np.abs(matrix - expected).max() > _TOLERANCE:
        raise InputError(root / CALIBRATION, "a projection is not K [I | t]", f"correct {key}")
    translation = np.linalg.solve(matrix, projection[:, 3])
    return (float(fx), float(fy), float(cx), float(cy)), geometry.from_rotation_translation(
        np.eye(3), translation
    )
