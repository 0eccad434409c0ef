"""What a preset of a public data set says of a source: topics that it has, and what is likely of its clocks."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lvba.arrays import Pose
from lvba.sources import presets
from lvba.sources.importing.options import Guess, ImportOptions
from lvba.sources.presets import Preset
from lvba.sources.source import SourceDescription

_NAMES = {"lidar": "lidar", "image": "images", "imu": "imu", "gnss": "gnss"}
"""The field of `Preset`, by the name that options and recording.yaml have."""


@dataclass(frozen=True)
class DataSet:
    """What is known of a source by a preset; all empty: there is none.

    topics: by lidar, image, imu, gnss, those that options leave open and the source has
    calibration: where it is, for people; facts: for recording.yaml; warnings: one sentence each
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    guess: Guess = field(default_factory=Guess)
    calibration: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def of_source(description: SourceDescription, options: ImportOptions) -> DataSet:
    """What the preset that options name says of a source.

    Raises InputError: there is no such preset.
    """
    if not options.preset:
        return DataSet()
    preset, by = presets.read(options.preset), f"preset {options.preset}"
    there = presets.topics_there(preset, description)
    topics = {
        name: there[key][0]
        for name, key in _NAMES.items()
        if there.get(key) and not getattr(options, name, "")
    }
    sequence = _sequence(preset, description)
    guess = Guess(
        by, preset.stamp, preset.image_offsets_s.get(sequence), _imu_from_lidar(preset, topics, options)
    )
    facts = {
        "name": preset.name,
        "streams": topics,
        "stamp": preset.stamp,
        "sequence": sequence,
        "image_offset": guess.image_offset,
        "traps": list(preset.traps),
        "unchecked": list(preset.unchecked),
    }
    return DataSet(
        topics=topics,
        guess=guess,
        calibration=f"{by}: {preset.calibration}" if preset.calibration else "",
        facts={name: value for name, value in facts.items() if value not in ("", None)},
        warnings=tuple(_warnings(by, preset, bool(there), sequence)),
    )


def _imu_from_lidar(preset: Preset, topics: Mapping[str, str], options: ImportOptions) -> Pose | None:
    """(4, 4), IMU from LiDAR, where both are those that the preset knows."""
    lidar, imu = (getattr(options, name) or topics.get(name, "") for name in ("lidar", "imu"))
    if not preset.imu_from_lidar or lidar not in preset.lidar or imu not in preset.imu:
        return None
    return np.vstack([np.reshape(preset.imu_from_lidar, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _sequence(preset: Preset, description: SourceDescription) -> str:
    """The longest name of a sequence in the name of the source; "": none."""
    name = Path(description.path).name.lower()
    return max((each for each in preset.image_offsets_s if each.lower() in name), key=len, default="")


def _warnings(by: str, preset: Preset, has_topics: bool, sequence: str) -> list[str]:
    warnings = []
    if not has_topics and any(getattr(preset, key) for key in _NAMES.values()):
        warnings.append(f"{by}: the source has none of its topics: is it of {preset.title}?")
    if preset.image_offsets_s and not sequence:
        names = ", ".join(preset.image_offsets_s)
        warnings.append(
            f"{by}: stamps of images are off by another time in each sequence, and none of {names} is in the name of "
            "the source: the data decide"
        )
    return warnings
