"""Packets and metadata of Ouster's sensors, written from the layouts of the manuals, and what is in them."""

import json
import struct
from dataclasses import dataclass, field, replace

import numpy as np

LEGACY, SINGLE, DUAL, LOW, LOW_DUAL, FUSA = (
    "LEGACY",
    "RNG19_RFL8_SIG16_NIR16",
    "RNG19_RFL8_SIG16_NIR16_DUAL",
    "RNG15_RFL8_NIR8",
    "RNG15_RFL8_NIR8_DUAL",
    "FUSA_RNG15_RFL8_NIR8_DUAL",
)
PROFILES = (LEGACY, SINGLE, DUAL, LOW, LOW_DUAL, FUSA)
TURN_NS = 100_000_000


@dataclass(frozen=True)
class Device:
    """A made-up sensor. Angles: degrees; offsets: mm, as in metadata."""

    profile: str = SINGLE
    beams: int = 6
    columns: int = 64
    in_packet: int = 16
    window: tuple[int, int] = (0, 63)
    out: float = 15.806
    up: float = 0.0
    sensor_from_lidar: tuple[float, ...] = (-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)
    sensor_from_imu: tuple[float, ...] = (1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1)
    initialization: int = 0x123456

    @property
    def altitude(self):
        return np.linspace(21.0, -20.5, self.beams)

    @property
    def azimuth(self):
        return 3.0 * np.cos(np.arange(self.beams))

    def metadata(self, *, nested: bool = True, without: tuple[str, ...] = (), **values) -> str:
        """JSON. values: in place of those of the device, by their own names"""
        first = [1, 0, 0, self.out, 0, 1, 0, 0, 0, 0, 1, self.up, 0, 0, 0, 1]
        sections = {
            "beam_intrinsics": {
                "beam_altitude_angles": self.altitude.tolist(),
                "beam_azimuth_angles": self.azimuth.tolist(),
                "beam_to_lidar_transform": first,
                "lidar_origin_to_beam_origin_mm": self.out,
            },
            "lidar_intrinsics": {"lidar_to_sensor_transform": list(self.sensor_from_lidar)},
            "imu_intrinsics": {"imu_to_sensor_transform": list(self.sensor_from_imu)},
            "lidar_data_format" if nested else "data_format": {
                "pixels_per_column": self.beams,
                "columns_per_packet": self.in_packet,
                "columns_per_frame": self.columns,
                "column_window": list(self.window),
                "udp_profile_lidar": self.profile,
            },
            "config_params": {"lidar_mode": "1024x10"},
            "sensor_info": {"prod_line": "OS-1-6"},
        }
        for section in sections.values():
            section |= {name: values[name] for name in section if name in values}
            for name in without:
                section.pop(name, None)
        if nested:
            return json.dumps(sections)
        kept = {"data_format": sections.pop("data_format")}
        return json.dumps(
            kept | {name: each for section in sections.values() for name, each in section.items()}
        )


@dataclass(frozen=True)
class Turn:
    """What a sensor saw in a turn.

    ranges, reflectivity: (W, H, R) int, mm and 0..255; times: (W,) int, ns; measured: (W,) bool
    """

    frame: int
    ranges: np.ndarray
    reflectivity: np.ndarray
    times: np.ndarray
    measured: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))


def returns_of(profile: str) -> int:
    return 2 if "DUAL" in profile else 1


def turn(device: Device, frame: int, begin: int, seed: int = 0, nothing: float = 0.2) -> Turn:
    """Random ranges of whole units. begin: ns; nothing: part of the beams that do not come back"""
    rng = np.random.default_rng([seed, frame])
    shape = (device.columns, device.beams, returns_of(device.profile))
    ranges = 8 * rng.integers(40, 2**15 if "RNG15" in device.profile else 2**16, shape)
    ranges += 0 if "RNG15" in device.profile else rng.integers(0, 8, shape)
    if shape[2] == 2:
        same = rng.random(shape[:2]) < 0.3
        ranges[same, 1] = ranges[same, 0]
    ranges[rng.random(shape) < nothing] = 0
    times = begin + np.arange(device.columns) * TURN_NS // device.columns
    first, last = device.window
    numbers = np.arange(device.columns)
    inside = (
        (numbers >= first) & (numbers <= last) if first <= last else (numbers >= first) | (numbers <= last)
    )
    return Turn(frame, ranges, rng.integers(0, 256, shape), times, inside)


