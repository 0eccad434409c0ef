"""What real sensors do and a clean simulation does not, one named number each; none by default.

Each is exact in the simulated data: beams are cast and pixels are rendered from where the sensor truly was, and only what
the recording says of itself (calibration, stamps, deskewing, rough poses) is wrong.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from lvba.errors import InputError


def _disturbance(meaning: str, unit: str, typical: float, severe: float, largest: float) -> Any:
    levels = {"typical": typical, "severe": severe}
    return field(
        default=0.0, metadata={"meaning": meaning, "unit": unit, "levels": levels, "largest": largest}
    )


@dataclass(frozen=True)
class Disturbances:
    """The size of each; 0: not there. Negative values turn the direction where there is one."""

    focal: float = _disturbance(
        "focal lengths of the calibration are too long by this fraction", "", 0.003, 0.01, 0.2
    )
    principal_point: float = _disturbance(
        "the principal point of the calibration is off by this much", "px", 2.0, 8.0, 50.0
    )
    k1: float = _disturbance("k1 of the calibration is too large by this much", "", 0.005, 0.03, 0.2)
    extrinsic: float = _disturbance(
        "the camera's extrinsic is turned by this much, and moved by 1 cm for every 0.6 degrees",
        "deg",
        1.0,
        3.0,
        30.0,
    )
    rolling_shutter: float = _disturbance(
        "time from the first to the last row of an image, stamped in the middle", "s", 0.015, 0.03, 0.1
    )
    vignetting: float = _disturbance("fraction of the light missing in the corners", "", 0.35, 0.6, 0.9)
    response: float = _disturbance(
        "grey values are the light to the power of one over this; 1 is linear", "", 1.5, 2.2, 4.0
    )
    srgb: float = _disturbance("grey values pass this much of the sRGB curve", "", 1.0, 1.0, 1.0)
    filmic: float = _disturbance(
        "grey values pass this much of a filmic curve, with a toe and a shoulder", "", 0.5, 1.0, 1.0
    )
    white_balance: float = _disturbance(
        "colors drift apart and back by this fraction of their brightness", "", 0.05, 0.2, 0.5
    )
    auto_exposure: float = _disturbance(
        "exposures follow the brightness of the scene: 1 holds the mean, 0.5 does half of it",
        "",
        0.7,
        1.0,
        1.0,
    )
    highlights: float = _disturbance(
        "radiance of specular highlights, which move with the view, on a third of the surfaces",
        "",
        0.1,
        0.5,
        5.0,
    )
    people: float = _disturbance("boxes of a person's size that walk near the path", "", 3, 10, 100)
    range_noise: float = _disturbance("standard deviation that ranges have more", "m", 0.02, 0.05, 1.0)
    range_scale: float = _disturbance("ranges are too long by this fraction", "", 0.0005, 0.002, 0.1)
    intensity_bias: float = _disturbance(
        "a black surface is measured nearer than a white one by this much", "m", 0.01, 0.03, 0.5
    )
    incidence_bias: float = _disturbance(
        "a surface is measured farther at grazing incidence by this much", "m", 0.01, 0.03, 0.5
    )
    elevation_bias: float = _disturbance(
        "beams go this much higher than the sensor says", "deg", 0.1, 0.3, 5.0
    )
    depth_distortion: float = _disturbance(
        "ranges are too long by this fraction where the beam is 45 degrees off the axis", "", 0.01, 0.03, 0.3
    )
    motion_left: float = _disturbance(
        "fraction of the motion during a scan of 0.1 s that deskewing left in it; points get times",
        "",
        0.1,
        0.5,
        1.0,
    )
    depth_readout: float = _disturbance(
        "time from the first to the last row of a depth camera's scan, stamped in the middle; points get no times",
        "s",
        0.015,
        0.03,
        0.1,
    )
    foliage: float = _disturbance(
        "mean depth to which beams go into half of the surfaces, as into leaves", "m", 0.05, 0.2, 2.0
    )
    mirrors: float = _disturbance(
        "fraction of the surfaces that beams are reflected by: what they meet appears behind",
        "",
        0.03,
        0.1,
        0.5,
    )
    rain: float = _disturbance("fraction of the beams that come back from a drop", "", 0.01, 0.05, 0.5)
    time_offset: float = _disturbance("images are stamped this much too early", "s", 0.02, 0.1, 1.0)
    clock_drift: float = _disturbance(
        "image stamps run ahead of scan stamps by this much at the end, from none at the beginning", "s",
        0.01, 0.05, 1.0,
    )  # fmt: skip
    stamp_jitter: float = _disturbance("standard deviation of the image stamps", "s", 0.002, 0.01, 0.1)
    gap: float = _disturbance("the LiDAR records nothing for this long in the middle", "s", 0.5, 1.5, 20.0)
    jumps: float = _disturbance("the rough poses jump this often by 1 m and 2 degrees", "", 1, 3, 20)
    rough_drift: float = _disturbance(
        "root mean square error of the rough poses, which grows smoothly; 6 degrees more for each meter",
        "m", 0.3, 1.0, 10.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name, about in ABOUT.items():
            value = getattr(self, name)
            largest = about["largest"]
            if not (math.isfinite(value) and abs(value) <= largest):
                raise InputError(f"--disturb {name}", f"{value} is out of range", f"take 0 to {largest:g}")
            if value < 0 and name not in _SIGNED:
                raise InputError(f"--disturb {name}", f"{value} is negative", f"take 0 to {largest:g}")
        if self.response and self.response < 1:
            raise InputError("--disturb response", f"{self.response} is below 1", "take 1 to 4")

    @property
    def present(self) -> dict[str, float]:
        """Those that are there, by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value}

    @property
    def usual_lidar(self) -> str:
        """Of the sensors that have such errors: depth_camera for those of depth cameras, else spinning."""
        return "depth_camera" if self.depth_distortion or self.depth_readout else "spinning"


