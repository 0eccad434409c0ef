"""What an import costs: a bag of a walk through a room, with scans of 24,000 points and JPEGs of 1.3 megapixels.

    python benchmarks/bench_import.py [--scans 600] [--folder DIR]

Scans, images and poses (5 mm and 0.05 degrees off) come 10 times a second, readings of an IMU 200 times. The bag is
made here and removed, like what is made of it. Each command runs in a process of its own: seconds of the clock and of
the processor, and the most memory that it held.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.source import (
    CameraInfo,
    ImuSample,
    Kind,
    KnownGeometry,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    SourceDescription,
    Stream,
    TransformSample,
)

POINTS, ROUND = 24_000, 100
"""Points of a scan; scans after which the walk begins anew."""
T0 = 1_700_000_000_000_000_000
HALF_ROOM = np.array([5.0, 4.0, 1.5])
CAMERA = Camera(width=1280, height=1024, fx=900.0, fy=900.0, cx=639.5, cy=511.5)
LIDAR_FROM_CAMERA = np.array([[0, 0, 1, 0.05], [-1, 0, 0, 0.02], [0, -1, 0, 0.03], [0, 0, 0, 1.0]])


def world_from_lidar(times: np.ndarray) -> np.ndarray:
    """(N, 4, 4), m, at times (N,) s."""
    phase = 2 * np.pi * times / (0.1 * ROUND)
    turn = np.stack([0.05 * np.sin(3 * phase), 0.05 * np.cos(2 * phase), 0.8 * np.sin(phase)], axis=1)
    move = np.stack([2 * np.cos(phase), 1.5 * np.sin(phase), 0.1 * np.sin(4 * phase)], axis=1)
    return geometry.exp(np.concatenate([turn, np.zeros_like(turn)], axis=1)) + _only(move)


def _only(move: np.ndarray) -> np.ndarray:
    """What is added to rotations (N, 4, 4) to move them."""
    added = np.zeros((len(move), 4, 4))
    added[:, :3, 3] = move
    return added


def hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) m to the wall of the room from origins (N, 3) along directions (N, 3)."""
    with np.errstate(divide="ignore"):
        away = (np.sign(directions) * HALF_ROOM - origins) / directions
    return np.asarray(np.nanmin(np.where(np.isfinite(away), away, np.nan), axis=1))


@cache
def scan(number: int) -> RawScan:
    """One of the round; its points are where they were seen from, each at its own time."""
    rng = np.random.default_rng(number)
    after = np.sort(rng.integers(0, 99_900_000, POINTS)).astype(np.uint32)
    poses = world_from_lidar(0.1 * number + after * 1e-9)
    angles = rng.uniform([-0.61, -0.61], [0.61, 0.61], (POINTS, 2))
    rays = np.stack([np.ones(POINTS), np.tan(angles[:, 0]), np.tan(angles[:, 1])], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges = hit(poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], rays)) + rng.normal(
        0, 0.01, POINTS
    )
    brightness, rows = rng.integers(0, 255, POINTS).astype(np.float32), np.arange(POINTS) % 6
    points = (ranges[:, None] * rays).astype(np.float32)
    return RawScan(0, "lidar", points, brightness, after, "offset_time", rows)


