"""Points and inertial readings from raw packets of Ouster's sensors.

A packet has columns: what all beams saw at one moment, with the number of the column in the turn. All numbers are little
endian. Source: Ouster's firmware user manual (packet formats, and coordinates of points); the profiles with zones and
the FUSA head: by the formats as Ouster's own SDK (BSD-3) describes them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lvba.sources.bags.definitions import Undecodable
from lvba.sources.bags.ouster_metadata import OusterSensor

FIELDS = ("x float32", "y float32", "z float32", "reflectivity float32", "t int64", "ring int64")
_LARGEST_PACKET = 65_535
_HEAD_BYTES = 32
"""Before and behind the columns of a packet, but of the legacy profile."""
_LEGACY = "LEGACY"
_LATEST_NS = 2**62
_NEAR_NS = 10 * 10**9
"""Columns of one turn that are further from the others have no time."""
_IMU_BYTES, _NMEA_BYTES, _READING_BYTES = 48, 100, 36
_GRAVITY = 9.80665
"""m/s^2 in a g, by definition."""


class _Return(NamedTuple):
    """Where a return of a pixel is: words of 32 bits, and the first bit in it. bits: of the range; unit: mm"""

    range_word: int
    bits: int
    unit: int
    reflectivity_word: int
    reflectivity_bit: int


class _Profile(NamedTuple):
    """words: of 32 bits, of each pixel."""

    words: int
    returns: tuple[_Return, ...]


_FINE = _Return(0, 19, 1, 1, 0)
_FINE_BOTH = (_Return(0, 19, 1, 0, 24), _Return(1, 19, 1, 1, 24))
_COARSE = _Return(0, 15, 8, 0, 16)
_COARSE_BOTH = (_COARSE, _Return(1, 15, 8, 1, 16))
_PROFILES = {
    _LEGACY: _Profile(3, (_Return(0, 20, 1, 1, 0),)),
    "RNG19_RFL8_SIG16_NIR16": _Profile(3, (_FINE,)),
    "RNG19_RFL8_SIG16_NIR16_DUAL": _Profile(4, _FINE_BOTH),
    "RNG15_RFL8_NIR8": _Profile(1, (_COARSE,)),
    "RNG15_RFL8_NIR8_DUAL": _Profile(2, _COARSE_BOTH),
    "FUSA_RNG15_RFL8_NIR8_DUAL": _Profile(2, _COARSE_BOTH),
    "RNG15_RFL8_NIR8_ZONE16": _Profile(2, (_COARSE,)),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": _Profile(3, (_FINE,)),
    "RNG15_RFL8_WIN8": _Profile(1, (_COARSE,)),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": _Profile(4, _FINE_BOTH),
}


class Head(NamedTuple):
    """Of a packet. last: ns, of its last column; None: no column of it was measured"""

    frame: int
    initialization: int
    last: int | None


class Points(NamedTuple):
    """Returns of a scan in the order of their times.

    stamp: ns, of the first column, on the sensor's clock; times: (N,) int64, ns from it
    points: (N, 3) float32, m, LiDAR frame; reflectivity: (N,) float32; rows: (N,) int64, of the beams from the top down
    columns: how many were measured
    """

    stamp: int
    points: np.ndarray
    reflectivity: np.ndarray
    times: np.ndarray
    rows: np.ndarray
    columns: int


@dataclass(frozen=True)
class _Columns:
    """words: (C, W) uint32, all of each; times: (C,) int64, ns; numbers: (C,), in the turn; good: (C,), was measured"""

    words: np.ndarray
    times: np.ndarray
    numbers: np.ndarray
    good: np.ndarray


class PacketFormat:
    """How packets of a sensor are read.

    Raises Undecodable: they are of a profile that is not read, or would be larger than packets can be.
    """

    def __init__(self, sensor: OusterSensor) -> None:
        if sensor.profile not in _PROFILES:
            raise Undecodable(f"their profile, {sensor.profile[:40]!r}, is not read")
        self._sensor, self._profile = sensor, _PROFILES[sensor.profile]
        self._legacy = sensor.profile == _LEGACY
        self._column_head = 4 if self._legacy else 3
        pixels = self._profile.words * len(sensor.altitude)
        self._column_words = self._column_head + pixels + self._legacy
        around = 0 if self._legacy else 2 * _HEAD_BYTES
        self.size = around + 4 * self._column_words * sensor.columns_per_packet
        """bytes"""
        if self.size > _LARGEST_PACKET:
            raise Undecodable(f"their packets would have {self.size} bytes")
        self._beams = _beams(sensor)

    def fitted(self, data: np.ndarray) -> bytes:
        """A packet of the right size: old drivers wrote one byte more. data: (N,) uint8

        Raises Undecodable: it has another size.
        """
        if len(data) not in (self.size, self.size + 1):
            text = f"its packets have {len(data)} bytes, and {self.size} by the metadata"
            raise Undecodable(f"{text} (profile {self._sensor.profile})")
        return data[: self.size].tobytes()

    def head(self, packet: bytes) -> Head:
        """What a packet says of itself."""
        columns = self._columns([packet])
        measured = columns.times[columns.good]
        last = int(measured.max()) if len(measured) else None
        frame, initialization = (10, 12), (0, 0)
        if self._sensor.fusa:
            frame, initialization = (4, 8), (1, 4)
        elif not self._legacy:
            frame, initialization = (2, 4), (4, 7)
        number, began = (int.from_bytes(packet[slice(*place)], "little") for place in (frame, initialization))
        return Head(number, began, last)

    @property
    def frame_ids(self) -> int:
        """After so many frames, their numbers begin anew."""
        return 2 ** (32 if self._sensor.fusa else 16)

    def points(self, packets: list[bytes]) -> Points | None:
        """The points of a frame's packets, in the order of their arrival; None: none of their columns was measured.

        Where a column comes twice, the later one counts. Of two returns of a beam, both are taken where they differ.
        """
        columns = self._columns(packets)
        last = np.full(self._sensor.columns_per_frame, -1)
        chosen = np.flatnonzero(columns.good)
        last[columns.numbers[chosen]] = chosen
        chosen = last[last >= 0]
        if not len(chosen):
            return None
        middle = int(np.sort(columns.times[chosen])[len(chosen) // 2])
        chosen = chosen[np.abs(columns.times[chosen] - middle) < _NEAR_NS]
        chosen = chosen[np.argsort(columns.times[chosen], kind="stable")]
        reach, reflectivity = self._returns(columns.words[chosen])
        there = reach > 0
        there[:, :, 1:] &= reach[:, :, 1:] != reach[:, :, :1]
        column, row, _ = np.nonzero(there)
        stamp = int(columns.times[chosen[0]])
        return Points(
            stamp=stamp,
            points=self._places(reach, columns.numbers[chosen])[there],
            reflectivity=reflectivity[there],
            times=(columns.times[chosen] - stamp)[column],
            rows=row,
            columns=len(chosen),
        )

    def _columns(self, packets: list[bytes]) -> _Columns:
        words = np.frombuffer(b"".join(packets), "<u4").reshape(len(packets), -1)
        if not self._legacy:
            words = words[:, _HEAD_BYTES // 4 : -_HEAD_BYTES // 4]
        words = words.reshape(-1, self._column_words)
        times = np.ascontiguousarray(words[:, :2]).view("<u8")[:, 0]
        numbers = (words[:, 2] & 0xFFFF).astype(np.int64)
        status = words[:, -1] if self._legacy else words[:, 2] >> 16
        good = (status & 1 == 1) & (numbers < self._sensor.columns_per_frame) & (times < _LATEST_NS)
        return _Columns(words, times.astype(np.int64), numbers, good)

    def _returns(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(C, H, R): ranges, float64, m, and reflectivities, float32, of R returns. words: (C, W)"""
        first = self._column_head
        count = self._profile.words * len(self._sensor.altitude)
        pixels = words[:, first : first + count].reshape(len(words), -1, self._profile.words)
        shape = (*pixels.shape[:2], len(self._profile.returns))
        reach, reflectivity = np.empty(shape), np.empty(shape, np.float32)
        for number, each in enumerate(self._profile.returns):
            bits = pixels[:, :, each.range_word] & (2**each.bits - 1)
            np.multiply(bits, each.unit * 1e-3, out=reach[:, :, number])
            reflectivity[:, :, number] = pixels[:, :, each.reflectivity_word] >> each.reflectivity_bit & 0xFF
        return reach, reflectivity

    def _places(self, reach: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """(C, H, R, 3) float32, m, LiDAR frame. reach: (C, H, R), m; numbers: (C,), of the columns"""
        sensor = self._sensor
        turned = 2 * np.pi * numbers / sensor.columns_per_frame  # clockwise
        ahead, left = np.cos(turned), -np.sin(turned)
        begin = np.stack([sensor.out * ahead, sensor.out * left, np.full(len(turned), sensor.up)], axis=1)
        # ranges count from the axis: the way to where the beam begins is a part of them
        beyond = reach - np.hypot(sensor.out, sensor.up)
        places = np.empty((*reach.shape, 3), np.float32)
        for axis in range(3):
            by_ahead, by_left, by_up = self._beams[:, :, axis]
            direction = np.outer(ahead, by_ahead) + np.outer(left, by_left) + by_up
            places[..., axis] = beyond * direction[:, :, None] + begin[:, None, None, axis]
        return places


def _beams(sensor: OusterSensor) -> np.ndarray:
    """(3, H, 3): what directions of beams are, LiDAR frame, times the cosine and the sine of the turn, and without."""
    altitude, azimuth = np.radians(sensor.altitude), np.radians(sensor.azimuth)
    level, zero = np.cos(altitude), np.zeros(len(altitude))
    along, across = level * np.cos(azimuth), level * np.sin(azimuth)
    parts = [[along, -across, zero], [across, along, zero], [zero, zero, np.sin(altitude)]]
    return np.array(parts).transpose(0, 2, 1)


class Reading(NamedTuple):
    """Of the IMU. stamp: ns, on the sensor's clock; gyroscope: (3,), rad/s; accelerometer: (3,), m/s^2; IMU frame."""

    stamp: int
    gyroscope: np.ndarray
    accelerometer: np.ndarray


def readings(data: np.ndarray) -> list[Reading]:
    """The readings of an IMU packet: one, or (ACCEL32_GYRO32_NMEA) several. data: (N,) uint8

    The stamp is the gyroscope's, as the driver takes it. Packets of one reading count in g and degrees, others in SI
    units.
    Raises Undecodable: it is no such packet, or has numbers that are none.
    """
    packet = data.tobytes()
    around = 2 * _HEAD_BYTES + _NMEA_BYTES
    turn_unit, force_unit = 1.0, 1.0
    if len(packet) in (_IMU_BYTES, _IMU_BYTES + 1):
        stamps = np.frombuffer(packet[16:24], "<u8")
        numbers = np.frombuffer(packet[24:48], "<f4").reshape(1, 6)
        turn_unit, force_unit = np.pi / 180, _GRAVITY
    elif len(packet) > around and (len(packet) - around) % _READING_BYTES == 0:
        kind = np.dtype([("stamp", "<u8"), ("number", "<u2"), ("status", "<u2"), ("values", "<f4", 6)])
        listed = np.frombuffer(packet[_HEAD_BYTES + _NMEA_BYTES : -_HEAD_BYTES], kind)
        listed = listed[listed["status"] & 1 == 1]
        stamps, numbers = listed["stamp"], listed["values"]
    else:
        raise Undecodable(f"its packets have {len(packet)} bytes, which is none of an IMU")
    numbers = numbers.astype(float)
    if not np.isfinite(numbers).all() or (stamps >= _LATEST_NS).any():
        raise Undecodable("its packets have numbers that are not finite, or no time")
    turns, forces = numbers[:, 3:] * turn_unit, numbers[:, :3] * force_unit
    return [Reading(int(each), *rest) for each, *rest in zip(stamps, turns, forces, strict=True)]
