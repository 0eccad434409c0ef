"""What the metadata of an Ouster sensor say: text in JSON, flat (firmware up to 2.x) or in sections.

Sources: Ouster's firmware user manual (metadata, data format, transforms) and the metadata of recordings of firmware 1.12
to 3.2. Firmware before 2.0 does not say all of it; what it does not say is as in the manuals of the time.
"""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.sources.bags.definitions import Undecodable

MAX_TEXT = 4 * 1024**2
"""Characters: real ones have 2,000 to 60,000."""
_MOST_BEAMS, _MOST_COLUMNS, _MOST_IN_PACKET = 256, 8192, 512
_MOST_MM = 1e4
"""Of offsets inside of a sensor."""
_SKEW = 1e-3
"""By which a rotation may be none."""
_SECTIONS = (
    *("sensor_info", "config_params", "lidar_data_format", "data_format"),
    *("beam_intrinsics", "lidar_intrinsics", "imu_intrinsics"),
)
_OUT_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
_FIRST_OUT_MM = 12.163
"""From the axis to where beams begin, by the beginning of the name of the product, and of the first generation."""
_SENSOR_FROM_LIDAR = (*(-1.0, 0.0, 0.0, 0.0), *(0.0, -1.0, 0.0, 0.0), *(0.0, 0.0, 1.0, 36.18))
_SENSOR_FROM_IMU = (*(1.0, 0.0, 0.0, 6.253), *(0.0, 1.0, 0.0, -11.775), *(0.0, 0.0, 1.0, 7.645))
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_LEGACY, _FUSA = "LEGACY", "FUSA_RNG15_RFL8_NIR8_DUAL"