def packets(device: Device, seen: Turn, seed: int = 9) -> list[bytes]:
    """All packets of a turn that have a measured column; other bits of pixels are noise."""
    rng, made = np.random.default_rng(seed), []
    for begin in range(0, device.columns, device.in_packet):
        numbers = range(begin, min(begin + device.in_packet, device.columns))
        if not seen.measured[begin : begin + device.in_packet].any():
            continue
        columns = b"".join(_column(device, seen, number, rng) for number in numbers)
        if device.profile == LEGACY:
            made.append(columns)
        elif device.profile == FUSA:
            head = struct.pack("<I", 1 | device.initialization << 8) + struct.pack("<I", seen.frame)
            made.append(head + bytes(24) + columns + bytes(32))
        else:
            head = struct.pack("<HHI", 1, seen.frame % 65536, device.initialization)
            made.append(head + bytes(24) + columns + bytes(32))
    return made


def _column(device: Device, seen: Turn, number: int, rng: np.random.Generator) -> bytes:
    time, status = int(seen.times[number]), bool(seen.measured[number])
    pixels = b"".join(
        _pixel(device.profile, seen.ranges[number, row], seen.reflectivity[number, row], rng)
        for row in range(device.beams)
    )
    if device.profile == LEGACY:
        head = struct.pack("<QHHI", time, number, seen.frame % 65536, 88 * number)
        return head + pixels + struct.pack("<I", 0xFFFFFFFF if status else 0)
    return struct.pack("<QHH", time, number, status) + pixels


def _pixel(profile: str, ranges, reflectivity, rng: np.random.Generator) -> bytes:
    noise = [int(each) for each in rng.integers(0, 2**16, 6)]
    first, bright = int(ranges[0]), int(reflectivity[0])
    if profile == LEGACY:
        return struct.pack("<IHHHH", first | (noise[0] & 15) << 28, bright | noise[1] & 0xFF00, *noise[2:5])
    if profile == SINGLE:
        return struct.pack("<IHHHH", first | (noise[0] & 31) << 19, bright | noise[1] & 0xFF00, *noise[2:5])
    if profile == LOW:
        return struct.pack("<HBB", first >> 3 | (noise[0] & 1) << 15, bright, noise[1] & 255)
    second, brighter = int(ranges[1]), int(reflectivity[1])
    if profile == DUAL:
        words = (
            first | (noise[0] & 31) << 19 | bright << 24,
            second | (noise[1] & 31) << 19 | brighter << 24,
        )
        return struct.pack("<IIHHHH", *words, *noise[2:6])
    low = (first >> 3 | (noise[0] & 1) << 15, bright, noise[1] & 255)
    return struct.pack("<HBBHBB", *low, second >> 3 | (noise[2] & 1) << 15, brighter, noise[3] & 255)


def imu_packet(stamp: int, gyroscope, accelerometer) -> bytes:
    """stamp: ns; gyroscope: degrees/s; accelerometer: g"""
    return struct.pack("<QQQ6f", stamp - 7, stamp - 3, stamp, *accelerometer, *gyroscope)


def imu_packets_of_several(readings) -> bytes:
    """A packet of the profile ACCEL32_GYRO32_NMEA. readings: of stamp (ns), rad/s, m/s^2, whether measured"""
    listed = [struct.pack("<QHH6f", stamp, 5, good, *felt, *turned) for stamp, turned, felt, good in readings]
    return bytes(32 + 100) + b"".join(listed) + bytes(32)


def truth(device: Device, seen: Turn) -> np.ndarray:
    """(N, 6): x y z (m), time (ns since the first column), row, reflectivity of each return, in the order of their times.

    LiDAR frame, by the formula of the manual, beam by beam.
    """
    first = int(seen.times[seen.measured].min())
    rows = []
    beyond = np.hypot(device.out, device.up)
    for column in np.argsort(seen.times, kind="stable"):
        encoder = 2 * np.pi * (1 - column / device.columns)
        for row in range(device.beams):
            angle, tilt = encoder - np.radians(device.azimuth[row]), np.radians(device.altitude[row])
            for number, reach in enumerate(seen.ranges[column, row]):
                again = number and reach == seen.ranges[column, row, 0]
                if not seen.measured[column] or not reach or again:
                    continue
                x = (reach - beyond) * np.cos(angle) * np.cos(tilt) + device.out * np.cos(encoder)
                y = (reach - beyond) * np.sin(angle) * np.cos(tilt) + device.out * np.sin(encoder)
                z = (reach - beyond) * np.sin(tilt) + device.up
                place = 1e-3 * np.array([x, y, z])
                rows.append((*place, seen.times[column] - first, row, seen.reflectivity[column, row, number]))
    return np.array(rows)


def like(device: Device, **changes) -> Device:
    return replace(device, **changes)
