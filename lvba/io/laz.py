"""Point clouds as LAS 1.4 or LAZ, with 16 bit colors."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from lvba.arrays import Vector
from lvba.errors import InputError
from lvba.io import stream

_POINT_FORMAT = 7
_BASIC = ("x", "y", "z", "red", "green", "blue")
MEASURED = ("gps_time", "intensity", "point_source_id")
"""What LAS keeps of how a point was measured."""
_RESOLUTION_M = 0.0001


def write_las(
    path: str | Path,
    chunks: Iterable[Mapping[str, np.ndarray]],
    extra: Mapping[str, np.dtype],
    corner: Vector,
    *,
    wkt: str = "",
    adjusted_time: bool = False,
) -> None:
    """Writes chunks of columns x, y, z, red, green, blue (uint8) and the extra ones; LAZ if the name ends in .laz.

    extra: name and type of the other columns; corner: (3,), m, near the points: where the file's whole-number
    coordinates, in steps of 0.1 mm, start. Columns gps_time, intensity (uint16) and point_source_id may be there.
    wkt: OGC WKT 1 of the coordinates; adjusted_time: gps_time is adjusted standard GPS time, not of another clock
    Raises: InputError if laspy is missing or the file cannot be written.
    """
    try:
        import laspy  # only who exports LAS needs it
    except ImportError as error:
        raise InputError(path, "needs the package laspy", "pip install 'lvba[laz]'") from error
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.offsets, header.scales = np.floor(corner), np.full(3, _RESOLUTION_M)
    header.global_encoding.wkt = True  # LAS 1.4 asks for it with this point format
    if adjusted_time:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in extra.items()])
    compressed = str(path).lower().endswith(".laz")
    with (
        stream.writer(path) as file,
        laspy.open(file, mode="w", header=header, do_compress=compressed, closefd=False) as las,
    ):
        for chunk in chunks:
            points = laspy.ScaleAwarePointRecord.zeros(len(chunk["x"]), header=header)
            for name in "xyz":
                points[name] = chunk[name]
            for name in ("red", "green", "blue"):
                points[name] = chunk[name].astype(np.uint16) * 257
            for name in (*extra, *(name for name in MEASURED if name in chunk)):
                points[name] = chunk[name]
            las.write_points(points)
