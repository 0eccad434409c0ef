"""What is fuzzed: every reader of files that strangers give, with valid files to start from and what must hold after."""

import io
import os
import random
import shutil
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import fuzz_bags
import fuzz_mutations as change
import fuzz_source_targets as sources
import fuzz_tokens
import numpy as np
from fuzz_mutations import Files

from lvba import config, geometry
from lvba.io import camera_config, exposures, images, imu, pcd, ply, reference, tum
from lvba.io.dataset import load_image, load_scans, open_dataset
from lvba.pipeline import Config
from lvba.sources.bags.writing import BagForm
from lvba.trajectory import Trajectory
from service.cli import batch_manifest
from service.datasets import archives
from service.datasets.intake_budget import IntakeBudget
from service.settings import Limits


@dataclass(frozen=True)
class Target:
    """One reader.

    seeds: makes valid inputs in an empty folder
    read: reads a folder with the files of an input, and checks what comes out
    mend: may make checksums right
    tokens: words that mean something in such files
    """

    seeds: Callable[[Path], list[Files]]
    read: Callable[[Path], object]
    mend: Callable[[random.Random, Files], Files] = lambda rng, files: files
    tokens: tuple[bytes, ...] = ()


def _one(name: str, contents: list[bytes]) -> list[Files]:
    return [{name: content} for content in contents]


# --- scans


def _scans(encoding: str) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        rng = np.random.default_rng(0)
        points = np.round(rng.normal(size=(40, 3)), 2)
        pcd.write_pcd(folder / "a.pcd", points, rng.random(40), rng.random(40), encoding)
        pcd.write_pcd(folder / "b.pcd", np.repeat(points[:4], 30, axis=0), encoding=encoding)
        contents = [(folder / name).read_bytes() for name in ("a.pcd", "b.pcd")]
        return _one("a.pcd", contents + ([_odd_pcd()] if encoding == "binary" else []))

    return make


def _odd_pcd() -> bytes:
    """Fields of other types, with counts and padding, of 5 x 2 points."""
    head = (
        "# .PCD v.7\nVERSION .7\nFIELDS x _ y z rgb normal_x t\nSIZE 8 1 8 8 4 4 8\nTYPE F U F F U F U\n"
        "COUNT 1 3 1 1 1 2 1\nWIDTH 5\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 10\nDATA binary\n"
    )
    kind = np.dtype(
        [
            ("x", "<f8"),
            ("_", "u1", 3),
            ("y", "<f8"),
            ("z", "<f8"),
            ("rgb", "<u4"),
            ("n", "<f4", 2),
            ("t", "<u8"),
        ]
    )
    return head.encode() + np.ones(10, kind).tobytes()


def _read_scan(folder: Path) -> None:
    path = folder / "a.pcd"
    scan = pcd.read_pcd(path)
    assert 0 < len(scan.points) <= path.stat().st_size * 88
    assert np.isfinite(scan.points).all()
    for column in (scan.intensity, scan.time):
        assert column is None or column.shape == (len(scan.points),)


def _check_scan(folder: Path) -> None:
    assert pcd.check_pcd(folder / "a.pcd") > 0
    assert pcd.check_pcd(folder / "a.pcd", (folder / "a.pcd").read_bytes()) > 0


def _maps(folder: Path) -> list[Files]:
    columns = {"x": np.arange(20.0), "y": np.ones(20, np.float32), "red": np.zeros(20, np.uint8)}
    ply.write_ply(folder / "a.ply", columns, ("made for a test",))
    return _one("a.ply", [(folder / "a.ply").read_bytes()])


def _read_map(folder: Path) -> None:
    columns = ply.read_ply(folder / "a.ply")
    assert len({len(column) for column in columns.values()}) <= 1


# --- images


def _pictures(folder: Path) -> list[np.ndarray]:
    rgb = np.random.default_rng(0).integers(0, 255, (21, 34, 3)).astype(np.uint8)
    return [rgb, cv2.GaussianBlur(rgb, (0, 0), 3), rgb[:, :, 0]]


def _pngs(folder: Path) -> list[Files]:
    found = [
        *_pictures(folder),
        _pictures(folder)[0].astype(np.uint16) * 257,
        np.zeros((2000, 2000, 3), np.uint8),
    ]
    return _one("a.png", [cv2.imencode(".png", pixels)[1].tobytes() for pixels in found])


