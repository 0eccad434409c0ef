"""What is known of public data sets: topics, what stamps mean, where the calibration is, and traps."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files, yaml_files
from lvba.sources.source import Kind, SourceDescription

_FOLDER = Path(__file__).parent
_MEANINGS = ("begin", "middle", "end", "")
_KINDS = {"lidar": Kind.SCANS, "images": Kind.IMAGES, "imu": Kind.IMU, "gnss": Kind.GNSS}


@dataclass(frozen=True)
class Preset:
    """A data set. Topics are those it may have, the first of them first; none: not known here.

    origin: where the facts are from; stamp: what the LiDAR's stamp is of: begin, middle or end of a sweep, "": not known
    time_field, time_unit: of the points; camera, calibration: for people
    imu_from_lidar: 12 numbers, m, row by row (3, 4); none: not known, or another one in each sequence
    image_offsets_s: what to add to image stamps, s, by the name of a sequence
    traps: what goes wrong easily; unchecked: what was not seen in a recording
    """

    name: str
    title: str
    origin: str
    lidar: tuple[str, ...] = ()
    images: tuple[str, ...] = ()
    imu: tuple[str, ...] = ()
    gnss: tuple[str, ...] = ()
    stamp: str = ""
    time_field: str = ""
    time_unit: str = ""
    camera: str = ""
    calibration: str = ""
    imu_from_lidar: tuple[float, ...] = ()
    image_offsets_s: Mapping[str, float] = field(default_factory=dict)
    traps: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()


def names() -> tuple[str, ...]:
    """All presets, sorted."""
    return tuple(sorted(Path(name).stem for name in files.names_in(_FOLDER) if name.endswith(".yaml")))


def read(name: str) -> Preset:
    """The preset of this name.

    Raises: InputError: there is none.
    """
    if not re.fullmatch(r"[a-z0-9-]+", name) or name not in names():
        raise InputError(
            f"preset {name[:40]!r}", "there is none of this name", f"choose one of {', '.join(names())}"
        )
    path = _FOLDER / f"{name}.yaml"
    values = yaml_files.read_yaml(path)
    lists = {key: tuple(value) for key, value in values.items() if isinstance(value, list)}
    preset = Preset(name=name, **{**values, **lists})
    if preset.stamp not in _MEANINGS:
        raise InputError(path, f"stamp is {preset.stamp!r}", "write begin, middle or end")
    return preset


def topics_there(preset: Preset, description: SourceDescription) -> dict[str, tuple[str, ...]]:
    """Topics of a preset that a source has, in its order, by lidar, images, imu, gnss; kinds without any are left out."""
    there = {(stream.kind, stream.name) for stream in description.streams if stream.count != 0}
    topics = {
        field: tuple(topic for topic in getattr(preset, field) if (kind, topic) in there)
        for field, kind in _KINDS.items()
    }
    return {field: names for field, names in topics.items() if names}


def fitting(description: SourceDescription) -> tuple[Preset, ...]:
    """Presets that a source may be of: it has a topic of each kind that they name."""
    fits = []
    for preset in map(read, names()):
        named = {field for field in _KINDS if getattr(preset, field)}
        if named and named == set(topics_there(preset, description)):
            fits.append(preset)
    return tuple(fits)
