"""`lvba inspect`: what is in a bag or folder, what is missing, and the command that imports it. Writes nothing."""

import argparse
import json
import shlex
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from lvba.sources.folders.recordings import RECORDING
from lvba.sources.inspection import Inspection, StreamFacts
from lvba.sources.inspection import inspect as look
from lvba.sources.opening import open_source
from lvba.sources.source import Source
from service.cli.progress import Display
from service.datasets import inspection_facts
from service.system.printable import printable

_FIRST = ("scans", "images", "poses", "imu", "gnss", "camera info", "transforms", "packets", "other")
_NANO = 1e-9
_USUAL_CLOCK = "time of day"
_LATE_S = 0.01
_MOST_TRANSFORMS = 20
_PARTS = {
    "points": "{} points",
    "rows": "{} rows",
    "without_return": "{:.1%} without a return",
    "width": "{} px wide",
    "height": "{} px high",
    "stored": "{}",
    "child": "of {}",
    "poses_in_first": "{} poses in the first",
    "acceleration": "acceleration {}",
    "acceleration_unit": "in {}",
    "status": "status {}",
    "camera": "{}",
    "fx_fy_cx_cy": "fx fy cx cy {}",
    "lens": "{}",
    "distortion": "{}",
}
"""Facts that are one after the other on a line, and how."""


def inspect(arguments: argparse.Namespace, display: Display) -> None:
    """Looks at the source, and writes what it found to stdout, as text or JSON."""
    path: Path = arguments.source
    display.stage("inspect", 0, 1)
    inspection = look(open_source(path))
    display.clear()
    if arguments.json:
        facts = {"path": str(path), **inspection_facts.facts(inspection), "next": next_line(path, inspection)}
        sys.stdout.write(json.dumps(facts, indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{printable(line)}\n" for line in _lines(path, inspection)))


def text_lines(path: Path, source: Source) -> list[str]:
    """What people are told of a source, but for the command that comes next."""
    lines = [printable(line) for line in _lines(path, look(source))]
    return [line for line in lines if line and not line.startswith("next:")]


def next_line(path: Path, inspection: Inspection) -> str:
    """The command that imports a source, or runs it where it needs no import; "" where it has no scans."""
    choice, missing = inspection.choice, inspection.missing
    if inspection.description.format == RECORDING:
        return f"lvba run {shlex.quote(str(path))} --out RESULT"
    if not choice.lidar:
        return ""
    words = ["lvba", "import", str(path), "--lidar", choice.lidar]
    if choice.image:
        words += ["--image", choice.image]
    words += ["--odometry", choice.odometry or "auto"]
    if choice.imu:
        words += ["--imu", choice.imu]
    if any("--calibration" in sentence for sentence in missing):
        words += ["--calibration", "FILE"]
    return " ".join(shlex.quote(word) for word in [*words, "--out", "RECORDING"])


def _lines(path: Path, inspection: Inspection) -> Iterator[str]:
    description = inspection.description
    yield f"{path}: {description.format}, {_size(description.size)}{_span(inspection)}"
    yield from (f"  note: {note}" for note in inspection.notes)
    rows = sorted(inspection.streams, key=lambda each: (_FIRST.index(each.stream.kind), each.stream.name))
    wide = max((len(each.stream.name) for each in rows), default=0)
    for each in rows:
        yield ""
        yield f"{each.stream.kind:12} {each.stream.name:{wide}}  {_counts(each)}  {each.stream.message_type}"
        yield from (f"             {line}" for line in _details(each))
    yield ""
    yield from (f"missing: {sentence}" for sentence in inspection.missing)
    if inspection.presets:
        names = " or ".join(f"--preset {name}" for name in inspection.presets)
        yield f"preset: its topics are those of a public data set; if it is of that, import it with {names}"
    if line := next_line(path, inspection):
        yield f"next:  {line}"


def _size(size: int) -> str:
    for unit, name in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if size >= unit:
            return f"{size / unit:.1f} {name}"
    return f"{size} bytes"


def _span(inspection: Inspection) -> str:
    """From when to when it was recorded."""
    firsts = [each.first for each in inspection.description.streams if each.first is not None]
    lasts = [each.last for each in inspection.description.streams if each.last is not None]
    if not firsts or not lasts:
        return ""
    try:
        begin = datetime.fromtimestamp(min(firsts) // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError, OSError):
        begin = f"{min(firsts) * _NANO:.1f} s"
    return f", {(max(lasts) - min(firsts)) * _NANO:.1f} s from {begin}"


def _counts(facts: StreamFacts) -> str:
    count = "?" if facts.stream.count is None else str(facts.stream.count)
    rate = f"{facts.rate:.1f} Hz" if facts.rate is not None else ""
    return f"{count:>8} {rate:>10}"


def _details(facts: StreamFacts) -> Iterator[str]:
    if facts.problem:
        yield f"cannot be read: {facts.problem}"
        return
    if facts.stream.fields:
        yield f"fields {', '.join(facts.stream.fields)}"
    about = facts.facts
    parts = [f"frame {facts.frame}"] if facts.frame else []
    parts += [
        form.format(about[name]) for name, form in _PARTS.items() if about.get(name) not in (None, "", [])
    ]
    if about.get("recorded_after_stamp_s", 0.0) >= _LATE_S:
        parts.append(f"recorded {about['recorded_after_stamp_s']:.3f} s after its stamp")
    if about.get("clock", _USUAL_CLOCK) != _USUAL_CLOCK:
        parts.append(f"stamps count {about['clock']}")
    if parts:
        yield ", ".join(parts)
    if "time_unit" in about:
        unit, sweep, stamp = about["time_unit"], about["sweep_s"], about["stamp_is"]
        times = f"{about['time_field']}, {unit} {about['times']}"
        yield f"times of points: {times}; a sweep takes {sweep:.3f} s; the stamp is {stamp}"
    elif "times" in about:
        yield f"times of points: {about['times']}"
    yield from (f"{transform}" for transform in about.get("transforms", [])[:_MOST_TRANSFORMS])