_SIGNED = {
    "focal", "principal_point", "k1", "rolling_shutter", "range_scale", "intensity_bias", "incidence_bias",
    "elevation_bias", "depth_distortion", "time_offset", "clock_drift",
}  # fmt: skip
ABOUT: dict[str, dict[str, Any]] = {
    each.name: dict(each.metadata) for each in dataclasses.fields(Disturbances)
}
"""Of each name: meaning, unit, levels (typical, severe) and the largest value."""
NONE = Disturbances()


def parse(texts: Iterable[str]) -> Disturbances:
    """From words NAME=VALUE, where VALUE is a number, typical or severe, and a dash may stand for an underscore.

    Raises InputError: an unknown name, twice the same, no number, out of range.
    """
    values: dict[str, float] = {}
    for text in texts:
        spelled, _, value = text.partition("=")
        name = spelled.strip().replace("-", "_")
        if name not in ABOUT:
            raise InputError(
                "--disturb", f"{spelled[:40]!r} is not known", f"take NAME=VALUE of {', '.join(ABOUT)}"
            )
        if name in values:
            raise InputError(f"--disturb {name}", "is given twice", "give it once")
        values[name] = _number(name, value.strip())
    return Disturbances(**values)


def _number(name: str, text: str) -> float:
    levels = ABOUT[name]["levels"]
    if text in levels:
        return float(levels[text])
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--disturb {name}", f"{text[:40]!r} is no number", "take a number, typical or severe"
        ) from None


def table() -> str:
    """Markdown: a row for each, with its levels."""
    rows = ["| name | what it does | typical | severe | unit |", "|---|---|---|---|---|"]
    for name, about in ABOUT.items():
        typical, severe = about["levels"].values()
        rows.append(f"| {name} | {about['meaning']} | {typical:g} | {severe:g} | {about['unit']} |")
    return "\n".join(rows) + "\n"
