"""The verdicts of a report, part by part: nothing is accepted as a whole."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PartVerdict:
    """Whether the result holds what was found for one part.

    accepted: None where there was nothing to find
    tried: whether something was found that could be accepted
    """

    name: str
    accepted: bool | None
    reason: str
    tried: bool


_PARTS = (
    ("scans", "lidar", ""),
    ("cameras", "visual", ""),
    ("exposures", "visual", "exposures_"),
    ("scans refined with the cameras", "fusion", ""),
)


def of_report(report: Mapping[str, Any]) -> list[PartVerdict]:
    """The verdict on each part that a report tells of, in the order in which they were judged."""
    verdicts = []
    for name, section, prefix in _PARTS:
        facts = report.get(section) or {}
        if facts.get(f"{prefix}accepted") is not None:
            accepted = bool(facts[f"{prefix}accepted"])
            tried = accepted or bool(facts.get(f"{prefix}judged"))
            verdicts.append(PartVerdict(name, accepted, str(facts.get(f"{prefix}reason") or ""), tried))
    return verdicts
