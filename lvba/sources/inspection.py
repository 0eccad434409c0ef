"""What is in a source, its clocks and conventions, and what is missing: by its index and a few records."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.lidar.point_times import find_clock
from lvba.sources import camera_topics, packets, presets
from lvba.sources.camera_topics import CameraTopic
from lvba.sources.choosing import Choice, choose
from lvba.sources.importing.survey import is_return
from lvba.sources.repeated_transforms import Pair, Repeated
from lvba.sources.source import (
    CameraInfo,
    GnssFix,
    ImuSample,
    Kind,
    PathSample,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    Source,
    SourceDescription,
    Stream,
    TransformSample,
)

_SAMPLES = {
    Kind.SCANS: 5,
    Kind.IMAGES: 2,
    Kind.POSES: 2,
    Kind.IMU: 100,
    Kind.GNSS: 2,
    Kind.CAMERA_INFO: 1,
    Kind.TRANSFORMS: 200,
}
"""Records that are looked at, of each stream."""
_MOST_LOOKED_AT = 500
"""Streams."""
_UNIX_FROM, _UNIX_TO = 10**18, 4 * 10**18
"""ns since 1970, of 2001 and 2096: stamps between are by the time of day, smaller ones since the device started."""
_NEAR = 0.1
"""Part of a sweep by which its first or last point may be off the stamp that means it."""
_GRAVITY_G = (0.5, 2.0)
"""Of the accelerometer's length, where it counts in g; in m/s^2 it is near 9.8."""
_APART_S = 5.0
"""Clocks of two sensors that are farther apart than this are two."""
_UNITS = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}


@dataclass(frozen=True)
class StreamFacts:
    """A stream, and what its first records say.

    rate: 1/s; first_stamp: ns; frame: of its records; facts: by name, as text, a number or a list of numbers
    problem: why its records cannot be read; "" where they can
    transforms: pairs of frames whose transforms hold for all times
    """

    stream: Stream
    rate: float | None = None
    first_stamp: int | None = None
    frame: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problem: str = ""
    camera: Camera | None = None
    transforms: tuple[Pair, ...] = ()


@dataclass(frozen=True)
class Inspection:
    """What is in a source. missing: what an import lacks, and how to give it; notes: what is unusual; one sentence each

    presets: names of public data sets that it may be of, by its topics
    """

    description: SourceDescription
    streams: tuple[StreamFacts, ...]
    choice: Choice
    missing: tuple[str, ...]
    notes: tuple[str, ...]
    presets: tuple[str, ...] = ()


def inspect(source: Source) -> Inspection:
    """Looks at an index and the first records of each stream; seconds also for long recordings.

    Raises InputError: the source is damaged past use.
    """
    description = source.describe()
    facts = tuple(
        _facts(source, stream) if number < _MOST_LOOKED_AT else StreamFacts(stream=stream, rate=_rate(stream))
        for number, stream in enumerate(description.streams)
    )
    choice = choose(description, {each.stream.name for each in facts if each.problem})
    missing = tuple(_missing(source, facts, choice))
    notes = tuple(_notes(description, facts, choice, deskewed=source.geometry().deskewed))
    fitting = tuple(each.name for each in presets.fitting(description))
    return Inspection(
        description=description,
        streams=facts,
        choice=choice,
        missing=missing,
        notes=notes,
        presets=fitting,
    )


def by_names(description: SourceDescription) -> Inspection:
    """What names, types and counts of streams tell, where no record can be read yet."""
    facts = tuple(StreamFacts(stream=stream, rate=_rate(stream)) for stream in description.streams)
    choice = choose(description)
    return Inspection(
        description=description,
        streams=facts,
        choice=choice,
        missing=tuple(_absent(description.streams, choice)),
        notes=tuple(_notes(description, (), choice, deskewed=True)),
        presets=tuple(each.name for each in presets.fitting(description)),
    )


def _facts(source: Source, stream: Stream) -> StreamFacts:
    facts = StreamFacts(stream=stream, rate=_rate(stream))
    if stream.kind not in _SAMPLES or stream.count == 0:
        return facts
    try:
        records = [record for _, record in islice(source.records({stream.name}), _SAMPLES[stream.kind])]
    except InputError as error:
        raw = packets.is_raw(stream.message_type)
        return replace(facts, problem=f"{error.problem}: {error.mend}" if raw else error.problem)
    if not records:
        return replace(facts, problem=next(iter(source.losses()), "none of its records can be read"))
    first = records[0]
    if not all(isinstance(record, _RECORDS[stream.kind]) for record in records):
        return replace(facts, problem="it has messages of several types")
    return replace(
        facts,
        first_stamp=first.stamp,
        frame=first.parent if isinstance(first, PoseSample | PathSample | TransformSample) else first.frame,
        facts=_finite(_CONTENTS[stream.kind](records) | _clock(stream, first)),
        camera=first.camera if isinstance(first, CameraInfo) else None,
        transforms=_lasting([each for each in records if isinstance(each, TransformSample)]),
    )


