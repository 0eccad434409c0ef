"""Recordings of RGB-D cameras in the layout of the TUM RGB-D benchmark (also ICL-NUIM and Bonn RGB-D Dynamic).

    SEQUENCE/
      rgb.txt depth.txt      time and file name a line; or associations.txt, both in one line
      groundtruth.txt        TUM: time and pose of the colour camera, x right, y down, z forward; optional
      rgb/*.png  depth/*.png 16 bits, 5000 a meter, registered to the colour image pixel by pixel; 0: nothing measured
      camera.yaml            not of the benchmark: intrinsics, in any format of `lvba.sources.calibrations`

The intrinsics are in no file of the benchmark: they are known here for its own sequences, whose folders are named after
freiburg1, freiburg2 or freiburg3. Source: Sturm et al. 2012, and https://cvg.cit.tum.de/data/datasets/rgbd-dataset
"""

import os
import re
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import tum, yaml_files
from lvba.sources import calibrations
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import FRAME, DepthCamera, image_files, image_item, size_of_first
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, at_hand
from lvba.sources.source import Kind, KnownGeometry, PoseSample

UNITS_A_METER = 5000.0
"""Of depth images, where no camera file says otherwise (`_UNITS`)."""
_UNITS = ("DepthMapFactor", "RGBD.DepthMapFactor")
"""Names of ORB-SLAM2 and 3 for it; sensors that are not of the benchmark often count millimeters: 1000."""
_CLOSEST_NS = 1_000_000
"""Time from image to image, in the middle; nearer, the numbers are no times."""
_FRAMES_A_SECOND = 30
_NUMBERED = 1_000_000
"""Whole numbers below are numbers of frames, not seconds since 1970 (ICL-NUIM)."""
_CAMERAS = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
_DISTORTION = {
    "freiburg1": (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "freiburg3": (0.0, 0.0, 0.0, 0.0),
}
_CAMERA_FILES = ("camera.yaml", "camera.yml", "calibration.yaml", "config.yaml", "cameras.txt")


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    lists = all(os.path.isfile(path / name) for name in ("rgb.txt", "depth.txt"))
    paired = os.path.isfile(path / "associations.txt") and os.path.isdir(path / "depth")
    return lists or paired


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a list is malformed, a file is missing, or the intrinsics are not known.
    """
    colors, depths = _lists(path)
    poses, pose_notes = _poses(path)
    counted = _is_counted([stamp for stamp, _ in colors + depths] + [stamp for stamp, _ in poses])
    camera, origin, camera_notes = _camera(path, [file for _, file in colors])
    units, units_origin = _units(path)
    depth_camera = DepthCamera(camera, 1 / units)
    items: list[Item] = [image_item("rgb", file, _time(stamp, counted)) for stamp, file in colors]
    items += [depth_camera.item("depth", file, _time(stamp, counted)) for stamp, file in depths]
    for stamp, pose in poses:
        when = _time(stamp, counted)
        sample = PoseSample(stamp=when, parent="world", child=FRAME, parent_from_child=pose)
        items.append(at_hand(when, "groundtruth", sample))
    streams = [
        StreamKind("rgb", Kind.IMAGES, image_files(file for _, file in colors)),
        StreamKind("depth", Kind.SCANS, f"depth images, {units:g} a meter", XYZ),
    ]
    if poses:
        streams.append(StreamKind("groundtruth", Kind.POSES, "TUM poses"))
    notes = [
        f"intrinsics: {origin}.",
        *camera_notes,
        f"depth images: {units:g} a meter, {units_origin}.",
        "depth images are taken to be registered to the colour images, and poses to be of the colour camera.",
        *depth_camera.notes,
        *pose_notes,
    ]
    if counted:
        notes.append(f"times are numbers of frames: {_FRAMES_A_SECOND} frames a second are assumed.")
    known = KnownGeometry(
        camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
    )
    return FolderSource(path, "TUM RGB-D folder", streams, items, known, notes)


def _lists(path: Path) -> tuple[list[tuple[int, Path]], list[tuple[int, Path]]]:
    """Time (ns) and file of colour and depth images."""
    if os.path.isfile(path / "rgb.txt"):
        return _list(path, "rgb.txt"), _list(path, "depth.txt")
    colors: list[tuple[int, Path]] = []
    depths: list[tuple[int, Path]] = []
    pairs = path / "associations.txt"
    for number, words in tables.lines_of_words(pairs):
        where = f"{pairs}:{number}"
        if len(words) != 4:
            raise InputError(where, f"{len(words)} words instead of 4", "write time file time file")
        for stamp, name in ((words[0], words[1]), (words[2], words[3])):
            target = depths if name.startswith("depth") else colors
            target.append((tables.nanoseconds(where, stamp), _inside(path, where, name)))
    if not colors or not depths:
        raise InputError(pairs, "names no colour or no depth images", "name files in rgb/ and depth/")
    return colors, depths


def _list(path: Path, name: str) -> list[tuple[int, Path]]:
    files: list[tuple[int, Path]] = []
    for number, words in tables.lines_of_words(path / name):
        where = f"{path / name}:{number}"
        if len(words) != 2:
            raise InputError(where, f"{len(words)} words instead of 2", "write time and file name")
        files.append((tables.nanoseconds(where, words[0]), _inside(path, where, words[1])))
    if not files:
        raise InputError(path / name, "names no files", "write time and file name a line")
    apart = np.diff(sorted(stamp for stamp, _ in files))
    if len(apart) and np.median(apart) < _CLOSEST_NS:
        problem = f"times are {float(np.median(apart)) / 1e6:.2g} ms apart: these are no times of images"
        raise InputError(path / name, problem, "write seconds, in the order in which images were taken")
    missing = next((file for _, file in files if not os.path.exists(file)), None)
    if missing is not None and not os.path.isdir(missing.parent):
        raise InputError(
            missing.parent, f"there is no such folder, but {name} names files in it", "copy it again"
        )
    return files


def _inside(path: Path, where: str, name: str) -> Path:
    """The file that a list names, which must lie in the folder."""
    if os.path.isabs(name) or ".." in Path(name).parts or not name.isprintable():
        raise InputError(where, f"{name[:80]!r} is no file in the folder", "name files below it")
    return path / name


def _poses(path: Path) -> tuple[list[tuple[int, np.ndarray]], list[str]]:
    """Times (ns) and poses of the colour camera."""
    names = [path / "groundtruth.txt", *sorted(path.glob("*.gt.freiburg"))]
    file = next((name for name in names if os.path.isfile(name)), None)
    if file is None:
        return [], ["there is no groundtruth.txt: poses must come from elsewhere."]
    read = tum.read_pose_file(file)
    texts = [stamp or repr(time) for stamp, time in zip(read.stamps, read.trajectory.times, strict=True)]
    stamps = [tables.nanoseconds(file, text) for text in texts]
    return list(zip(stamps, read.trajectory.world_from_sensor, strict=True)), list(read.warnings)


def _is_counted(stamps: list[int]) -> bool:
    """Whether all times are whole numbers from about zero: numbers of frames."""
    second = 1_000_000_000
    return all(stamp % second == 0 and stamp < _NUMBERED * second for stamp in stamps)


def _time(stamp: int, counted: bool) -> int:
    return stamp // _FRAMES_A_SECOND if counted else stamp


def _units(path: Path) -> tuple[float, str]:
    """Steps of the depth images in a meter, and where that is from."""
    for name in _CAMERA_FILES:
        if name.endswith(".txt") or not os.path.isfile(path / name):
            continue
        for _, values in yaml_files.mappings(yaml_files.read_yaml(path / name)):
            for key in _UNITS:
                if key in values:
                    value = values[key]
                    if not isinstance(value, int | float) or not 1 <= value <= 1e6:
                        problem = f"{key} is {str(value)[:40]!r}, not 1 to 1000000 steps in a meter"
                        raise InputError(
                            path / name, problem, "write 1000 where depth images count millimeters"
                        )
                    return float(value), f"by {key} of {path / name}"
    return UNITS_A_METER, f"as in the benchmark; others: write {_UNITS[0]} to {_CAMERA_FILES[0]} there"


def _camera(path: Path, images: list[Path]) -> tuple[Camera, str, tuple[str, ...]]:
    """The colour camera, where it is from, and what its file has that is not used."""
    size = size_of_first(images)
    for name in _CAMERA_FILES:
        if os.path.isfile(path / name):
            rig = calibrations.read([path / name])
            camera = rig.camera_for(size)
            if camera is None:
                raise InputError(path / name, "holds no camera", "write the intrinsics there")
            return camera, str(path / name), rig.notes
    match = re.search(r"(?:freiburg|fr)([123])", os.path.abspath(path).rsplit(os.sep, 1)[-1])
    if match is None or (size.width, size.height) != (640, 480):
        mend = "write its intrinsics to camera.yaml there (cam_model with cam_width, cam_fx, ..., or any format known)"
        raise InputError(
            path, "has no intrinsics, and is no freiburg1, 2 or 3 of the benchmark by its name", mend
        )
    name = f"freiburg{match[1]}"
    fx, fy, cx, cy = _CAMERAS[name]
    camera = Camera(width=640, height=480, fx=fx, fy=fy, cx=cx, cy=cy, distortion=_DISTORTION[name])
    return camera, f"those of {name}, by the name of the folder", ()
