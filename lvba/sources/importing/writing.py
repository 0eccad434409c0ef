"""The second pass over a source: deskewed scans, images and small streams as files, two at a time."""

from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from lvba import geometry
from lvba.io import files, imu, pcd, stream
from lvba.progress import Progress
from lvba.sources import placing
from lvba.sources.importing import folder, image_bits
from lvba.sources.importing.conventions import Conventions
from lvba.sources.importing.imu_clock import ImuRead
from lvba.sources.importing.options import ImportOptions
from lvba.sources.importing.selection import Selection
from lvba.sources.importing.survey import Survey
from lvba.sources.source import GnssFix, ImuSample, RawImage, RawScan, Record

_THREADS = 2
_WAITING = 8
_NODE_S = 1e-3
GNSS_HEADER = "timestamp,latitude,longitude,altitude,status,covariance_east,covariance_north,covariance_up\n"


@dataclass
class Written:
    """What was written: stamps (ns) in order, on the clock of the points; and what was left out, by reason.

    outside: least and greatest time (s) by which what was left out lies outside of the poses, by reason
    """

    scans: list[int] = field(default_factory=list)
    images: list[int] = field(default_factory=list)
    losses: dict[str, int] = field(default_factory=dict)
    outside: dict[str, tuple[float, float]] = field(default_factory=dict)

    def lose(self, reason: str, count: int = 1) -> None:
        """Counts what is left out."""
        if count:
            self.losses[reason] = self.losses.get(reason, 0) + count

    def lose_unposed(self, what: str, outside: float) -> None:
        """Counts what has no poses around it. outside: s, `Track.outside`; 0: it lies in a gap"""
        reason = f"{what} outside of the poses" if outside else f"{what} in gaps of the poses"
        self.lose(reason)
        if outside:
            least, most = self.outside.get(reason, (outside, outside))
            self.outside[reason] = (min(least, outside), max(most, outside))

    def sentences(self) -> list[str]:
        """What was left out, one sentence each."""
        lines = []
        for reason, count in sorted(self.losses.items()):
            least, most = (f"{value:.3g}" for value in self.outside.get(reason, (0.0, 0.0)))
            far = least if least == most else f"{least} to {most}"
            lines.append(f"{count} {reason} left out" + (f", by {far} s" if reason in self.outside else ""))
        return lines


def stamp_text(stamp: int) -> str:
    """A stamp, ns, as seconds with all digits."""
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