def _lasting(samples: list[TransformSample]) -> tuple[Pair, ...]:
    """Pairs of frames whose transforms hold for all times, as far as some of them tell."""
    repeated = Repeated()
    for sample in samples:
        if not sample.static:
            repeated.add(sample)
    return (*((each.parent, each.child) for each in samples if each.static), *repeated.still())


def _finite(facts: dict[str, Any]) -> dict[str, Any]:
    """Those that are no infinite number, or none at all."""
    return {
        name: value for name, value in facts.items() if not isinstance(value, float) or np.isfinite(value)
    }


def _rate(stream: Stream) -> float | None:
    """1/s"""
    if stream.first is None or stream.last is None or not stream.count or stream.count < 2:
        return None
    seconds = (stream.last - stream.first) * 1e-9
    return (stream.count - 1) / seconds if seconds > 0 else None


def _clock(stream: Stream, first: Record) -> dict[str, Any]:
    """Which clock stamps are of; how late the recorder got the first record, s."""
    clock = "time of day" if _UNIX_FROM < first.stamp < _UNIX_TO else "since its device started"
    facts: dict[str, Any] = {"clock": clock}
    if stream.first is not None and clock == "time of day":
        facts["recorded_after_stamp_s"] = round((stream.first - first.stamp) * 1e-9, 4)
    return facts


def _scan_facts(records: list[Any]) -> dict[str, Any]:
    scans: list[RawScan] = records
    counts = [len(scan.points) for scan in scans]
    facts: dict[str, Any] = {"points": int(np.median(counts))}
    empty = np.mean(
        [np.mean(~scan.points.any(axis=1) | ~np.isfinite(scan.points).all(axis=1)) for scan in scans]
    )
    if empty > 0.001:
        facts["without_return"] = round(float(empty), 3)
    rows = max((len(np.unique(scan.rows)) for scan in scans if scan.rows is not None), default=0)
    if rows > 1:
        facts["rows"] = rows
    if not scans[0].time_field:
        return facts | {"times": "none"}
    scans = [_of_returns(scan) for scan in scans]
    stamps = np.array([scan.stamp for scan in scans]) * 1e-9
    clock = find_clock([scan.times for scan in scans], stamps)
    if isinstance(clock, str):
        return facts | {"times": f"not used: {clock or 'all the same'}", "time_field": scans[0].time_field}
    begin = clock.begin if clock.absolute else _first_relative(scans, clock.unit)
    return facts | {
        "time_field": scans[0].time_field,
        "times": "since 1970" if clock.absolute and _large(scans[0], clock.unit) else "from the stamp",
        "time_unit": _UNITS[clock.unit],
        "sweep_s": round(clock.sweep, 4),
        "stamp_is": _meaning(begin, clock.sweep),
    }


def _of_returns(scan: RawScan) -> RawScan:
    """The scan with the times of what came back alone: some drivers leave times of others at zero, or at NaN."""
    good = is_return(scan.points)
    return scan if scan.times is None or not good.any() else replace(scan, times=scan.times[good])


def _first_relative(scans: list[RawScan], unit: float) -> float:
    """s from the stamp to the first point, of times that count from it."""
    known = [np.asarray(scan.times, float) for scan in scans if scan.times is not None]
    known = [each[np.isfinite(each)] for each in known]
    return float(np.median([np.quantile(each, 0.005) * unit for each in known if len(each)]))


def _large(scan: RawScan, unit: float) -> bool:
    """Whether times are too large to count from the stamp."""
    return scan.times is not None and float(np.abs(scan.times[:1]).max(initial=0)) * unit > 1e6


def _meaning(begin: float, sweep: float) -> str:
    """What the stamp is, by when the first point comes (s from it)."""
    for name, expected in (
        ("start of the sweep", 0.0),
        ("end of the sweep", -sweep),
        ("middle of the sweep", -sweep / 2),
    ):
        if abs(begin - expected) < _NEAR * sweep:
            return name
    return f"{-begin:.3f} s after the first point"


def _image_facts(records: list[Any]) -> dict[str, Any]:
    image: RawImage = records[0]
    if image.encoded is not None:
        return {"stored": {".jpg": "JPEG", ".png": "PNG"}[image.suffix]}
    assert image.pixels is not None
    height, width = image.pixels.shape[:2]
    color = "color" if image.pixels.ndim == 3 else "gray"
    return {"width": width, "height": height, "stored": f"{color}, {8 * image.pixels.itemsize} bits"}


def _pose_facts(records: list[Any]) -> dict[str, Any]:
    first = records[0]
    return {"poses_in_first": len(first.times)} if isinstance(first, PathSample) else {"child": first.child}


def _imu_facts(records: list[Any]) -> dict[str, Any]:
    samples: list[ImuSample] = records
    lengths = [float(np.linalg.norm(sample.accelerometer)) for sample in samples]
    length = float(np.median(lengths))
    unit = "g" if _GRAVITY_G[0] < length < _GRAVITY_G[1] else "m/s^2" if 5 < length < 20 else "not known"
    return {"acceleration": round(length, 2), "acceleration_unit": unit}


