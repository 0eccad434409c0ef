"""Scans from raw packets of Velodyne's sensors (velodyne_msgs/VelodyneScan): VLP-16, Puck Hi-Res, HDL-32E and VLP-32C.

Sources: Velodyne's user manuals (packet structure, firing times, laser angles but those of the VLP-32C). The angles of
the VLP-32C, and how far off the axis beams meet, are known by comparison with velodyne-decoder only. A block has 32
returns and the azimuth of the first of them, clockwise seen from above; the sensor turns on between firings.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.sources.bags.definitions import Undecodable
from lvba.sources.source import RawScan

FIELDS = ("x float32", "y float32", "z float32", "intensity float32", "time int64", "ring int64")
_BYTES, _BLOCKS, _RETURNS = 1206, 12, 32
_UPPER, _LOWER = 0xEEFF, 0xDDFF
"""Flags of blocks; lower ones are of the HDL-64E alone."""
_DUAL = 0x39
_TURN = 36_000
"""Units of azimuth in a turn."""
_HOUR_US = 3_600_000_000
_MOST_GAPS = 3.0
"""Usual gaps from block to block, beyond which packets are missing between them."""
_MOST_APART_S = 0.05
"""Between the clock of the sensor and the stamps of the driver, over a scan; else the sensor's is not used."""


