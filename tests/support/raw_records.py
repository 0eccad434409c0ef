"""Records of all types that a source may have, and a source of them."""

from dataclasses import replace

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.lens import Lens
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
    SourceDescription,
    Stream,
    TransformSample,
)

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
RNG = np.random.default_rng(1)
POINTS = 2000
SCANS = [
    RawScan(
        stamp=T0 + i * SECOND // 10,
        frame="lidar",
        points=RNG.normal(0, 20, (POINTS, 3)).astype(np.float32),
        intensity=RNG.integers(0, 256, POINTS).astype(np.float32),
        times=np.sort(RNG.integers(0, 99_000_000, POINTS)).astype(np.uint32),
        time_field="offset_time",
        rows=RNG.integers(0, 6, POINTS),
    )
    for i in range(3)
]


def pose(i):
    return geometry.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, i]))


def everything():
    """A record or two of each type in topics of their own."""
    stamps = [T0 + i * SECOND // 10 for i in range(3)]
    camera = Camera(
        width=40, height=30, fx=20.5, fy=20.25, cx=19.5, cy=14.75, distortion=(0.1, -0.2, 0.01, 0.02, 0.03)
    )
    pinhole = replace(camera, distortion=(0.0,) * 4)
    fisheye = replace(camera, distortion=(0.1, 0.2, 0.3, 0.4), lens=Lens.EQUIDISTANT)
    rational = replace(camera, distortion=(0.1, -0.2, 0.01, 0.02, 0.03, 0.4, 0.5, 0.6))
    fix = GnssFix(
        stamp=0,
        frame="gps",
        latitude=1.5,
        longitude=2.5,
        altitude=3.5,
        covariance=np.diag([1.0, 2.0, 3.0]),
        status=2,
    )
    made = [("/livox", scan) for scan in SCANS]
    for i, stamp in enumerate(stamps):
        path = PathSample(stamp, "map", np.array(stamps[: i + 1]), np.array([pose(j) for j in range(i + 1)]))
        made += [
            ("/odometry", PoseSample(stamp, "map", "body", pose(i))),
            ("/pose", PoseSample(stamp, "map", "", pose(i))),
            ("/path", path),
            ("/imu", ImuSample(stamp, "imu", np.array([0.1, 0.2, i]), np.array([0.0, 0.0, 9.81]))),
            ("/rgb", RawImage(stamp, "camera", pixels=RNG.integers(0, 256, (5, 7, 3)).astype(np.uint8))),
            ("/gray", RawImage(stamp, "camera", pixels=RNG.integers(0, 65536, (5, 7)).astype(np.uint16))),
            ("/jpeg", RawImage(stamp, "camera", encoded=b"\xff\xd8\xff\xe0" + bytes(i), suffix=".jpg")),
            ("/tf", TransformSample(stamp, "map", "body", pose(i), static=False)),
            ("/fix", replace(fix, stamp=stamp)),
        ]
    made += [
        ("/tf_static", TransformSample(stamps[0], "lidar", "camera", pose(7), static=True)),
        ("/a/camera_info", CameraInfo(stamps[0], "camera", camera, pinhole)),
        ("/b/camera_info", CameraInfo(stamps[0], "camera", fisheye, pinhole)),
        ("/c/camera_info", CameraInfo(stamps[0], "camera", rational, pinhole)),
        ("/d/camera_info", CameraInfo(stamps[0], "camera", None)),
    ]
    return sorted(made, key=lambda item: item[1].stamp)


def source_of(items):
    names = dict.fromkeys(name for name, _ in items)
    streams = tuple(Stream(name, Kind.OTHER, "", None) for name in names)
    return ListSource(SourceDescription("", "made for a test", 0, streams), tuple(items))