def _camera_facts(records: list[Any]) -> dict[str, Any]:
    camera = records[0].camera
    if camera is None:
        return {"camera": "its matrix is empty"}
    numbers = [round(each, 3) for each in (camera.fx, camera.fy, camera.cx, camera.cy)]
    return {
        "width": camera.width,
        "height": camera.height,
        "fx_fy_cx_cy": numbers,
        "lens": str(camera.lens),
        "distortion": list(camera.distortion),
    }


def _transform_facts(records: list[Any]) -> dict[str, Any]:
    pairs = sorted({(each.parent, each.child) for each in records})
    return {"transforms": [f"{parent} <- {child}" for parent, child in pairs]}


_CONTENTS = {
    Kind.SCANS: _scan_facts,
    Kind.IMAGES: _image_facts,
    Kind.POSES: _pose_facts,
    Kind.IMU: _imu_facts,
    Kind.GNSS: lambda records: {"status": records[0].status},
    Kind.CAMERA_INFO: _camera_facts,
    Kind.TRANSFORMS: _transform_facts,
}


_RECORDS: dict[Kind, tuple[type, ...]] = {
    Kind.SCANS: (RawScan,),
    Kind.IMAGES: (RawImage,),
    Kind.POSES: (PoseSample, PathSample, TransformSample),
    Kind.IMU: (ImuSample,),
    Kind.GNSS: (GnssFix,),
    Kind.CAMERA_INFO: (CameraInfo,),
    Kind.TRANSFORMS: (TransformSample,),
}
"""A bag may have a topic twice, with messages of another type."""


def _has_camera(image: str, facts: tuple[StreamFacts, ...]) -> bool:
    """Whether a camera info goes with a topic of images."""
    topics = [
        CameraTopic(each.stream.name, each.frame, each.camera) for each in facts if each.camera is not None
    ]
    frame = next((each.frame for each in facts if each.stream.name == image), "")
    return camera_topics.of_images(topics, image, frame) is not None


def _missing(source: Source, facts: tuple[StreamFacts, ...], choice: Choice) -> Iterator[str]:
    scans = [each for each in facts if each.stream.kind is Kind.SCANS and each.problem]
    why = f"{scans[0].stream.name}: {scans[0].problem}" if scans else "nothing can be imported"
    yield from _absent([each.stream for each in facts], choice, why)
    if not choice.image:
        return
    known = source.geometry()
    has_camera = known.camera is not None or _has_camera(choice.image, facts)
    if not has_camera:
        yield "no camera: give its intrinsics, --calibration FILE"
    if known.camera_from_lidar is None and not _connected(choice, facts):
        yield "where the camera is on the LiDAR is not said: give the extrinsic, --calibration FILE"


def _absent(streams: Iterable[Stream], choice: Choice, why: str = "nothing can be imported") -> Iterator[str]:
    """What no stream has. why: there are no scans"""
    if not choice.lidar:
        stream = packets.only(streams)
        if stream is not None:
            why = f"{packets.problem(stream)}: {packets.mend(stream.message_type)}"
        yield f"no scans: {why}"
    if not choice.odometry:
        yield "no poses: estimate them by the scans, --odometry auto, or give a trajectory (TUM), --odometry FILE"
    if not choice.image:
        yield "no images: poses and map are refined, and nothing is colored"


def _connected(choice: Choice, facts: tuple[StreamFacts, ...]) -> bool:
    """Whether static transforms lead from the frame of the images to that of the scans."""
    frames = {each.stream.name: each.frame for each in facts}
    start, goal = frames.get(choice.image, ""), frames.get(choice.lidar, "")
    pairs = {pair for each in facts for pair in each.transforms}
    reached, edge = {start}, {start}
    while edge:
        near = {b for a, b in pairs if a in edge} | {a for a, b in pairs if b in edge}
        edge = near - reached
        reached |= edge
    return bool(start and goal) and goal in reached


def _notes(
    description: SourceDescription, facts: tuple[StreamFacts, ...], choice: Choice, *, deskewed: bool
) -> Iterator[str]:
    yield from description.notes
    for kind, names in choice.others:
        yield f"several streams of {kind}: also {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
    by_name = {each.stream.name: each for each in facts}
    scans = by_name.get(choice.lidar)
    if scans is None:
        return
    if scans.facts.get("times") == "none" and not deskewed:
        yield f"{choice.lidar} has no times of points: motion while the LiDAR turns cannot be taken out by them"
    for name in (choice.image, choice.odometry, choice.imu):
        apart = _apart(scans, by_name.get(name))
        if apart > _APART_S:
            yield f"clocks of {name} and {choice.lidar} are {apart:.0f} s apart, by when the recorder got their stamps"


def _apart(one: StreamFacts, other: StreamFacts | None) -> float:
    """s between the clocks of two streams, as the recorder saw them; 0 where it is not known."""
    if other is None or None in (one.first_stamp, other.first_stamp, one.stream.first, other.stream.first):
        return 0.0
    late, later = ((each.stream.first or 0) - (each.first_stamp or 0) for each in (one, other))
    return abs(late - later) * 1e-9
