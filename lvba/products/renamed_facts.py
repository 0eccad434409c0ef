"""Keys of report.json that had other names before version 0.3, or in its development: results of then are still read."""

from collections.abc import Mapping
from typing import Any

BEFORE = {
    "degenerate_directions": ("weak_directions",),
    "degenerate_scans": ("weak_scans",),
    "fraction": ("part",),
    "interpolation_error_scale": ("between",),
    "odometry_dependence": ("loose",),
    "offset_before_deg": ("jump_deg",),
    "offset_before_m": ("jump_m",),
    "uncertain_exposures": ("vague_exposures",),
    "unconfirmed_after": ("untied_after",),
    "unconnected_ends": ("loose_ends",),
    "variance_factor": ("inflation", "disagreement"),
}
"""Each with the names that it had: of pixels, and of scans beside cameras."""


def value(facts: Mapping[str, Any], name: str) -> Any:
    """A fact of that name, or of one that it had; None where there is none."""
    return next((facts[known] for known in (name, *BEFORE[name]) if known in facts), None)
