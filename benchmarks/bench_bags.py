"""Speed of bags: what `lvba inspect` takes, a pass over raw messages, and a pass with everything decoded.

    python benchmarks/bench_bags.py [--gigabytes 1] [--folder DIR]

Each bag has scans of 24,000 points (Livox CustomMsg or PointCloud2) and images (JPEG of 0.4 MB) at 10 a second, poses at
10 and an IMU at 200. It is made here from random numbers, and removed; it is read from the memory of the system where it
fits. Figures are of one process with one thread.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lvba.sources.bags.bag_files import container_at
from lvba.sources.bags.container import Losses
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.source import (
    ImuSample,
    Kind,
    KnownGeometry,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    SourceDescription,
    Stream,
)

POINTS, JPEG_BYTES = 24_000, 400_000
PER_SECOND = 10 * (POINTS * 19 + JPEG_BYTES)
"""bytes, about."""
T0 = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Drive:
    """A source that continues for so many seconds."""

    seconds: int

    def describe(self) -> SourceDescription:
        """Its four streams."""
        names = ("/lidar", "/image", "/odometry", "/imu")
        return SourceDescription("", "", 0, tuple(Stream(name, Kind.OTHER, "", None) for name in names))

    def geometry(self) -> KnownGeometry:
        """Nothing."""
        return KnownGeometry()

    def losses(self) -> tuple[str, ...]:
        """None."""
        return ()

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """All, in time order."""
        rng = np.random.default_rng(0)
        points = rng.normal(0, 20, (POINTS, 3)).astype(np.float32)
        times = np.sort(rng.integers(0, 99_000_000, POINTS)).astype(np.uint32)
        brightness, rows = rng.integers(0, 255, POINTS).astype(np.float32), rng.integers(0, 6, POINTS)
        jpeg = b"\xff\xd8\xff\xe0" + rng.bytes(JPEG_BYTES)
        for step in range(200 * self.seconds):
            stamp = T0 + step * 5_000_000
            yield "/imu", ImuSample(stamp, "imu", np.ones(3), np.ones(3))
            if step % 20 == 0:
                scan = RawScan(
                    stamp=stamp,
                    frame="lidar",
                    points=points,
                    intensity=brightness,
                    times=times,
                    time_field="offset_time",
                    rows=rows,
                )
                yield "/lidar", scan
                yield "/image", RawImage(stamp, "camera", encoded=jpeg, suffix=".jpg")
                yield "/odometry", PoseSample(stamp, "map", "body", np.eye(4))


def timed(work: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of the clock and of the processor."""
    clock, used = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - clock, time.process_time() - used


def consume(items: Iterator[Any]) -> None:
    """Takes everything, keeps nothing."""
    for _ in items:
        pass


def main() -> None:
    """Prints a row for each container and layout."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gigabytes", type=float, default=1.0)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    seconds = max(1, round(arguments.gigabytes * 1e9 / PER_SECOND))
    print(
        f"{'bag':30}{'MB':>7}{'inspect s':>11}{'raw MB/s':>10}{'all MB/s':>10}{'scans MB/s':>12}{'scan ms':>9}"
    )
    for form, layout in (
        (BagForm.ROS1, PointLayout.LIVOX_CUSTOM_1),
        (BagForm.ROS1, PointLayout.OUSTER),
        (BagForm.ROS1_LZ4, PointLayout.LIVOX_CUSTOM_1),
        (BagForm.SQLITE3, PointLayout.LIVOX_CUSTOM_2),
        (BagForm.MCAP, PointLayout.LIVOX_CUSTOM_2),
        (BagForm.MCAP, PointLayout.LIVOX_CLOUD),
        (BagForm.MCAP_ZSTD, PointLayout.LIVOX_CUSTOM_2),
    ):
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            row(Path(folder) / "bag", form, layout, seconds)
    print(f"most memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def row(path: Path, form: BagForm, layout: PointLayout, seconds: int) -> None:
    """Writes a bag, reads it in each way, prints its figures."""
    write_bag(Drive(seconds), path, form, layout)
    size = sum(each.stat().st_size for each in ([path] if path.is_file() else path.iterdir())) / 1e6
    names = {stream.name for stream in Drive(seconds).describe().streams}
    looked, _ = timed(lambda: inspect(open_source(path)))
    container = container_at(path)
    assert container is not None
    _, raw = timed(lambda: consume(container.messages(names, Losses())))
    _, decoded = timed(lambda: consume(open_source(path).records(names)))
    _, scans = timed(lambda: consume(open_source(path).records({"/lidar"})))
    of_scans = seconds * 10 * POINTS * (19 if "custom" in layout else 26 if "livox" in layout else 48) / 1e6
    print(
        f"{form} {layout:20}"[:30].ljust(30)
        + f"{size:7.0f}{looked:11.2f}{size / raw:10.0f}{size / decoded:10.0f}{of_scans / scans:12.0f}"
        + f"{scans / seconds * 100:9.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
