"""Parts of a long recording: how they fit at their seams, and which places were revisited."""

from collections.abc import Mapping
from typing import Any

from lvba.products.renamed_facts import value
from lvba.products.report import formats
from lvba.products.report.html import details, table, text

LEAD = (
    "The recording was solved in overlapping parts, merged, and finished as one problem. Each row has "
    "the offset of two parts over the frames that both contain, before they were merged, and the thickness of walls "
    "across the seam, before and after, beside walls that only one of the parts saw."
)

_SEAMS = (
    "Parts",
    "Common scans",
    "Offset before merging",
    "Exposure",
    "Walls before",
    "Walls after",
    "Walls of one part",
)
_LOOPS = ("Parts of the loop", "Used", "Offset before merging", "Residual", "Reason")


def section(facts: Mapping[str, Any]) -> str:
    """Tables of seams, loops and joint rounds; nothing for an undivided recording."""
    merge = facts.get("merge")
    if not merge:
        return ""
    return (
        table(_SEAMS, [_seam(row) for row in merge["seams"]])
        + table(_LOOPS, [_loop(row) for row in merge["loops"]])
        + details("Joint rounds", _rounds(merge))
        + _counts(merge)
    )


def _names(row: Mapping[str, Any]) -> str:
    return f"{row['first'] + 1} and {row['second'] + 1}"


def _seam(row: Mapping[str, Any]) -> list[str]:
    return [
        _names(row),
        formats.count(row["scans"]),
        f"{formats.length(value(row, 'offset_before_m'))}, {formats.number(value(row, 'offset_before_deg'), 3, 'deg')}",
        formats.number(row.get("exposure_ratio"), 3, ""),
        *(formats.length(row.get(name)) for name in ("wall_rough_m", "wall_m", "wall_one_side_m")),
    ]


def _loop(row: Mapping[str, Any]) -> list[str]:
    return [
        _names(row),
        "yes" if row["used"] else "no",
        f"{formats.length(row['before_m'])}, {formats.number(row['before_deg'], 2, 'deg')}",
        f"{formats.length(row['after_m'])}, {formats.number(row['after_deg'], 3, 'deg')}",
        text(row["reason"]),
    ]


def _rounds(merge: Mapping[str, Any]) -> str:
    scans = [
        [
            f"scans {k + 1}",
            formats.count(row["planes"]),
            formats.number(row["cost"], 4, ""),
            formats.length(row["moved"]),
        ]
        for k, row in enumerate(merge["scan_rounds"])
    ]
    images = [
        [
            f"cameras {k + 1}",
            formats.count(row["points"]),
            formats.number(row["cost"], 4, ""),
            formats.length(row["moved_m"]),
        ]
        for k, row in enumerate(merge["image_rounds"])
    ]
    return table(["Round", "Planes or points", "Cost", "Largest motion"], [*scans, *images])


def _counts(merge: Mapping[str, Any]) -> str:
    poses = merge["poses"]
    return (
        f"<p>{len(merge['parts'])} parts; {poses['scans_accounted_for']} of {poses['scans']} scans and "
        f"{poses['images_accounted_for']} of {poses['images']} images are in the result, each from one part.</p>"
    )
