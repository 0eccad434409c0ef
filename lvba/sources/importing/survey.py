"""One pass over a source that keeps what conventions are found from: small streams, and samples of scans and images."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from lvba.arrays import CloudPoints, Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_config
from lvba.io.image_header import ImageSize
from lvba.progress import Progress
from lvba.sources import camera_topics
from lvba.sources.camera_topics import CameraTopic
from lvba.sources.importing import image_bits, stamp_order, track
from lvba.sources.importing.streams import Streams
from lvba.sources.importing.track import Track
from lvba.sources.repeated_transforms import Pair, Repeated
from lvba.sources.source import (
    CameraInfo,
    ImuSample,
    PathSample,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    TransformSample,
)

_SEGMENT_S = 2.0
"""Samples are taken at the start of such pieces of time; twice as long ones as often as there are too many."""
_MOST_SEGMENTS = 48
_SCANS_AT = (0.0, 0.1, 0.3, 0.6, 1.0, 1.5)
_IMAGES_AT = (0.0, 0.4, 0.8, 1.2)
"""s after the start of a segment."""
_POINTS = 6000
_LEAST_RANGE_M = 0.3
_IMAGE_WIDTH = 640
_SAID_FOR = 50
"""Percent of the time of the scans for which a transform is repeated that holds for all of it."""


@dataclass(frozen=True)
class ScanSample:
    """Some points of a scan. stamp: ns; points: (N, 3) float32, m; times: (N,) as the driver has them, or None."""

    stamp: int
    points: np.ndarray
    times: np.ndarray | None


@dataclass(frozen=True)
class ImageSample:
    """An image in gray, shrunk. stamp: ns; gray: (H, W) uint8; factor: its width by that of the image.

    deep: (H, W) uint16, of an image of 16 bits, until it is known how many of them are used
    """

    stamp: int
    gray: np.ndarray
    factor: float
    deep: np.ndarray | None = None


@dataclass
class Segment:
    """Samples of a piece of time."""

    scans: list[ScanSample] = field(default_factory=list)
    images: list[ImageSample] = field(default_factory=list)


@dataclass(frozen=True)
class ImuReadings:
    """times: (N,) float64, s since the survey's zero, ascending; rates: (N, 3), rad/s, axes of the IMU.

    forces: (N, 3), of the accelerometer, as the driver has them, axes of the IMU
    """

    times: np.ndarray
    rates: np.ndarray
    forces: np.ndarray


@dataclass(frozen=True)
class Survey:
    """What a pass over a source found.

    zero: int64 ns, which times in s count from
    scan_stamps, image_stamps: (S,), (I,) int64 ns, ascending, of those in order
    scans_in_order, images_in_order: bool, of each scan and image in the order of recording, whether its stamp is
    odometry: as its source has it, None where it comes from a file; child: what it says it is of
    static: (parent, child) -> (4, 4), parent from child; repeated: the same of transforms that nothing says to be static,
        and that never change
    camera: the camera info of its images; None: none goes with them
    other_cameras: topics of camera infos that do not
    image_bits: how many of 16 bits images use, 16 also where they have 8
    image_size: of the files, px, zeros without images; lidar_frame, image_frame, imu_frame: as drivers name them
    """

    zero: int
    scan_stamps: np.ndarray
    image_stamps: np.ndarray
    scans_in_order: np.ndarray
    images_in_order: np.ndarray
    segments: tuple[Segment, ...]
    odometry: Track | None
    child: str
    imu: ImuReadings | None
    camera: CameraTopic | None
    other_cameras: tuple[str, ...]
    image_size: tuple[int, int]
    image_bits: int
    static: dict[Pair, np.ndarray]
    repeated: dict[Pair, np.ndarray]
    lidar_frame: str
    image_frame: str
    imu_frame: str

    def seconds(self, stamps: np.ndarray) -> np.ndarray:
        """(N,) float64, s since `zero`. stamps: (N,) int64, ns"""
        return np.asarray((stamps - self.zero) * 1e-9)


class _Collector:
    """Takes records one after another."""

    def __init__(self, streams: Streams) -> None:
        self.streams = streams
        self.scan_stamps: list[int] = []
        self.image_stamps: list[int] = []
        self.segments: dict[int, Segment] = {}
        self.poses: dict[Pair, list[tuple[int, np.ndarray]]] = {}
        self.path: PathSample | None = None
        self.readings: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.cameras: dict[tuple[str, str], CameraTopic] = {}
        self.image_frame = ""
        self.image_size = (0, 0)
        self.largest_value = 0
        self.static: dict[Pair, np.ndarray] = {}
        self.repeated = Repeated()
        self.lidar_frame = self.imu_frame = ""
        self._zero: int | None = None
        self._length = _SEGMENT_S

    def add(self, stream: str, record: Record) -> None:
        """One record of a stream of that name."""
        if isinstance(record, RawScan):
            self._scan(record)
        elif isinstance(record, RawImage):
            self._image(record)
        elif isinstance(record, PoseSample) and stream == self.streams.odometry:
            self._pose(record)
        elif isinstance(record, PathSample) and stream == self.streams.odometry:
            if self.path is None or len(record.times) >= len(self.path.times):
                self.path = record
        elif isinstance(record, ImuSample):
            self.readings.append((record.stamp, record.gyroscope, record.accelerometer))
            self.imu_frame = record.frame
        elif isinstance(record, CameraInfo) and record.camera is not None:
            info = CameraTopic(stream, record.frame, record.camera, record.other, record.rectified)
            self.cameras[stream, record.frame] = info
        elif isinstance(record, TransformSample):
            self._transform(stream, record)

    def _scan(self, scan: RawScan) -> None:
        rng = np.random.default_rng(len(self.scan_stamps))
        self.scan_stamps.append(scan.stamp)
        self.lidar_frame = scan.frame
        segment = self._segment(scan.stamp, _SCANS_AT, "scans")
        if segment is None:
            return
        good = np.flatnonzero(is_return(scan.points))
        if len(good) > _POINTS:
            good = np.sort(rng.choice(good, _POINTS, replace=False))
        times = None if scan.times is None else scan.times[good]
        segment.scans.append(ScanSample(scan.stamp, scan.points[good], times))

    def _image(self, image: RawImage) -> None:
        self.image_stamps.append(image.stamp)
        self.image_frame = image.frame
        values = image_bits.values(image)
        if values is not None:
            self.largest_value = max(self.largest_value, int(values.max(initial=0)))
        segment = self._segment(image.stamp, _IMAGES_AT, "images")
        if segment is None:
            return
        gray = gray_of(image)
        if gray is None:
            return
        self.image_size = (gray.shape[1], gray.shape[0])
        factor = min(1.0, _IMAGE_WIDTH / gray.shape[1])
        deep = None if values is None else _shrunk(_gray(values), factor)
        segment.images.append(ImageSample(image.stamp, _shrunk(gray, factor), factor, deep))

    def _segment(self, stamp: int, at: tuple[float, ...], kind: str) -> Segment | None:
        """The segment that a record of this stamp is a sample of, or None."""
        if self._zero is None:
            self._zero = stamp
        elapsed = (stamp - self._zero) * 1e-9
        number = int(np.floor(elapsed / self._length))
        inside = elapsed - number * self._length
        segment = self.segments.get(number)
        taken = 0 if segment is None else len(getattr(segment, kind))
        if taken >= len(at) or inside < at[taken]:
            return None
        if segment is None:
            segment = self.segments[number] = Segment()
            self._thin()
        return segment

    def _thin(self) -> None:
        """Every second segment goes where there are too many, and those to come are twice as long."""
        if len(self.segments) <= _MOST_SEGMENTS:
            return
        self._length *= 2
        self.segments = {number // 2: segment for number, segment in self.segments.items() if number % 2 == 0}

    def _transform(self, stream: str, sample: TransformSample) -> None:
        if sample.static:
            self.static[sample.parent, sample.child] = sample.parent_from_child
            return
        self.repeated.add(sample)
        if stream == self.streams.odometry:
            self._pose(sample)

    def _pose(self, sample: PoseSample | TransformSample) -> None:
        pose = (sample.stamp, sample.parent_from_child)
        self.poses.setdefault((sample.parent, sample.child), []).append(pose)


def is_return(points: CloudPoints) -> np.ndarray:
    """(N,) bool: points that something other than the rig sent back. points: (N, 3) float32, m, LiDAR frame"""
    away = np.abs(points).max(axis=1, initial=0.0) > _LEAST_RANGE_M
    return np.asarray(np.isfinite(points).all(axis=1) & away)


def gray_of(image: RawImage) -> np.ndarray | None:
    """(H, W) uint8 of an image as it is stored, not turned by EXIF; None where it cannot be decoded."""
    if image.encoded is not None:
        as_stored = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        return cv2.imdecode(np.frombuffer(image.encoded, np.uint8), as_stored)
    pixels = image.pixels
    if pixels is None:
        return None
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return _gray(pixels)


def _gray(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))


def _shrunk(gray: np.ndarray, factor: float) -> np.ndarray:
    if factor == 1:
        return gray
    size = (round(gray.shape[1] * factor), round(gray.shape[0] * factor))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def survey(
    records: Iterable[tuple[str, Record]], streams: Streams, expected: int, progress: Progress
) -> Survey:
    """What the records of `streams.surveyed` say. expected: how many there are, 0: unknown

    Raises InputError: they hold no scan, or poses of several frames.
    """
    collector = _Collector(streams)
    for done, (stream, record) in enumerate(records, 1):
        collector.add(stream, record)
        progress("records", done, expected)
    if not collector.scan_stamps:
        raise InputError(streams.lidar, "has no scan that can be read", "choose another stream by --lidar")
    return _finished(collector)


def _finished(collector: _Collector) -> Survey:
    (stamps, scans_in_order), (image_stamps, images_in_order) = (
        _in_order(each) for each in (collector.scan_stamps, collector.image_stamps)
    )
    zero = int(stamps[0])
    repeated = collector.repeated.still(int(stamps[-1] - zero) * _SAID_FOR // 100)
    pair = _moving(collector, repeated)
    camera, others = _camera(collector)
    bits = image_bits.used(collector.largest_value)
    imu = None
    if collector.readings:
        times = (np.array([time for time, _, _ in collector.readings], np.int64) - zero) * 1e-9
        order = np.argsort(times, kind="stable")
        rates, forces = (np.array([each[k] for each in collector.readings])[order] for k in (1, 2))
        imu = ImuReadings(times[order], rates, forces)
    return Survey(
        zero=zero,
        scan_stamps=stamps,
        image_stamps=image_stamps,
        scans_in_order=scans_in_order,
        images_in_order=images_in_order,
        segments=tuple(
            _kept(collector.segments[number], stamps, image_stamps, bits)
            for number in sorted(collector.segments)
        ),
        odometry=_odometry(collector.path, collector.poses.get(pair, []), zero),
        child=pair[1],
        imu=imu,
        camera=camera,
        other_cameras=others,
        image_size=collector.image_size,
        image_bits=bits,
        static=collector.static,
        repeated=repeated,
        lidar_frame=collector.lidar_frame,
        image_frame=collector.image_frame,
        imu_frame=collector.imu_frame,
    )


def _in_order(stamps: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Those of stamps (ns) that are in order, (K,) int64, ascending; and of each, (N,) bool, whether it is."""
    every = np.array(stamps, np.int64)
    kept = stamp_order.in_order(every)
    return every[kept], kept


