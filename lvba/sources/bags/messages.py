"""The message that a driver or odometry would have published, of each record."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.lens import Lens
from lvba.sources.bags.container import Encoding
from lvba.sources.bags.encode import record_type
from lvba.sources.bags.layout import layout_of
from lvba.sources.bags.point_layouts import CUSTOM, PointLayout, offsets_ns, published
from lvba.sources.source import (
    CameraInfo,
    GnssFix,
    ImuSample,
    PathSample,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    TransformSample,
)

_NANO = 1_000_000_000
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
Values = dict[str, Any]


class NamedMessage(NamedTuple):
    """kind: type of the message, as in ROS 2; stamp: ns"""

    kind: str
    values: Values
    stamp: int


def message_of(record: Record, layout: PointLayout, encoding: Encoding) -> NamedMessage:
    """The message of a record; of scans in the layout of a driver."""
    if isinstance(record, RawScan):
        return _custom(record, layout, encoding) if layout in CUSTOM else _cloud(record, layout)
    kind, values = _MAKERS[type(record)](record)
    return NamedMessage(kind, values, record.stamp)


def _stamp(stamp: int, prefix: str = "header.") -> Values:
    return {f"{prefix}stamp.sec": stamp // _NANO, f"{prefix}stamp.nanosec": stamp % _NANO}


def _header(record: Any) -> Values:
    frame = record.frame if hasattr(record, "frame") else record.parent
    return {**_stamp(record.stamp), "header.frame_id": frame}


def _pose(parent_from_child: Pose, prefix: str, move: str = "position", turn: str = "orientation") -> Values:
    quaternion = geometry.quaternion(parent_from_child)
    numbers = {
        f"{prefix}{move}.{axis}": value for axis, value in zip("xyz", parent_from_child[:3, 3], strict=True)
    }
    return numbers | {f"{prefix}{turn}.{axis}": value for axis, value in zip("xyzw", quaternion, strict=True)}


def _custom(scan: RawScan, layout: PointLayout, encoding: Encoding) -> NamedMessage:
    kind = CUSTOM[layout]
    points = np.zeros(len(scan.points), record_type(layout_of("", kind, encoding), "points", encoding))
    for axis, name in enumerate("xyz"):
        points[name] = scan.points[:, axis]
    points["offset_time"] = offsets_ns(scan)
    if scan.intensity is not None:
        points["reflectivity"] = np.clip(np.rint(scan.intensity), 0, 255)
    if scan.rows is not None:
        points["line"] = scan.rows % 256
    counted = {"timebase": scan.stamp, "point_num": len(points), "points": points}
    return NamedMessage(kind, _header(scan) | counted, scan.stamp)


def _cloud(scan: RawScan, layout: PointLayout) -> NamedMessage:
    stamp, table = (sweep := published(scan, layout)).stamp, sweep.table
    fields = [
        {"name": name, "offset": offset, "datatype": _CODES[kind.str[1:]], "count": 1}
        for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
    ]
    values = {
        **_stamp(stamp),
        "header.frame_id": scan.frame,
        "height": 1,
        "width": len(table),
        "fields": fields,
        "point_step": table.itemsize,
        "row_step": table.nbytes,
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }
    return NamedMessage("sensor_msgs/msg/PointCloud2", values, stamp)


def _image(image: RawImage) -> tuple[str, Values]:
    if image.encoded is not None:
        form = "jpeg" if image.suffix == ".jpg" else "png"
        data = np.frombuffer(image.encoded, np.uint8)
        return "sensor_msgs/msg/CompressedImage", {**_header(image), "format": form, "data": data}
    pixels = image.pixels if image.pixels is not None else np.zeros((0, 0), np.uint8)
    name = {(2, 1): "mono8", (2, 2): "mono16", (3, 1): "rgb8", (3, 2): "rgb16"}[pixels.ndim, pixels.itemsize]
    values = {
        **_header(image),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": name,
        "step": pixels.nbytes // max(1, len(pixels)),
        "data": np.frombuffer(pixels.tobytes(), np.uint8),
    }
    return "sensor_msgs/msg/Image", values


def _odometry(sample: PoseSample) -> tuple[str, Values]:
    if not sample.child:
        return "geometry_msgs/msg/PoseStamped", _header(sample) | _pose(sample.parent_from_child, "pose.")
    values = {**_header(sample), "child_frame_id": sample.child}
    return "nav_msgs/msg/Odometry", values | _pose(sample.parent_from_child, "pose.pose.")


def _path(path: PathSample) -> tuple[str, Values]:
    listed = [
        {**_stamp(int(time)), "header.frame_id": path.parent, **_pose(pose, "pose.")}
        for time, pose in zip(path.times, path.parent_from_child, strict=True)
    ]
    return "nav_msgs/msg/Path", {**_header(path), "poses": listed}


def _imu(sample: ImuSample) -> tuple[str, Values]:
    values = _header(sample) | {"orientation.w": 1.0}
    for name, numbers in (
        ("angular_velocity", sample.gyroscope),
        ("linear_acceleration", sample.accelerometer),
    ):
        values |= {f"{name}.{axis}": value for axis, value in zip("xyz", numbers, strict=True)}
    return "sensor_msgs/msg/Imu", values


def _fix(fix: GnssFix) -> tuple[str, Values]:
    values = _header(fix) | {name: getattr(fix, name) for name in ("latitude", "longitude", "altitude")}
    values["status.status"] = fix.status
    if fix.covariance is not None:
        values |= {"position_covariance": fix.covariance.reshape(-1), "position_covariance_type": 3}
    return "sensor_msgs/msg/NavSatFix", values


def _camera_info(info: CameraInfo) -> tuple[str, Values]:
    values, camera = _header(info), info.camera
    if camera is None:
        return "sensor_msgs/msg/CameraInfo", values
    model = "equidistant" if camera.lens is Lens.EQUIDISTANT else "plumb_bob"
    coefficients = (
        camera.distortion
        if len(camera.distortion) != 4 or model != "plumb_bob"
        else (*camera.distortion, 0.0)
    )
    of_rectified = info.other if info.other is not None and not info.rectified else camera
    values |= {
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "rational_polynomial" if len(coefficients) == 8 else model,
        "d": coefficients,
        "k": camera.matrix.reshape(-1),
        "r": np.eye(3).reshape(-1),
        "p": np.hstack([of_rectified.matrix, np.zeros((3, 1))]).reshape(-1),
    }
    return "sensor_msgs/msg/CameraInfo", values


def _transform(sample: TransformSample) -> tuple[str, Values]:
    pose = _pose(sample.parent_from_child, "transform.", "translation", "rotation")
    one = {**_header(sample), "child_frame_id": sample.child, **pose}
    return "tf2_msgs/msg/TFMessage", {"transforms": [one]}


_MAKERS: dict[type, Callable[[Any], tuple[str, Values]]] = {
    RawImage: _image,
    PoseSample: _odometry,
    PathSample: _path,
    ImuSample: _imu,
    GnssFix: _fix,
    CameraInfo: _camera_info,
    TransformSample: _transform,
}