class Writer:
    """Takes the records of the second pass. Files that are there are those of a stopped import, and stay."""

    def __init__(self, out: Path, survey: Survey, conventions: Conventions, options: ImportOptions) -> None:
        self.out, self.survey, self.conventions = out, survey, conventions
        self.written = Written()
        self._scans = Selection.of(options, survey.zero, options.every, survey.scans_in_order)
        self._images = Selection.of(options, survey.zero, 1, survey.images_in_order)
        self._rest = Selection.of(options, survey.zero, 1)
        self._waiting: deque[Future[None]] = deque()
        self._with_images = conventions.images is not None

    def write(self, records: Iterable[tuple[str, Record]], expected: int, progress: Progress) -> Written:
        """All records of `Streams.written`. expected: how many scans and images there are, 0: unknown

        Raises InputError: a file cannot be written.
        """
        done = 0
        with ExitStack() as stack:
            small: dict[type, BinaryIO] = {}
            pool = stack.enter_context(ThreadPoolExecutor(_THREADS))
            stack.callback(self._drop)
            for _, record in records:
                if isinstance(record, RawScan):
                    self._scan(record, pool)
                elif isinstance(record, RawImage):
                    self._image(record, pool)
                elif isinstance(record, ImuSample | GnssFix):
                    self._line(record, small, stack)
                if isinstance(record, RawScan | RawImage):
                    done += 1
                    progress("scans and images", done, expected)
            while self._waiting:
                self._waiting.popleft().result()
        for what, selection in (("scans", self._scans), ("images", self._images)):
            self.written.lose(f"{what} whose stamps are out of order", selection.unordered)
        return self.written

    def _drop(self) -> None:
        """What has not begun need not: somebody stopped, or a file could not be written."""
        for future in self._waiting:
            future.cancel()

    def _submit(self, pool: ThreadPoolExecutor, job: "partial[None]") -> None:
        self._waiting.append(pool.submit(job))
        while len(self._waiting) > _WAITING:
            self._waiting.popleft().result()

    def _scan(self, scan: RawScan, pool: ThreadPoolExecutor) -> None:
        if not self._scans.wants(scan.stamp):
            return
        after = self.conventions.clock.of_times(scan.times, scan.stamp, len(scan.points))
        seen = np.isfinite(scan.points).all(axis=1) & scan.points.any(axis=1)
        timed = np.isfinite(after)
        self.written.lose("points without a position", int(np.count_nonzero(~seen)))
        self.written.lose("points whose time is not of their sweep", int(np.count_nonzero(seen & ~timed)))
        kept = np.flatnonzero(seen & timed)
        if not len(kept):
            self.written.lose("scans without a point")
            return
        stamp = self._seconds(scan.stamp)
        raw = after[kept] if self.conventions.deskews else np.zeros(1)
        first, last = stamp + min(raw.min(), 0.0), stamp + max(raw.max(), 0.0)
        if not self.conventions.lidar.covers(first, last):
            self.written.lose_unposed("scans", self.conventions.lidar.outside(first, last))
            return
        self.written.scans.append(scan.stamp)
        path = self.out / folder.SCANS / f"{stamp_text(scan.stamp)}.pcd"
        if not path.exists():
            self._submit(pool, partial(self._write_scan, path, scan, kept, after[kept]))

    def _write_scan(self, path: Path, scan: RawScan, kept: np.ndarray, after: np.ndarray) -> None:
        conventions, stamp = self.conventions, self._seconds(scan.stamp)
        points = scan.points[kept].astype(float)
        if conventions.deskews:
            at_nodes = placing.nodes(stamp + after.min(), stamp + after.max(), _NODE_S)
            at_stamp = geometry.inverse(conventions.lidar.at(np.array([stamp])))
            points = placing.place(points, at_nodes, at_stamp @ conventions.lidar.at(at_nodes), stamp + after)
        points = geometry.transform_points(conventions.body_from_lidar, points)
        intensity = None if scan.intensity is None else scan.intensity[kept]
        time = scan.stamp * 1e-9 + after if conventions.clock.unit else None
        pcd.write_pcd(path, points, intensity, time)

    def _image(self, image: RawImage, pool: ThreadPoolExecutor) -> None:
        if not self._with_images or not self._images.wants(image.stamp):
            return
        stamp = image.stamp + round(self.conventions.image_offset * 1e9)
        seconds = self._seconds(stamp)
        if not self.conventions.lidar.covers(seconds, seconds):
            self.written.lose_unposed("images", self.conventions.lidar.outside(seconds, seconds))
            return
        self.written.images.append(stamp)
        suffix = ".png" if image.encoded is None else image.suffix
        path = self.out / folder.IMAGES / f"{stamp_text(stamp)}{suffix}"
        if not path.exists():
            self._submit(pool, partial(_write_image, path, image, self.survey.image_bits))

    def _line(self, record: ImuSample | GnssFix, small: dict[type, BinaryIO], stack: ExitStack) -> None:
        kind = type(record)
        if not self._rest.inside(record.stamp) or (kind is ImuSample and self.conventions.imu.left_out):
            return
        if kind not in small:
            name, header = (imu.NAME, imu.HEADER) if kind is ImuSample else ("gnss.csv", GNSS_HEADER)
            small[kind] = stack.enter_context(stream.writer(self.out / name))
            small[kind].write(header.encode())
        stamp = record.stamp
        if isinstance(record, ImuSample):
            stamp, values = (
                stamp + round(self.conventions.imu.offset * 1e9),
                _imu_values(record, self.conventions.imu),
            )
        else:
            values = _gnss_values(record)
        small[kind].write(f"{stamp_text(stamp)},{','.join(values)}\n".encode())

    def _seconds(self, stamp: int) -> float:
        return float((stamp - self.survey.zero) * 1e-9)


def _write_image(path: Path, image: RawImage, bits: int) -> None:
    image = image_bits.widened(image, bits)
    if image.encoded is not None:
        files.write_bytes(path, image.encoded)
        return
    pixels = image.pixels
    assert pixels is not None
    bgr = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
    _, encoded = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    files.write_bytes(path, encoded.tobytes())


def _imu_values(sample: ImuSample, read: ImuRead) -> list[str]:
    values = (*(read.rates * sample.gyroscope), *(read.forces * sample.accelerometer))
    return [f"{value:.9g}" for value in values]


def _gnss_values(fix: GnssFix) -> list[str]:
    variances = ["", "", ""] if fix.covariance is None else [f"{fix.covariance[k, k]:.9g}" for k in range(3)]
    return [
        f"{fix.latitude:.10f}",
        f"{fix.longitude:.10f}",
        f"{fix.altitude:.4f}",
        str(fix.status),
        *variances,
    ]
