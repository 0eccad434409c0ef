"""Files and folders of other programs for the fuzzer: seeds by the tests' own writers, and what must hold after."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_mutations import Files

sys.path.append(
    str(Path(__file__).resolve().parents[1] / "support")
)  # the fuzzer is a program of its own, too

import calibration_writers
import kitti_writers
import lidar_writers
import ouster_writers
import rgbd_writers

from lvba import geometry
from lvba.errors import InputError
from lvba.sources import calibrations, folders
from lvba.sources.bags import ouster_metadata
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.bags.ouster_scans import ScanMaker
from lvba.sources.bags.sensor_clock import SensorClock
from lvba.sources.source import PoseSample, RawScan

_CALIBRATIONS = (
    "fast_livo",
    "r3live",
    "kalibr",
    "openvins",
    "m2mapping",
    "spires",
    "dvlc",
    "opencv",
    "colmap",
    "orb_slam",
    "orb_slam2",
)
_FOLDERS: tuple[Callable[[Path], object], ...] = (
    *(rgbd_writers.tum, rgbd_writers.replica, rgbd_writers.scannet, rgbd_writers.stray, rgbd_writers.polycam),
    *(rgbd_writers.seven_scenes, rgbd_writers.bundle_fusion),
    *(
        rgbd_writers.record3d,
        lidar_writers.hba,
        lidar_writers.balm,
        lidar_writers.kiss_icp,
        lidar_writers.spires,
    ),
    *(kitti_writers.kitti_raw, kitti_writers.kitti360),
)


def _files_below(folder: Path) -> Files:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def calibration_seeds(folder: Path) -> list[Files]:
    """One file of each format."""
    place = geometry.exp(np.array([[0.02, -0.01, 0.03, 0.1, 0, 0], [0.3, -0.2, 1.0, 0, 0, 0.1]]))
    seeds = []
    for name in _CALIBRATIONS:
        path = getattr(calibration_writers, name)(folder, (-0.1, 0.1, 1e-4, 1e-4), False, *place)
        seeds.append({path.name: path.read_bytes()})
    return seeds


def read_calibrations(folder: Path) -> None:
    """Rotations are rotations, and cameras finite."""
    for path in sorted(folder.iterdir()):
        rig = calibrations.read([path])
        for transform in (rig.camera_from_lidar, rig.body_from_lidar, rig.body_from_camera):
            if transform is not None:
                turned = transform[:3, :3]
                assert np.allclose(turned @ turned.T, np.eye(3), atol=1e-6)
                assert np.isfinite(transform).all()
        if rig.camera is not None:
            assert np.isfinite([rig.camera.fx, rig.camera.fy, rig.camera.cx, *rig.camera.distortion]).all()
            assert rig.camera.fx > 0


def folder_seeds(folder: Path) -> list[Files]:
    """One folder of each family."""
    seeds = []
    for number, write in enumerate(_FOLDERS):
        inside = folder / str(number)
        inside.mkdir()
        write(inside)
        day = inside / kitti_writers.DAY
        seeds.append(_files_below(day if day.is_dir() else inside))
    return seeds


def read_folder(folder: Path) -> None:
    """What comes out has times in order, finite poses, and as many rows and times as points."""
    source = folders.find(folder)
    if source is None:
        raise InputError(folder, "is none that is known", "leave the files that it is known by")
    stamp = 0
    for _, record in source.records([stream.name for stream in source.describe().streams]):
        assert stamp <= record.stamp < 2**63
        stamp = record.stamp
        if isinstance(record, RawScan):
            for column in (record.rows, record.times, record.intensity):
                assert column is None or len(column) == len(record.points)
        if isinstance(record, PoseSample):
            assert np.isfinite(record.parent_from_child).all()


def packet_seeds(folder: Path) -> list[Files]:
    """Metadata of an Ouster, and packets of two turns, each behind its length."""
    seeds = []
    for number, profile in enumerate(ouster_writers.PROFILES):
        device = ouster_writers.Device(profile, beams=2, columns=32, window=(0, 31))
        turns = [ouster_writers.turn(device, frame, 10**12 + frame * 10**8) for frame in (65535, 65536)]
        data = [each for seen in turns for each in ouster_writers.packets(device, seen)]
        listed = b"".join(len(each).to_bytes(2, "little") + each for each in data)
        text = device.metadata(nested=bool(number % 2))
        seeds.append({"metadata.json": text.encode(), "packets": listed})
    return seeds


def read_packets(folder: Path) -> None:
    """Points are finite, and every column has their number; what is none of the sensor's is refused."""
    text = (folder / "metadata.json").read_bytes().decode(errors="replace")
    data, at, scans = (folder / "packets").read_bytes(), 0, []
    try:
        make = ScanMaker(ouster_metadata.parse(text), SensorClock(), "")
        while at < len(data):
            length = int.from_bytes(data[at : at + 2], "little")
            packet = np.frombuffer(data[at + 2 : at + 2 + length], np.uint8)
            scans += make({"buf": packet}, 1_700_000_000 * 10**9 + at, "")
            at += 2 + length
    except Undecodable as error:
        raise InputError(folder, str(error), "give others") from error
    for scan in (*scans, *make.finish()):
        assert abs(scan.stamp) < 2**63
        assert np.isfinite(scan.points).all()
        for column in (scan.rows, scan.times, scan.intensity):
            assert column is not None
            assert len(column) == len(scan.points) > 0