@dataclass(frozen=True)
class _Model:
    """elevation, azimuth: (L,), degrees, of the lasers, by the number in a firing

    radius: m, from the axis to where all beams leave at the height of the origin; distances count from the axis
    firing, cycle: us, from laser to laser, and from one firing of all to the next; together: lasers that fire at once
    unit: m, of distances
    """

    elevation: np.ndarray
    azimuth: np.ndarray
    radius: float
    firing: float
    cycle: float
    together: int
    unit: float

    def after(self) -> np.ndarray:
        """(32,) float64, us, of the returns of a block since its first one."""
        number = np.arange(_RETURNS)
        lasers = len(self.elevation)
        return (number // lasers) * self.cycle + (number % lasers // self.together) * self.firing

    @property
    def block(self) -> float:
        """us, from block to block."""
        return self.cycle * (_RETURNS // len(self.elevation))


def _interleaved(low: float, high: float, step: float, count: int) -> np.ndarray:
    """(count,): lasers that fire from the lower half and the upper half in turns."""
    half = step * np.arange(count // 2)
    return np.stack([low + half, high + half], axis=1).ravel()


def _sixteen(elevation: np.ndarray) -> _Model:
    return _Model(
        elevation=elevation,
        azimuth=np.zeros(16),
        radius=0.04191,
        firing=2.304,
        cycle=55.296,
        together=1,
        unit=0.002,
    )


_32C_ELEVATION = (
    *(
        -25.0,
        -1.0,
        -1.667,
        -15.639,
        -11.31,
        0.0,
        -0.667,
        -8.843,
        -7.254,
        0.333,
        -0.333,
        -6.148,
        -5.333,
        1.333,
    ),
    *(0.667, -4.0, -4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667, -3.0, 7.0, 4.667, -2.333, -2.0),
    *(15.0, 10.333, -1.333),
)
_32C_AZIMUTH = (
    *(1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4),
    *(1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
)
_MODELS = {
    0x21: _Model(
        elevation=_interleaved(-92 / 3, -28 / 3, 4 / 3, 32),
        azimuth=np.zeros(32),
        radius=0.02883,
        firing=1.152,
        cycle=46.08,
        together=1,
        unit=0.002,
    ),
    0x22: _sixteen(_interleaved(-15.0, 1.0, 2.0, 16)),
    0x24: _sixteen(_interleaved(-10.0, 2 / 3, 4 / 3, 16)),
    0x28: _Model(
        elevation=np.array(_32C_ELEVATION),
        azimuth=np.array(_32C_AZIMUTH),
        radius=0.0424,
        firing=2.304,
        cycle=55.296,
        together=2,
        unit=0.004,
    ),
}
"""By the product in the last byte of a packet."""


def scan(values: dict[str, Any], stamp: int, frame: str) -> Iterator[RawScan]:
    """The scan of a VelodyneScan; times: int64 ns since the stamp. stamp: ns

    Both returns of a beam are taken where they differ. Points are in the ROS driver's axes: x ahead, y left, z up.
    Raises Undecodable: it has no packets, or they are of a sensor that is not read.
    """
    data = _packets(values)
    model, dual = _model(data), bool((data[:, 1204] == _DUAL).all())
    blocks = np.ascontiguousarray(data[:, : _BLOCKS * 100]).reshape(-1, 100)
    flags, azimuth = (blocks[:, at : at + 2].copy().view("<u2")[:, 0].astype(np.int64) for at in (0, 2))
    returns = blocks[:, 4:].reshape(-1, _RETURNS, 3)
    distance = returns[:, :, 0].astype(np.int64) + 256 * returns[:, :, 1].astype(np.int64)
    good = (distance > 0) & (flags == _UPPER)[:, None]
    if dual:
        good[1::2] &= distance[1::2] != distance[::2]
    firings = len(blocks) // (2 if dual else 1)
    turned = np.repeat(_gaps(azimuth[:: 2 if dual else 1]), len(blocks) // firings)
    after = model.after()
    degrees = (azimuth[:, None] + turned[:, None] * after / model.block) / 100
    block, number = np.nonzero(good)
    if not len(block):
        raise Undecodable("it has no returns")
    laser = number % len(model.elevation)
    angle = np.radians(degrees[block, number] + model.azimuth[laser])
    elevation = np.radians(model.elevation[laser])
    reach = model.unit * distance[block, number]
    across = reach * np.cos(elevation)
    height = reach * np.sin(elevation) - model.radius * np.tan(elevation)
    points = np.stack([across * np.cos(angle), -across * np.sin(angle), height], axis=1)
    in_packet = np.arange(len(blocks)) % _BLOCKS // (2 if dual else 1) * model.block
    began = _begins(data, values, stamp)
    times = began[block // _BLOCKS] + np.round(1e3 * (in_packet[block] + after[number])).astype(np.int64)
    yield RawScan(
        stamp=stamp,
        frame=frame,
        points=points.astype(np.float32),
        intensity=returns[block, number, 2].astype(np.float32),
        times=times,
        time_field="time",
        rows=np.argsort(np.argsort(model.elevation))[laser],
    )


def _packets(values: dict[str, Any]) -> np.ndarray:
    """(P, 1206) uint8."""
    packets = values["packets"]
    if not len(packets):
        raise Undecodable("it has no packets")
    pieces = [np.asarray(packet["data"], np.uint8) for packet in packets]
    if any(len(piece) != _BYTES for piece in pieces):
        raise Undecodable(f"its packets have no {_BYTES} bytes")
    return np.stack(pieces)


def _model(data: np.ndarray) -> _Model:
    flags = data[:, :2].copy().view("<u2")
    if (data[:, 100:102].copy().view("<u2") == _LOWER).any() or (flags == _LOWER).any():
        raise Undecodable("its packets are of an HDL-64E, whose lasers need the calibration of each sensor")
    products = np.unique(data[:, 1205])
    model = _MODELS.get(int(products[0])) if len(products) == 1 else None
    if model is None:
        raise Undecodable(f"its packets are of a sensor that is not read (product {products[0]:#04x})")
    return model


def _gaps(azimuth: np.ndarray) -> np.ndarray:
    """(B,) float64: how far the sensor turns from each block to the next, in hundredths of a degree."""
    gaps = np.append(np.diff(azimuth) % _TURN, 0).astype(float)
    if len(gaps) < 2:
        return gaps
    usual = float(np.median(gaps[:-1]))
    gaps[-1] = usual
    return np.where(gaps > _MOST_GAPS * usual, usual, gaps)


def _begins(data: np.ndarray, values: dict[str, Any], stamp: int) -> np.ndarray:
    """(P,) int64 ns, since the stamp of the scan: when the first laser of each packet fired.

    By the clock of the sensor, which counts from the full hour, laid onto the driver's stamps, which jitter.
    """
    said = np.array(
        [int(each["stamp.sec"]) * 10**9 + int(each["stamp.nanosec"]) - stamp for each in values["packets"]],
        np.int64,
    )
    counted = data[:, 1200:1204].copy().view("<u4")[:, 0].astype(np.int64)
    since = np.cumsum(np.diff(counted, prepend=counted[0]) % _HOUR_US) * 1000
    off = said - since
    if np.ptp(off) > _MOST_APART_S * 1e9:
        return said
    return since + int(np.median(off))
