"""Clocks of streams that are far from the clock of the scans: by an option, or by when their records were recorded."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lvba.sources.importing.options import MOST_S, ImportOptions
from lvba.sources.importing.streams import Streams
from lvba.sources.importing.survey import Survey
from lvba.sources.source import (
    ImuSample,
    KnownGeometry,
    PathSample,
    PoseSample,
    RawImage,
    Record,
    Source,
    SourceDescription,
    Stream,
    TransformSample,
)

_FAR_S = 10.0
"""Stamps are not recorded later than this, one stream beside another, so that what is more is another clock."""
_NEAR_S = 1.0
"""An offset that an option says is looked for by its data up to this."""
_STEADY_S = 0.5
"""By which the difference may change over a recording: clocks drift by a second in hours."""
_WHOLE_S, _LEAP_S = 0.25, 100.0
"""Clocks so near to a whole number of seconds apart, and by less than that, differ by leap seconds (GPS, TAI)."""


@dataclass(frozen=True)
class Clocks:
    """s, what is added to stamps of images, IMU and poses before all else; 0: their clock is about that of the scans."""

    image: float = 0.0
    imu: float = 0.0
    odometry: float = 0.0
    warnings: tuple[str, ...] = ()

    def shifts(self, streams: Streams) -> dict[str, int]:
        """ns by the name of the stream, where anything is added."""
        every = {streams.image: self.image, streams.imu: self.imu, streams.odometry: self.odometry}
        return {name: round(seconds * 1e9) for name, seconds in every.items() if name and seconds}


ONE = Clocks()
"""All streams have the clock of the scans, or nearly so."""


def name_of(offset: float, clock: float) -> str:
    """The name of an answer: what is added to stamps in all, s. offset: beside what is added before, `clock`"""
    return f"{offset + clock:+.4f}" if clock else f"{offset:+.4g}"


def find(description: SourceDescription, streams: Streams, survey: Survey, options: ImportOptions) -> Clocks:
    """What must be added to stamps of streams, by options, or by when the recorder got their first and last records.

    survey: with stamps as they are
    """
    by_name = {stream.name: stream for stream in description.streams}
    scans = _late(by_name[streams.lidar], survey.seconds(survey.scan_stamps), survey)
    said, times = options.conventions, survey.odometry.times if survey.odometry is not None else np.zeros(0)
    image = _apart(scans, by_name.get(streams.image), survey.seconds(survey.image_stamps), survey)
    imu = _apart(
        scans, by_name.get(streams.imu), np.zeros(0) if survey.imu is None else survey.imu.times, survey
    )
    odometry = _apart(scans, by_name.get(streams.odometry), times, survey)
    last = float(survey.seconds(survey.scan_stamps[-1:])[0])
    if len(times) and times[0] <= last and times[-1] >= 0:
        odometry = 0.0  # of the clock of the scans, or nearly so, however late they were recorded
    seconds_of = {
        "image": _said(said.get("image_offset", ""), image),
        "imu": _said(said.get("imu_offset", ""), imu),
        "odometry": odometry,
    }
    words = tuple(
        f"{name}: stamps are of another clock than those of the scans: {seconds:+.3f} s added, by "
        + ("when both were recorded" if seconds == measured else "the option")
        for (name, seconds), measured in zip(seconds_of.items(), (image, imu, odometry), strict=True)
        if seconds
    )
    return Clocks(**seconds_of, warnings=words)


def _said(text: str, measured: float) -> float:
    """s: what an option says, of which data are asked for the rest; else what is measured."""
    if not text:
        return measured
    return float(text) if abs(float(text)) > _NEAR_S else 0.0


def _late(stream: Stream, times: np.ndarray, survey: Survey) -> np.ndarray | None:
    """(2,) s: how long after their stamps the first and last record were recorded; None: not known. times: (N,) s"""
    if stream.first is None or stream.last is None or not len(times):
        return None
    recorded = np.array([stream.first - survey.zero, stream.last - survey.zero]) * 1e-9
    return np.asarray(recorded - [times[0], times[-1]])


def _apart(scans: np.ndarray | None, stream: Stream | None, times: np.ndarray, survey: Survey) -> float:
    """s, that take stamps of a stream to the clock of the scans; 0: they are near, or it is not known.

    scans: as of `_late`; times: (N,) s, of the stream, ascending
    """
    late = None if stream is None else _late(stream, times, survey)
    if scans is None or late is None:
        return 0.0
    first, last = late - scans
    seconds = float(first + last) / 2
    if abs(first - last) > _STEADY_S or not _FAR_S < abs(seconds) < MOST_S:
        return 0.0
    whole = round(seconds)
    if abs(seconds) < _LEAP_S and abs(seconds - whole) < _WHOLE_S:
        return float(whole)
    return round(seconds, 3)


@dataclass(frozen=True)
class OnOneClock:
    """A source whose streams are on the clock of the scans. shifts: ns, added to stamps, by the name of the stream"""

    source: Source
    shifts: Mapping[str, int]

    def describe(self) -> SourceDescription:
        """As of the source."""
        return self.source.describe()

    def geometry(self) -> KnownGeometry:
        """As of the source."""
        return self.source.geometry()

    def losses(self) -> tuple[str, ...]:
        """As of the source."""
        return self.source.losses()

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """Those of the source, with other stamps."""
        for name, record in self.source.records(streams):
            yield name, _shifted(record, self.shifts.get(name, 0))


def _shifted(record: Record, by: int) -> Record:
    """The record as stamped so much later, ns."""
    if by and isinstance(record, PathSample):
        return replace(record, stamp=record.stamp + by, times=record.times + by)
    if by and isinstance(record, RawImage | ImuSample | PoseSample | TransformSample):
        return replace(record, stamp=record.stamp + by)
    return record