def _jpegs(folder: Path) -> list[Files]:
    ways = [
        [],
        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
        [cv2.IMWRITE_JPEG_RST_INTERVAL, 2],
        [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    ]
    return _one(
        "a.jpg",
        [cv2.imencode(".jpg", pixels, way)[1].tobytes() for pixels in _pictures(folder) for way in ways],
    )


def _read_image(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        size = images.check_image(folder / name)
        images.check_image(folder / name, (folder / name).read_bytes())
        rgb = images.read_image(folder / name)
        assert rgb.shape == (size.height, size.width, 3)
        assert rgb.dtype == np.uint8

    return read


def _mend_png(rng: random.Random, files: Files) -> Files:
    return {
        name: change.right_png(content) if rng.random() < 0.7 else content for name, content in files.items()
    }


# --- text


def _poses(folder: Path) -> list[Files]:
    return _one("a.txt", [
        b"# t x y z qx qy qz qw\n1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0.5 0.5 0.5 0.5\n2.5 4 5 6 0.5 0.5 0.5 0.5\n"
        b"2.0 1 1 1 1 0 0 0 # c\n",
        b"timestamp,tx,ty,tz,qx,qy,qz,qw\r\n1630577758.1,1e2,-2,3,0,0,0.7071,0.7071\r\n1630577758.2,1e2,-2,3,0,0,0,-1\r\n",
    ])  # fmt: skip


def _read_poses(folder: Path) -> None:
    _sound(tum.read_trajectory(folder / "a.txt"))


def _sound(found: Trajectory) -> None:
    assert np.isfinite(found.times).all()
    assert np.isfinite(found.world_from_sensor).all()
    assert (np.diff(found.times) > 0).all()
    turned = found.world_from_sensor[:, :3, :3]
    assert np.allclose(turned @ np.swapaxes(turned, 1, 2), np.eye(3), atol=1e-6)


def _imu(folder: Path) -> list[Files]:
    lines = [f"{1.0 + 0.005 * k:.6f},0.1,-0.2,0.3,0.01,0.02,9.81\n" for k in range(8)]
    return _one(imu.NAME, [(imu.HEADER + "".join(lines)).encode(), "".join(lines).encode()])


def _read_imu(folder: Path) -> None:
    found = imu.read(folder / imu.NAME)
    assert (np.diff(found.times) > 0).all()
    assert np.isfinite(found.rates).all()
    assert np.isfinite(found.forces).all()


def _exposures(folder: Path) -> list[Files]:
    return _one("a.csv", [b"timestamp,relative_exposure\n1.5,1\n2.5,0.75\n", b"1.5 1 # c\n0.5 2\n"])


def _read_exposures(folder: Path) -> None:
    found = exposures.read_exposures(folder / "a.csv")
    assert (found.relative > 0).all()
    assert (np.diff(found.times) > 0).all()


_ONE_FILE = b"""\
cam_model:
  cam_width: 32
  cam_height: 24
  scale: 1.0
  cam_fx: 30.5
  cam_fy: 31.0
  cam_cx: 15.5
  cam_cy: 11.5
  cam_d0: -0.1
  cam_d1: 0.02
  cam_d2: 0.001
  cam_d3: -0.002
extrin_calib:
  extrinsic_T: [0.04, 0.02, -0.03]
  extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
  Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]
  Pcl: [0.02, 0.10, -0.03]
"""
_CAMERA_FILE = b"""\
%YAML:1.0
cam_model: Pinhole
cam_width: 64
cam_height: 48
scale: 0.5
cam_fx: 61.0
cam_fy: 62.0
cam_cx: 31.0
cam_cy: 23.0
cam_d0: -7.6160e-02
cam_d1: 1e-3
cam_d2: 0.0
cam_d3: 0.0
"""
_EXTRINSIC_FILE = b"""\
/**:
  ros__parameters:
    common: {img_topic: "/left_camera/image", lid_topic: "/livox/lidar"}
    extrin_calib:
      extrinsic_T: [0.04165, 0.02326, -0.0284]
      extrinsic_R: !!opencv-matrix
        rows: 3
        cols: 3
        dt: d
        data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
      Rcl: [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]
      Pcl: [0.0194384, 0.104689, -0.0251952]
"""


def _calibrations(folder: Path) -> list[Files]:
    return [
        {"config.yaml": _ONE_FILE},
        {"config/camera_pinhole.yaml": _CAMERA_FILE, "config/avia.yaml": _EXTRINSIC_FILE},
    ]


def _read_calibration(folder: Path) -> None:
    found = camera_config.read_calibration(folder)
    assert np.isfinite(found.body_from_lidar).all()
    if found.camera is not None:
        assert found.camera.fx > 0
        assert 0 < found.camera.width <= 100_000


def _manifests(folder: Path) -> list[Files]:
    return _one("batch.yaml", [
        b"- dataset: one\n"
        b"- {dataset: two, name: second, group: g, config: c.yaml, set: [visual.levels=3], reference: truth}\n",
        b"- &a {dataset: ../x}\n- dataset: y\n  set:\n  - split.parts=2\n  - lidar.voxel=1\n",
    ])  # fmt: skip


def _read_manifest(folder: Path) -> None:
    entries = batch_manifest.read(folder / "batch.yaml")
    assert len({entry.name for entry in entries}) == len(entries)
    assert all(Path(entry.name).name == entry.name for entry in entries)
    assert len(batch_manifest.in_turns(entries)) == len(entries)


def _settings(folder: Path) -> list[Files]:
    text = config.to_yaml(Config()).encode()
    return [{"config.yaml": text, "set.txt": b"split.by=none\nmerge.image_rounds=3"},
            {"config.yaml": b"split: {starts: [1, 4], memory_gb: 1e1}\n", "set.txt": b"refine_scans=false"}]  # fmt: skip


def _read_settings(folder: Path) -> None:
    text = (folder / "config.yaml").read_bytes().decode("utf-8", "replace")
    given = (folder / "set.txt").read_bytes().decode("utf-8", "replace").splitlines()
    config.to_yaml(config.load(Config, text, given))


# --- recordings


def _recordings(folder: Path) -> list[Files]:
    times = 1_630_577_758.0 + 0.1 * np.arange(3)
    steps = np.zeros((3, 6))
    steps[:, 3] = 0.1 * np.arange(3)
    lidar, camera = folder / "all_pcd_body", folder / "all_image"
    for place in (lidar, camera):
        place.mkdir()
    for number, time in enumerate(times):
        pcd.write_pcd(lidar / f"{time:.6f}.pcd", np.random.default_rng(number).normal(size=(20, 3)))
        images.write_image(camera / f"{time:.6f}.png", np.full((24, 32, 3), 9 * number, np.uint8))
    for name in ("all_pcd_body/lidar_poses.txt", "all_image/image_poses.txt"):
        tum.write_trajectory(folder / name, Trajectory(times, geometry.exp(steps)))
    (folder / "config.yaml").write_bytes(_ONE_FILE)
    return [_files_of(folder), _kitti()]


def _kitti() -> Files:
    png = cv2.imencode(".png", np.full((24, 32, 3), 9, np.uint8))[1].tobytes()
    points = np.random.default_rng(0).normal(size=(20, 4)).astype("<f4").tobytes()
    poses = "".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in (0, 0.5, 1.0)).encode()
    projection = "30 0 16 0 0 30 12 0 0 0 1 0"
    scans = {f"velodyne/{number:06d}.bin": points for number in range(3)}
    pictures = {f"image_2/{number:06d}.png": png for number in range(3)}
    calibration = f"P0: {projection}\nP2: {projection}\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n".encode()
    return {**scans, **pictures, "poses.txt": poses, "times.txt": b"0\n0.1\n0.2\n", "calib.txt": calibration}


def _files_of(folder: Path) -> Files:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _read_recording(folder: Path) -> None:
    found = open_dataset(folder)
    load_scans(found)
    for index in range(len(found.image_paths)):
        load_image(found, index)
    for trajectory in (found.scans, found.images):
        assert np.isfinite(trajectory.world_from_sensor).all()
        assert (np.diff(trajectory.times) > 0).all()


def _references(folder: Path) -> list[Files]:
    pose = b"1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0.5 0.5 0.5 0.5\n"
    return [
        {
            "lidar_poses.txt": pose,
            "image_poses.txt": pose,
            "exposures.csv": b"timestamp,relative_exposure\n1.5,1\n",
        }
    ]


# --- archives

_LIMITS = Limits(archive_entries=50, archive_bytes=30 << 20)


def _contents() -> dict[str, bytes]:
    return {
        "all_pcd_body/1.5.pcd": _odd_pcd(),
        "all_pcd_body/lidar_poses.txt": b"1.5 0 0 0 0 0 0 1\n",
        "config.yaml": _ONE_FILE,
    }


def _zips(folder: Path) -> list[Files]:
    found = []
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", method) as archive:
            archive.mkdir("all_pcd_body")
            for name, content in _contents().items():
                archive.writestr(name, content)
            archive.comment = b"hello"
        found.append(stream.getvalue())
    return _one("archive", found)


def _tars(folder: Path) -> list[Files]:
    found = []
    for form in (tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT):
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w", format=form) as archive:
            for name, content in {**_contents(), "a" * 90 + "/" + "b" * 90 + ".pcd": b"x"}.items():
                entry = tarfile.TarInfo(name)
                entry.size = len(content)
                entry.pax_headers = {"comment": "ü"} if form == tarfile.PAX_FORMAT else {}
                archive.addfile(entry, io.BytesIO(content))
        found.append(stream.getvalue())
    return _one("archive", found)


def _mend_zip(rng: random.Random, files: Files) -> Files:
    return {
        name: change.right_zip(content) if rng.random() < 0.5 else content for name, content in files.items()
    }


def _mend_tar(rng: random.Random, files: Files) -> Files:
    return {
        name: change.packed(rng, change.right_tar(content) if rng.random() < 0.7 else content)
        for name, content in files.items()
    }


def _unpack(folder: Path) -> None:
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    try:
        archives.unpack(folder / "archive", out, IntakeBudget(folder, _LIMITS))
    finally:
        assert sorted(os.listdir(folder)) == ["archive", "out"]
        inside = list(out.rglob("*"))
        assert not any(path.is_symlink() for path in inside)
        assert sum(path.stat().st_size for path in inside if path.is_file()) <= _LIMITS.archive_bytes + (
            1 << 20
        )


TARGETS: dict[str, Target] = {
    "pcd-ascii": Target(_scans("ascii"), _read_scan, tokens=fuzz_tokens.PCD),
    "pcd-binary": Target(_scans("binary"), _read_scan, tokens=fuzz_tokens.PCD),
    "pcd-compressed": Target(_scans("binary_compressed"), _read_scan, tokens=fuzz_tokens.PCD),
    "pcd-check": Target(_scans("binary"), _check_scan, tokens=fuzz_tokens.PCD),
    "ply": Target(_maps, _read_map, tokens=fuzz_tokens.PLY),
    "png": Target(_pngs, _read_image("a.png"), _mend_png, fuzz_tokens.PNG),
    "jpeg": Target(_jpegs, _read_image("a.jpg"), tokens=fuzz_tokens.JPEG),
    "poses": Target(_poses, _read_poses, tokens=fuzz_tokens.POSE),
    "imu": Target(_imu, _read_imu, tokens=fuzz_tokens.POSE),
    "exposures": Target(_exposures, _read_exposures, tokens=fuzz_tokens.POSE),
    "calibration": Target(_calibrations, _read_calibration, tokens=fuzz_tokens.YAML),
    "manifest": Target(_manifests, _read_manifest, tokens=fuzz_tokens.YAML),
    "settings": Target(_settings, _read_settings, tokens=fuzz_tokens.YAML),
    "recording": Target(
        _recordings, _read_recording, tokens=(*fuzz_tokens.POSE, *fuzz_tokens.PCD, *fuzz_tokens.YAML)
    ),
    "reference": Target(
        _references, lambda folder: reference.read_reference(folder), tokens=fuzz_tokens.POSE
    ),
    "bag-ros1": Target(
        fuzz_bags.seeds(BagForm.ROS1, BagForm.ROS1_LZ4, BagForm.ROS1_BZ2),
        fuzz_bags.read,
        tokens=fuzz_bags.TOKENS,
    ),
    "bag-mcap": Target(
        fuzz_bags.seeds(BagForm.MCAP, BagForm.MCAP_ZSTD), fuzz_bags.read, tokens=fuzz_bags.TOKENS
    ),
    "bag-sqlite": Target(fuzz_bags.seeds(BagForm.SQLITE3), fuzz_bags.read, tokens=fuzz_bags.TOKENS),
    "packets": Target(sources.packet_seeds, sources.read_packets, tokens=fuzz_tokens.YAML),
    "calibrations": Target(sources.calibration_seeds, sources.read_calibrations, tokens=fuzz_tokens.YAML),
    "folders": Target(
        sources.folder_seeds, sources.read_folder, tokens=(*fuzz_tokens.POSE, *fuzz_tokens.YAML)
    ),
    "zip": Target(_zips, _unpack, _mend_zip, fuzz_tokens.ZIP),
    "tar": Target(_tars, _unpack, _mend_tar, fuzz_tokens.TAR),
}
