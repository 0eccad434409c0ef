"""A sequence of the Oxford Spires dataset, as files.

    SEQUENCE/
      processed/vilens-slam/undist-clouds/cloud_SEC_NSEC.pcd    deskewed, in the base frame; VIEWPOINT: world from base
      processed/trajectory/vilens-slam-tum.txt                  the same poses, where VIEWPOINT says none
      raw/cam0/SEC.NSEC.jpg  (cam1, cam2)
    sensor.yaml (configs/ of the dataset's repository) there or up to two folders up: cameras, T_base_lidar

Raw sweeps (raw/lidar-clouds) are not read: they need the IMU. Source: oxspires_tools of the dataset's repository.
"""

import os
from functools import partial
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files, timestamps, tum, yaml_files
from lvba.sources import calibrations
from lvba.sources.calibrations import values
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.depth_scans import IMAGE_FRAME, image_item, size_of_first
from lvba.sources.folders.items import FolderSource, Item, StreamKind, at_hand
from lvba.sources.source import Kind, KnownGeometry, PoseSample

FRAME = "base"
_CLOUDS = Path("processed/vilens-slam/undist-clouds")
_TRAJECTORY = Path("processed/trajectory/vilens-slam-tum.txt")
_IMAGES = Path("raw/cam0")
_CAMERA = "/alphasense_driver_ros/cam0/debayered/image/compressed"
_BASE = "T_base_lidar_t_xyz_q_xyzw"
_HEADER_BYTES = 4096


def is_one(path: Path) -> bool:
    """Whether a folder is a sequence."""
    return os.path.isdir(path / _CLOUDS)


def open_folder(path: Path) -> FolderSource:
    """The sequence.

    Raises: InputError if a file is missing or malformed, or there are images without sensor.yaml.
    """
    clouds = _timed(path / _CLOUDS, ".pcd")
    poses = _poses(path, clouds)
    items: list[Item] = []
    for (stamp, cloud), pose in zip(clouds, poses, strict=True):
        items.append(Item(stamp, "scans", partial(posed_scans.read, cloud, stamp, FRAME), str(cloud)))
        items.append(at_hand(stamp, "poses", PoseSample(stamp, "world", FRAME, pose)))
    streams = [StreamKind("scans", Kind.SCANS, "PCD files"), StreamKind("poses", Kind.POSES, "VILENS")]
    known = KnownGeometry(body_from_lidar=np.eye(4), deskewed=True)
    if os.path.isdir(path / _IMAGES):
        images = _timed(path / _IMAGES, ".jpg")
        items += [image_item("cam0", file, stamp, IMAGE_FRAME) for stamp, file in images]
        streams.append(StreamKind("cam0", Kind.IMAGES, "JPEG files"))
        camera, camera_from_base = _camera(path, [file for _, file in images])
        known = KnownGeometry(
            camera=camera, camera_from_lidar=camera_from_base, body_from_lidar=np.eye(4), deskewed=True
        )
    notes = ["scans are in the base frame, deskewed by VILENS; of several cameras cam0 is read."]
    return FolderSource(path, "Oxford Spires sequence", streams, items, known, notes)


def _timed(folder: Path, suffix: str) -> list[tuple[int, Path]]:
    """Time (ns) and path of the files, in time order."""
    timed = []
    for name in files.names_in(folder):
        stamp = timestamps.stamp(name) if name.lower().endswith(suffix) else None
        if stamp is not None:
            timed.append((tables.nanoseconds(folder / name, stamp), folder / name))
    if not timed:
        raise InputError(folder, f"holds no {suffix} files with a time in the name", "unpack the data there")
    return sorted(timed)


def _poses(path: Path, clouds: list[tuple[int, Path]]) -> list[Pose]:
    """World from base of each cloud: its VIEWPOINT; where these are all the identity, of the trajectory."""
    viewpoints = [_viewpoint(cloud) for _, cloud in clouds]
    if any(np.abs(pose - np.eye(4)).max() > 1e-9 for pose in viewpoints):
        return viewpoints
    if not os.path.isfile(path / _TRAJECTORY):
        raise InputError(
            clouds[0][1], f"VIEWPOINT says no pose, and there is no {_TRAJECTORY}", "unpack it, too"
        )
    trajectory = tum.read_pose_file(path / _TRAJECTORY).trajectory
    times = np.array([stamp / 1e9 for stamp, _ in clouds])
    match = timestamps.match(times, trajectory, path / _TRAJECTORY)
    if len(match.files) != len(clouds):
        problem = f"has poses for {len(match.files)} of {len(clouds)} clouds"
        raise InputError(path / _TRAJECTORY, problem, "remove the others")
    return list(match.poses.world_from_sensor)


def _viewpoint(cloud: Path) -> Pose:
    """x y z qw qx qy qz of the header."""
    for line in files.read_start(cloud, _HEADER_BYTES).split(b"\n")[:20]:
        words = line.decode("ascii", "replace").split()
        if words and words[0] == "VIEWPOINT":
            row = tables.numbers(cloud, words[1:], 7, "VIEWPOINT x y z qw qx qy qz")
            return tables.quaternion_pose(cloud, row[:3], row[[4, 5, 6, 3]])
    raise InputError(cloud, "has no VIEWPOINT", "give the clouds as they were downloaded")


def _camera(path: Path, images: list[Path]) -> tuple[Camera, Pose]:
    """cam0, and camera from base."""
    whole = Path(os.path.abspath(path))
    places = [folder / "sensor.yaml" for folder in (path, whole.parent, whole.parent.parent)]
    file = next((place for place in places if os.path.isfile(place)), None)
    if file is None:
        mend = "put sensor.yaml (configs/ of the oxford_spires_dataset repository) there, or remove raw/cam0"
        raise InputError(places[0], "there is no such file, and so the images have no calibration", mend)
    rig = calibrations.read([file], _CAMERA)
    camera = rig.camera_for(size_of_first(images))
    document = yaml_files.read_yaml(file)
    base = values.need(file, document["sensor"], _BASE, "sensor.") if "sensor" in document else None
    if camera is None or rig.camera_from_lidar is None or base is None:
        raise InputError(file, "has no camera cam0 with its extrinsic", "give sensor.yaml of the repository")
    base_from_lidar = values.translation_and_quaternion(file, _BASE, base)
    return camera, np.asarray(rig.camera_from_lidar @ geometry.inverse(base_from_lidar))