@cache
def jpeg(number: int) -> bytes:
    """The image of the round at the begin of a scan: walls with a pattern of many sizes."""
    pose = world_from_lidar(np.array([0.1 * number]))[0] @ LIDAR_FROM_CAMERA
    half = CAMERA.at_level(1)
    right, down = np.meshgrid(np.arange(half.width), np.arange(half.height))
    across, low = half.normalized(np.stack([right.ravel(), down.ravel()], axis=1))
    rays = np.stack([across, low, np.ones(len(low))], axis=1) @ pose[:3, :3].T
    places = pose[:3, 3] + hit(np.broadcast_to(pose[:3, 3], rays.shape), rays)[:, None] * rays
    rng = np.random.default_rng(7)
    shade = np.zeros(len(places), np.float32)
    for size in (1.5, 0.7, 0.3, 0.15, 0.07):
        wave = rng.normal(0, 2 * np.pi / size, (3, 2))
        shade += size**0.5 * np.sin(places @ wave[:, 0] + np.sin(places @ wave[:, 1]))
    smooth = cv2.resize(shade.reshape(half.height, half.width), (CAMERA.width, CAMERA.height))
    noise = np.random.default_rng(number).normal(0, 3, smooth.shape)
    image = np.clip(128 + 60 * smooth + noise, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", cv2.merge([image, image, image]), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


@dataclass(frozen=True)
class Walk:
    """A source of so many scans."""

    scans: int

    def describe(self) -> SourceDescription:
        """Its streams."""
        names = ("/lidar", "/image", "/camera_info", "/odometry", "/imu", "/tf_static")
        return SourceDescription("", "", 0, tuple(Stream(name, Kind.OTHER, "", None) for name in names))

    def geometry(self) -> KnownGeometry:
        """Nothing: it is in the streams."""
        return KnownGeometry()

    def losses(self) -> tuple[str, ...]:
        """None."""
        return ()

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """All, in time order."""
        rng = np.random.default_rng(0)
        yield "/tf_static", TransformSample(T0, "lidar", "camera", LIDAR_FROM_CAMERA, True)
        yield "/tf_static", TransformSample(T0, "lidar", "imu", np.eye(4), True)
        for step in range(20 * self.scans):
            stamp, seconds = T0 + step * 5_000_000, 5e-3 * step
            around = world_from_lidar(seconds + np.array([0.0, 1e-4]))
            rate = geometry.log(geometry.inverse(around[0]) @ around[1])[:3] / 1e-4
            yield "/imu", ImuSample(stamp, "imu", rate + rng.normal(0, 2e-3, 3), np.array([0, 0, 9.81]))
            if step % 20 == 0:
                number = step // 20
                seen = scan(number % ROUND)
                yield "/camera_info", CameraInfo(stamp, "camera", CAMERA)
                yield "/image", RawImage(stamp, "camera", encoded=jpeg(number % ROUND), suffix=".jpg")
                yield "/lidar", RawScan(stamp, **{k: v for k, v in vars(seen).items() if k != "stamp"})
                noise = geometry.exp(np.concatenate([rng.normal(0, 9e-4, 3), rng.normal(0, 5e-3, 3)])[None])[
                    0
                ]
                yield "/odometry", PoseSample(stamp, "map", "lidar", around[0] @ noise)


def command(*arguments: str) -> str:
    """Runs `lvba` so; what it cost, for people."""
    clock = time.perf_counter()
    child = os.posix_spawn(sys.executable, [sys.executable, "-m", "service.cli", *arguments], os.environ)
    _, status, usage = os.wait4(child, 0)
    clock = time.perf_counter() - clock
    if status:
        raise SystemExit(f"lvba {' '.join(arguments)} failed")
    used = usage.ru_utime + usage.ru_stime
    return (
        f"{clock:8.1f} s, {used:8.1f} s of the processor ({usage.ru_stime:.1f} s of the system), "
        f"at most {usage.ru_maxrss / 1024:.0f} MB"
    )


def main() -> None:
    """Prints a line for each command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=600)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--write", type=Path, help="only write the bag, to this path")
    arguments = parser.parse_args()
    if arguments.write:
        write_bag(Walk(arguments.scans), arguments.write, BagForm.ROS1, PointLayout.LIVOX_CUSTOM_2)
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        bag, out = Path(folder) / "walk.bag", Path(folder) / "recording"
        # in a process of its own: what this one holds counts as held by those that it starts
        writing = [sys.executable, __file__, "--scans", str(arguments.scans), "--write", str(bag)]
        subprocess.run(writing, check=True)
        print(f"{bag.stat().st_size / 1e6:.0f} MB, {arguments.scans} scans and images", flush=True)
        print("inspect", command("inspect", str(bag)), flush=True)
        print("import ", command("import", str(bag), "--out", str(out)), flush=True)


if __name__ == "__main__":
    main()
