"""A recording folder with fewer frames: scans, images and poses of some moments, as they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.dataset import CAMERA, Dataset
from lvba.errors import InputError
from lvba.io import calibration, files, image_poses, imu, pcd, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES, load_scan, open_dataset
from lvba.progress import Progress
from lvba.sources.folders import recordings
from lvba.sources.importing import folder, stamp_order
from lvba.sources.importing.options import ImportOptions
from lvba.sources.importing.selection import Selection
from lvba.sources.importing.writing import stamp_text
from lvba.sources.source import SourceDescription
from lvba.trajectory import Trajectory

_BESIDE = (imu.NAME, "gnss.csv")
_NOTE = "Frames, poses and calibration are those of the recording; nothing was decided."


def is_meant(description: SourceDescription, options: ImportOptions) -> bool:
    """Whether options ask for fewer frames of a recording folder, and for nothing else."""
    every = ImportOptions()
    rest = replace(options, every=every.every, rate=every.rate, start=every.start, stop=every.stop)
    return description.format == recordings.RECORDING and rest == every and options != every


def thin(path: str, options: ImportOptions, out: Path, progress: Progress) -> dict[str, object]:
    """Writes those frames into a folder that is ready for them; what was written, for recording.yaml.

    Raises InputError: as `open_dataset`, fewer than two scans are wanted, or a file cannot be written.
    """
    dataset = open_dataset(path)
    scans = recordings.stamps(dataset.scan_stamps, dataset.scans)
    images = recordings.stamps(dataset.image_stamps, dataset.images)
    wanted = [_wanted(each, scans[0], options) for each in (scans, images)]
    if len(wanted[0]) < 2:
        raise InputError(path, f"{len(wanted[0])} scans are wanted", "check --every, --rate, --from and --to")
    total = sum(map(len, wanted))
    for done, index in enumerate(wanted[0], 1):
        scan = out / folder.SCANS / f"{stamp_text(scans[index])}.pcd"
        if not scan.exists():
            _write_scan(dataset, index, scan)
        progress("frames", done, total)
    for done, index in enumerate(wanted[1], len(wanted[0]) + 1):
        image = Path(dataset.image_paths[index])
        copy = out / folder.IMAGES / f"{stamp_text(images[index])}{image.suffix}"
        if not copy.exists():
            _copy(image, copy)
        progress("frames", done, total)
    _texts(dataset, out, scans, images, wanted)
    for name in _BESIDE:
        if (Path(path) / name).is_file():
            _copy(Path(path) / name, out / name)
    return {
        "source": {"name": Path(path).name, "format": recordings.RECORDING},
        "written": {"scans": len(wanted[0]), "images": len(wanted[1])},
        "notes": [_NOTE],
        "warnings": list(dataset.warnings),
    }


def _wanted(stamps: list[int], zero: int, options: ImportOptions) -> list[int]:
    """Numbers of those of ascending stamps (ns) that options ask for."""
    in_order = stamp_order.in_order(np.array(stamps, np.int64))
    selection = Selection.of(options, zero, options.every, in_order)
    return [number for number, stamp in enumerate(stamps) if selection.wants(stamp)]


def _write_scan(dataset: Dataset, index: int, path: Path) -> None:
    """The bytes of a PCD file as they are, and scans of other formats as PCD."""
    source = Path(dataset.scan_paths[index])
    if source.suffix.lower() == ".pcd":
        _copy(source, path)
    else:
        scan = load_scan(dataset, index)
        pcd.write_pcd(path, scan.points, scan.intensity, scan.time)


def _copy(source: Path, path: Path) -> None:
    files.write_bytes(path, files.read_bytes(source))


def _texts(dataset: Dataset, out: Path, scans: list[int], images: list[int], wanted: list[list[int]]) -> None:
    """Poses and calibration."""
    of_images = Trajectory(
        dataset.images.times,
        image_poses.from_camera(
            dataset.images.world_from_sensor, dataset.image_poses, dataset.camera_from_scan
        ),
    )
    for name, trajectory, stamps, numbers, comment in (
        (
            SCAN_POSES,
            dataset.scans,
            scans,
            wanted[0],
            "body (the scans' frame) to world: t tx ty tz qx qy qz qw",
        ),
        (IMAGE_POSES, of_images, images, wanted[1], image_poses.comment(dataset.image_poses or CAMERA)),
    ):
        if not numbers:
            continue
        poses = trajectory.world_from_sensor[numbers].copy()
        poses[:, :3, 3] += dataset.origin
        lines = [stamp_text(stamps[number]) for number in numbers]
        text = tum.trajectory_text(
            Trajectory(trajectory.times[numbers], poses), comment=comment, stamps=lines
        )
        files.write_text(out / name, text)
    body_from_lidar = geometry.from_rotation_translation(
        dataset.sensor_axes_scan, dataset.sensor_position_scan
    )
    camera = dataset.camera if wanted[1] else None
    extrinsic = np.asarray(dataset.camera_from_scan @ body_from_lidar) if wanted[1] else None
    more = {image_poses.KEY: dataset.image_poses} if wanted[1] else None
    scan_from_imu = dataset.scan_from_imu if dataset.imu_path else None
    config = calibration.recording_text(camera, body_from_lidar, extrinsic, more, scan_from_imu)
    files.write_text(out / "config.yaml", config)
