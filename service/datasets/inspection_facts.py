"""What an inspection found, as JSON: the same for `lvba inspect --json`, the service and its page; and back."""

from typing import Any

from lvba.sources.inspection import Inspection, StreamFacts
from lvba.sources.source import Kind, SourceDescription, Stream


def facts(inspection: Inspection) -> dict[str, Any]:
    """What can be written as JSON; `choice`: streams that a map would likely be made from, "": there is none."""
    description, choice = inspection.description, inspection.choice
    return {
        "format": description.format,
        "size": description.size,
        "streams": [_stream(each) for each in inspection.streams],
        "notes": list(inspection.notes),
        "missing": list(inspection.missing),
        "presets": list(inspection.presets),
        "choice": {name: getattr(choice, name) for name in ("lidar", "image", "odometry", "imu")},
    }


def _stream(facts: StreamFacts) -> dict[str, Any]:
    stream = facts.stream
    return {
        "name": stream.name,
        "kind": str(stream.kind),
        "type": stream.message_type,
        "count": stream.count,
        "rate": facts.rate,
        "first": stream.first,
        "last": stream.last,
        "first_stamp": facts.first_stamp,
        "frame": facts.frame,
        "fields": list(stream.fields),
        "problem": facts.problem,
        **facts.facts,
    }


def description_of(values: dict[str, Any], path: str) -> SourceDescription:
    """What `facts` was made of, as far as streams are chosen by it. path: as errors name it"""
    streams = tuple(
        Stream(
            name=each["name"],
            kind=Kind(each["kind"]),
            message_type=each["type"],
            count=each["count"],
            first=each["first"],
            last=each["last"],
            fields=tuple(each["fields"]),
        )
        for each in values["streams"]
    )
    return SourceDescription(path, values["format"], values["size"], streams, tuple(values["notes"]))


def counts(inspection: Inspection) -> dict[str, Any]:
    """About what a recording made of it would have: scans, images, their size in pixels, duration_s, scan_bytes."""
    by_name = {each.stream.name: each for each in inspection.streams}
    scans, images = by_name.get(inspection.choice.lidar), by_name.get(inspection.choice.image)
    number = (scans.stream.count or 0) if scans else 0
    width, height = _size(inspection)
    firsts = [each.stream.first for each in inspection.streams if each.stream.first is not None]
    lasts = [each.stream.last for each in inspection.streams if each.stream.last is not None]
    return {
        "scans": number,
        "images": (images.stream.count or 0) if images else 0,
        "width": width,
        "height": height,
        "duration_s": (max(lasts) - min(firsts)) * 1e-9 if firsts and lasts else 0.0,
        "scan_bytes": number * int(scans.facts.get("points", 0) if scans else 0) * _POINT_BYTES,
    }


_POINT_BYTES = 20
"""Of a point in a recording: position, intensity and time."""


def _size(inspection: Inspection) -> tuple[int, int]:
    """Width and height of images, px, by the images or a camera info; (0, 0): not known."""
    infos = [each for each in inspection.streams if each.stream.kind is Kind.CAMERA_INFO]
    images = [each for each in inspection.streams if each.stream.name == inspection.choice.image]
    known = (each.facts for each in (*images, *infos) if each.facts.get("width"))
    return next(((int(each["width"]), int(each["height"])) for each in known), (0, 0))


def renamed(values: Any, old: str, new: str) -> Any:
    """The facts with a path in all of their texts replaced, so that folders of the server are not shown."""
    if isinstance(values, str):
        return values.replace(old, new)
    if isinstance(values, dict):
        return {name: renamed(each, old, new) for name, each in values.items()}
    return [renamed(each, old, new) for each in values] if isinstance(values, list) else values
