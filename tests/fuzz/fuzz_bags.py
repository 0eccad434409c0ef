"""Bags to start from, and what must hold of what is read from a bag of strangers."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from fuzz_mutations import Files

from lvba.camera import Camera
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.source import (
    CameraInfo,
    GnssFix,
    ImuSample,
    Kind,
    ListSource,
    PathSample,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    SourceDescription,
    Stream,
    TransformSample,
)

TOKENS = (
    *(
        b"op=\2",
        b"op=\3",
        b"op=\4",
        b"op=\5",
        b"op=\6",
        b"op=\7",
        b"conn=",
        b"size=",
        b"count=",
        b"chunk_pos=",
    ),
    *(b"compression=bz2", b"compression=lz4", b"compression=none", b"index_pos=", b"MSG: std_msgs/Header\n"),
    *(b"float64[] ", b"string[] ", b"time[] ", b"Header[] a\n", b"[4294967295] ", b"uint8[999999999] a\n"),
    *(b"=" * 80 + b"\n", b"\0\1\0\0", b"\xff" * 8, b"ros2idl", b"zstd", b"lz4", b"CREATE TABLE messages"),
)
_T0 = 1_700_000_000_000_000_000


def _items() -> list[tuple[str, Record]]:
    rng = np.random.default_rng(0)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    pose, camera = np.eye(4), Camera(width=8, height=8, fx=9.0, fy=9.0, cx=4.0, cy=4.0)
    times = np.arange(20) * 5_000_000
    return [
        item
        for i in range(2)
        for stamp in [_T0 + i * 100_000_000]
        for item in (
            (
                "/scan",
                RawScan(stamp, "lidar", rng.normal(size=(20, 3)).astype(np.float32), np.ones(20), times, "t"),
            ),
            ("/image", RawImage(stamp, "camera", pixels=rng.integers(0, 255, (8, 8, 3)).astype(np.uint8))),
            ("/jpeg", RawImage(stamp, "camera", encoded=jpeg, suffix=".jpg")),
            ("/odometry", PoseSample(stamp, "map", "body", pose)),
            ("/path", PathSample(stamp, "map", np.array([stamp] * 3), np.stack([pose] * 3))),
            ("/imu", ImuSample(stamp, "imu", np.ones(3), np.ones(3))),
            (
                "/fix",
                GnssFix(
                    stamp=stamp, frame="", latitude=1, longitude=2, altitude=3, covariance=None, status=0
                ),
            ),
            ("/camera_info", CameraInfo(stamp, "camera", camera)),
            ("/tf_static", TransformSample(stamp, "lidar", "camera", pose, static=True)),
        )
    ]


def seeds(*forms: BagForm) -> Callable[[Path], list[Files]]:
    """Makes bags of these containers, with scans in two layouts."""

    def make(folder: Path) -> list[Files]:
        items = _items()
        streams = tuple(
            Stream(name, Kind.OTHER, "", None) for name in dict.fromkeys(name for name, _ in items)
        )
        source = ListSource(SourceDescription("", "", 0, streams), tuple(items))
        found = []
        for form in forms:
            for layout in (PointLayout.LIVOX_CUSTOM_2, PointLayout.VELODYNE):
                path = folder / f"{form}-{layout}"
                write_bag(source, path, form, layout)
                files = [path] if path.is_file() else [each for each in path.iterdir() if each.is_file()]
                names = {each: "a.bag" if path.is_file() else each.name for each in files}
                found.append({f"bag/{name}": each.read_bytes() for each, name in names.items()})
        return found

    return make


def read(folder: Path) -> None:
    """All that a bag has, by its topics' kinds."""
    source = open_source(folder / "bag")
    inspection = inspect(source)
    description = inspection.description
    json.dumps([each.facts for each in inspection.streams], allow_nan=False)
    for text in (*description.notes, *(stream.name for stream in description.streams)):
        assert isinstance(text, str)
    wanted = {
        stream.name
        for stream in description.streams
        if stream.kind not in (Kind.OTHER, Kind.PACKETS) and stream.count != 0
    }
    for _, record in source.records(wanted):
        _check(record)
    assert all(isinstance(loss, str) for loss in source.losses())


def _check(record: Record) -> None:
    assert isinstance(record.stamp, int)
    if isinstance(record, RawScan):
        assert record.points.dtype == np.float32
        assert record.points.shape == (len(record.points), 3)
        for column in (record.intensity, record.times, record.rows):
            assert column is None or column.shape == (len(record.points),)
    elif isinstance(record, RawImage) and record.pixels is not None:
        assert record.pixels.dtype in (np.uint8, np.uint16)
        assert record.pixels.ndim == 2 or record.pixels.shape[2] == 3
    elif isinstance(record, PoseSample | PathSample | TransformSample):
        assert np.isfinite(record.parent_from_child).all()
