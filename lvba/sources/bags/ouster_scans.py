"""Scans of an Ouster from its packets, one message each: those of one frame number are one scan."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lvba.sources.bags.definitions import Undecodable
from lvba.sources.bags.ouster_metadata import OusterSensor
from lvba.sources.bags.ouster_packets import PacketFormat, readings
from lvba.sources.bags.sensor_clock import SensorClock
from lvba.sources.source import ImuSample, RawScan

_AWAITED = 4
"""Packets of the next scan that may come before the last ones of a scan, as networks change their order."""
_OLD = 8
"""Frames that may be behind: numbers further back are those of a sensor that began anew."""
_LEAST = 4
"""A scan has at least one column in so many: those at the beginning of a recording may have less."""


class ScanMaker:
    """Makes scans of the packets of one topic. It holds the packets of two scans at most."""

    def __init__(self, sensor: OusterSensor, clock: SensorClock, frame: str) -> None:
        """frame: name of the LiDAR's. Raises Undecodable: its packets are not read"""
        self._sensor, self._clock, self._frame = sensor, clock, frame
        self._format = PacketFormat(sensor)
        self._most = 2 * sensor.packets + _OLD
        self._open: dict[int, list[bytes]] = {}
        self._closed: int | None = None
        self._initialization: int | None = None
        self.slivers = 0
        """Scans of which too little was there."""

    def __call__(self, values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawScan]:
        """Scans that a packet completes, mostly none. stamp: ns, when it was recorded

        Raises Undecodable: it is none of the sensor, or too late.
        """
        packet = self._format.fitted(np.asarray(values["buf"], np.uint8))
        head = self._format.head(packet)
        if head.last is not None:
            self._clock.see(head.last, stamp)
        if self._initialization not in (None, head.initialization):
            yield from self.finish()
        self._initialization = head.initialization
        if head.frame not in self._open:
            if self._is_old(head.frame):
                raise Undecodable("it came after its scan")
            self._open[head.frame] = []
        held = self._open[head.frame]
        held.append(packet)
        first = next(iter(self._open))
        if len(self._open) > 2 or (head.frame != first and len(held) > _AWAITED):
            yield from self._close(first)
        if len(held) >= self._most and head.frame in self._open:
            yield from self._close(head.frame)

    def finish(self) -> Iterator[RawScan]:
        """What is left when all packets were read, or the sensor began anew."""
        for number in list(self._open):
            yield from self._close(number)
        self._closed = None

    def _is_old(self, number: int) -> bool:
        if self._closed is None:
            return False
        return (self._closed - number) % self._format.frame_ids < _OLD

    def _close(self, number: int) -> Iterator[RawScan]:
        self._closed = number
        made = self._format.points(self._open.pop(number))
        if made is None or made.columns * _LEAST < self._sensor.columns or not len(made.points):
            self.slivers += 1
            return
        yield RawScan(
            stamp=made.stamp + self._clock.apart(),
            frame=self._frame,
            points=made.points,
            intensity=made.reflectivity,
            times=made.times,
            time_field="t",
            rows=made.rows,
        )


class ReadingMaker:
    """Makes readings of an IMU of the packets of one topic."""

    def __init__(self, clock: SensorClock, frame: str) -> None:
        """frame: name of the IMU's."""
        self._clock, self._frame = clock, frame

    def __call__(self, values: dict[str, Any], stamp: int, frame: str) -> Iterator[ImuSample]:
        """The readings of a packet. stamp: ns, when it was recorded

        Raises Undecodable: it is none.
        """
        made = readings(np.asarray(values["buf"], np.uint8))
        if made:
            self._clock.see(made[-1].stamp, stamp)
        for each in made:
            yield ImuSample(each.stamp + self._clock.apart(), self._frame, each.gyroscope, each.accelerometer)