@dataclass(frozen=True)
class OusterSensor:
    """A sensor, and what its packets hold.

    profile: name of what packets hold of each return; fusa: heads of packets are those of the FUSA profile
    columns_per_frame: in a whole turn; window: the first and last column that are measured, last < first where it spans
        the column of number 0
    altitude, azimuth: (H,) float64, degrees, of the beams from the top down; azimuth: clockwise
    out, up: m, where beams begin in the LiDAR's frame, from its axis and from its origin
    sensor_from_lidar, sensor_from_imu: (4, 4) float64, m
    """

    profile: str
    fusa: bool
    columns_per_packet: int
    columns_per_frame: int
    window: tuple[int, int]
    altitude: np.ndarray
    azimuth: np.ndarray
    out: float
    up: float
    sensor_from_lidar: np.ndarray
    sensor_from_imu: np.ndarray

    @property
    def columns(self) -> int:
        """In the window."""
        first, last = self.window
        return (last - first) % self.columns_per_frame + 1

    @property
    def packets(self) -> int:
        """In a frame, where none is lost."""
        every = -(-self.columns_per_frame // self.columns_per_packet)
        first, last = (number // self.columns_per_packet for number in self.window)
        if last == first and self.window[1] < self.window[0]:
            return every
        return (last - first) % every + 1


def parse(text: str) -> OusterSensor:
    """The sensor of a text of metadata.

    Raises Undecodable: it is none; says what is wrong with it, as of "they".
    """
    values = _values(text)
    frame = _columns_per_frame(values)
    altitude = _numbers(values.get("beam_altitude_angles"), "beam_altitude_angles", 0)
    beams = _count(values, "pixels_per_column", _MOST_BEAMS, len(altitude))
    if len(altitude) != beams or not beams <= _MOST_BEAMS:
        raise Undecodable(f"they have {len(altitude)} beam_altitude_angles for {beams} beams")
    if beams > 1 and not np.ptp(altitude):
        raise Undecodable("all their beam_altitude_angles are the same")
    profile = values.get("udp_profile_lidar") or _LEGACY
    if not isinstance(profile, str):
        raise Undecodable("their udp_profile_lidar is no text")
    header = values.get("header_type")
    out, up = _beam_origin(values)
    return OusterSensor(
        profile=profile,
        fusa=profile != _LEGACY and (header == "FUSA" if isinstance(header, str) else profile == _FUSA),
        columns_per_packet=_count(values, "columns_per_packet", _MOST_IN_PACKET, 16),
        columns_per_frame=frame,
        window=_window(values, frame),
        altitude=altitude,
        azimuth=_numbers(values.get("beam_azimuth_angles"), "beam_azimuth_angles", beams),
        out=out,
        up=up,
        sensor_from_lidar=_transform(values, "lidar_to_sensor_transform", _SENSOR_FROM_LIDAR),
        sensor_from_imu=_transform(values, "imu_to_sensor_transform", _SENSOR_FROM_IMU),
    )


def _values(text: str) -> dict[str, Any]:
    """All of them by their own names, whichever section they are in."""
    if len(text) > MAX_TEXT:
        raise Undecodable(f"they have {len(text)} characters")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Undecodable("they are no JSON") from error
    if not isinstance(document, dict):
        raise Undecodable("they are no JSON object")
    values = dict(document)
    for section in _SECTIONS:
        if isinstance(document.get(section), dict):
            values |= document[section]
    return values


def _numbers(listed: Any, name: str, count: int) -> np.ndarray:
    """(count,) float64. count: 0: any but none"""
    if listed is None:
        raise Undecodable(f"they have no {name}")
    if isinstance(listed, list) and listed and all(isinstance(each, list) for each in listed):
        raise Undecodable("they are of a sensor that does not turn, which is not read")
    numbers = _floats(listed) if isinstance(listed, list) else np.zeros(0)
    if len(numbers) != (count or max(len(numbers), 1)) or not np.isfinite(numbers).all():
        wanted = f"{count} finite numbers" if count else "finite numbers"
        raise Undecodable(f"their {name} are not a list of {wanted}")
    return numbers


def _floats(listed: list[Any]) -> np.ndarray:
    """(N,) float64; NaN for what is no number."""
    known = [isinstance(each, int | float) and not isinstance(each, bool) for each in listed]
    try:
        return np.array(
            [float(each) if is_one else np.nan for each, is_one in zip(listed, known, strict=True)]
        )
    except OverflowError:
        return np.full(len(listed), np.inf)


def _count(values: dict[str, Any], name: str, most: int, usual: int) -> int:
    number = values.get(name)
    if number is None:
        return usual
    if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= most:
        raise Undecodable(f"their {name} is no number from 1 to {most}")
    return number


def _columns_per_frame(values: dict[str, Any]) -> int:
    """As they say, or by the mode, "1024x10"."""
    mode = values.get("lidar_mode")
    by_mode = mode.partition("x")[0] if isinstance(mode, str) else ""
    known = by_mode.isdecimal() and len(by_mode) < 5 and 1 <= int(by_mode) <= _MOST_COLUMNS
    columns = _count(values, "columns_per_frame", _MOST_COLUMNS, int(by_mode) if known else 0)
    if not columns:
        raise Undecodable("they have neither columns_per_frame nor a lidar_mode that says how many there are")
    return columns


def _window(values: dict[str, Any], columns: int) -> tuple[int, int]:
    window = values.get("column_window")
    if window is None:
        return 0, columns - 1
    numbers = _numbers(window, "column_window", 2)
    if not ((numbers >= 0) & (numbers < columns) & (numbers == np.rint(numbers))).all():
        raise Undecodable(f"their column_window is not two of {columns} columns")
    return int(numbers[0]), int(numbers[1])


def _beam_origin(values: dict[str, Any]) -> tuple[float, float]:
    """m, out from the axis and up, where beams begin."""
    if values.get("beam_to_lidar_transform") is not None:
        matrix = _numbers(values["beam_to_lidar_transform"], "beam_to_lidar_transform", 16)
        out, up = float(matrix[3]), float(matrix[11])
    elif values.get("lidar_origin_to_beam_origin_mm") is not None:
        name = "lidar_origin_to_beam_origin_mm"
        out, up = float(_numbers([values[name]], name, 1)[0]), 0.0
    else:
        product = values.get("prod_line")
        names = [name for name in _OUT_MM if isinstance(product, str) and product.startswith(name)]
        out, up = _OUT_MM[names[0]] if names else _FIRST_OUT_MM, 0.0
    if max(abs(out), abs(up)) > _MOST_MM:
        raise Undecodable("their beams begin outside of the sensor")
    return out * 1e-3, up * 1e-3


def _transform(values: dict[str, Any], name: str, usual: tuple[float, ...]) -> np.ndarray:
    """(4, 4) float64, m, of 16 numbers with offsets in mm."""
    listed = values.get(name)
    matrix = _numbers([*usual, *_LAST_ROW] if listed is None else listed, name, 16).reshape(4, 4)
    rotation, offset = matrix[:3, :3], matrix[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not skew < _SKEW or np.linalg.det(rotation) < 0 or np.abs(offset).max() > _MOST_MM:
        raise Undecodable(f"their {name} is no rigid transform")
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, offset * 1e-3
    return transform