def _kept(segment: Segment, scans: np.ndarray, images: np.ndarray, bits: int) -> Segment:
    """The samples of a segment with stamps (ns) that are among those of scans (S,) and images (I,).

    bits: that images of 16 bits use
    """
    return Segment(
        [each for each in segment.scans if np.isin(each.stamp, scans)],
        [_leveled(each, bits) for each in segment.images if np.isin(each.stamp, images)],
    )


def _leveled(sample: ImageSample, bits: int) -> ImageSample:
    """The sample by the bits that images of 16 use."""
    if sample.deep is None:
        return sample
    gray = sample.gray if bits == image_bits.ALL else (sample.deep >> (bits - 8)).astype(np.uint8)
    return replace(sample, gray=gray, deep=None)


def _camera(collector: _Collector) -> tuple[CameraTopic | None, tuple[str, ...]]:
    """The camera info of the images, None: none goes with them; and the topics of others."""
    topics = list(collector.cameras.values())
    size = ImageSize(*collector.image_size)

    def fits(camera: Camera) -> bool:
        return not size.width or not camera.width or camera_config.factor(camera, size) is not None

    chosen = camera_topics.of_images(topics, collector.streams.image, collector.image_frame, fits)
    used = chosen.name if chosen is not None else ""
    return chosen, tuple(sorted({each.name for each in topics if each.name != used}))


def _moving(collector: _Collector, repeated: Mapping[Pair, Pose]) -> Pair:
    """The frames that the odometry has poses of, those that never change beside others left out; "" without poses.

    Raises InputError: there are several.
    """
    pairs = [pair for pair in collector.poses if pair not in repeated] or list(collector.poses)
    if len(pairs) > 1:
        names = ", ".join(f"{parent} from {child}" for parent, child in pairs)
        raise InputError(
            collector.streams.odometry,
            f"has transforms of several frames: {names}",
            "write those of one of them to a TUM file, and give it as --odometry FILE",
        )
    return pairs[0] if pairs else ("", "")


def _odometry(path: PathSample | None, samples: list[tuple[int, np.ndarray]], zero: int) -> Track | None:
    if path is not None:
        times = np.asarray((path.times - zero) * 1e-9, np.float64)
        return track.made(times, path.parent_from_child)
    if not samples:
        return None
    times = np.asarray((np.array([time for time, _ in samples], np.int64) - zero) * 1e-9, np.float64)
    return track.made(times, np.array([pose for _, pose in samples]))
