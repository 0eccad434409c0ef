"""Scans from sensor_msgs/PointCloud2 in whatever layout a driver chose, and from Livox's CustomMsg."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lvba.io import point_fields
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.source import RawScan

INTENSITY_FIELDS = ("intensity", "intensities", "reflectivity", "reflectance", "i")
ROW_FIELDS = ("ring", "line", "row", "channel", "laser_id", "scan_id", "ring_id")
_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Of sensor_msgs/PointField."""
_NAMES = {"i": "int", "u": "uint", "f": "float"}


def field_names(values: dict[str, Any]) -> tuple[str, ...]:
    """ "name type" of each field of a cloud's points."""
    return tuple(
        f"{field['name']} {_NAMES[code[0]]}{8 * int(code[1])}"
        if (code := _CODES.get(field["datatype"]))
        else field["name"]
        for field in values["fields"]
    )


def livox_fields(values: dict[str, Any]) -> tuple[str, ...]:
    """ "name type" of each field of a CustomMsg's points."""
    return tuple(f"{name} {kind.name}" for name, (kind, *_) in (values["points"].dtype.fields or {}).items())


def point_cloud(values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawScan]:
    """The scan of a sensor_msgs/PointCloud2. stamp: ns

    Raises Undecodable: it has no points, no coordinates, or its numbers contradict each other.
    """
    cloud = _Cloud(values)
    time_fields = point_fields.times_of(cloud.fields)
    intensity_field = _first(INTENSITY_FIELDS, cloud.fields)
    row_field = _first(ROW_FIELDS, cloud.fields)
    rows = cloud.column(row_field) if row_field else None
    yield RawScan(
        stamp=stamp,
        frame=frame,
        points=cloud.positions(),
        intensity=cloud.column(intensity_field).astype(np.float32) if intensity_field else None,
        times=point_fields.joined([cloud.column(name) for name in time_fields]),
        time_field=", ".join(time_fields),
        rows=rows.astype(np.int64) if rows is not None and rows.dtype.kind in "iu" else None,
    )


def _first(names: Sequence[str], fields: dict[str, Any]) -> str:
    """The first of some names that a field has, by the field's own spelling."""
    spelled = {name.lower(): name for name in reversed(fields)}
    return next((spelled[name] for name in names if name in spelled), "")


class _Cloud:
    """The rows and columns of numbers in a cloud's data."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._order = ">" if values["is_bigendian"] else "<"
        self._data = values["data"]
        self._height, self._width = int(values["height"]), int(values["width"])
        self._step = int(values["point_step"])
        if not self._height or not self._width:
            raise Undecodable("it has no points")
        self._row = self._row_step(int(values["row_step"]))
        self.fields = {
            field["name"]: (_CODES[field["datatype"]], int(field["offset"]))
            for field in values["fields"][:1000]
            if field["datatype"] in _CODES
        }

    def _row_step(self, claimed: int) -> int:
        """Bytes from row to row: as it says, or, where that cannot be, by the points."""
        for step in (claimed, self._width * self._step):
            fits = (self._height - 1) * step + self._width * self._step <= len(self._data)
            if self._step > 0 and fits and (step >= self._width * self._step or self._height == 1):
                return step
        raise Undecodable("its points are more than its bytes")

    def column(self, name: str) -> np.ndarray:
        """(N,) of a field, in its own type, in the byte order of the machine."""
        code, offset = self.fields[name]
        kind = np.dtype(self._order + code)
        if offset + kind.itemsize > self._step:
            raise Undecodable(f"its field {name[:40]!r} lies beyond its points")
        strided: np.ndarray = np.ndarray(
            (self._height, self._width), kind, self._data, offset, (self._row, self._step)
        )
        return strided.reshape(-1).astype(kind.newbyteorder("="))

    def positions(self) -> np.ndarray:
        """(N, 3) float32, m."""
        names = [_first((axis,), self.fields) for axis in "xyz"]
        if not all(names):
            raise Undecodable("its points have no x, y, z")
        (code, first), *others = (self.fields[name] for name in names)
        if code == "f4" and [tuple(each) for each in others] == [("f4", first + 4), ("f4", first + 8)]:
            if first + 12 > self._step:
                raise Undecodable("its field 'z' lies beyond its points")
            strides = (self._row, self._step, 4)
            together: np.ndarray = np.ndarray(
                (self._height, self._width, 3), self._order + "f4", self._data, first, strides
            )
            return together.reshape(-1, 3).astype(np.float32)
        with np.errstate(over="ignore"):
            return np.stack([self.column(name).astype(np.float32) for name in names], axis=1)


def livox(values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawScan]:
    """The scan of a CustomMsg of the Livox drivers. stamp: ns

    Raises Undecodable: it has no points, or they lack what such points have.
    """
    points = values.get("points", ())
    if not len(points):
        raise Undecodable("it has no points")
    if isinstance(points, list):  # of a definition whose points have no fixed places
        points = {name: np.array([point[name] for point in points]) for name in points[0]}
        names = tuple(points)
    else:
        names = points.dtype.names or ()
    if not {"x", "y", "z", "offset_time"} <= set(names):
        raise Undecodable("its points are not those of a Livox driver")
    times = points["offset_time"]
    xyz = np.empty((len(times), 3), np.float32)
    for axis, name in enumerate("xyz"):
        xyz[:, axis] = points[name]
    yield RawScan(
        stamp=stamp,
        frame=frame,
        points=xyz,
        intensity=points["reflectivity"].astype(np.float32) if "reflectivity" in names else None,
        times=times.astype(times.dtype.newbyteorder("=")),
        time_field="offset_time",
        rows=points["line"].astype(np.int64) if "line" in names else None,
    )
