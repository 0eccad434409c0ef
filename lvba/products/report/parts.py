"""What a recording that was solved in parts says about them: how parts fit, which places were seen again."""

from collections.abc import Mapping
from typing import Any

from lvba.products.report import words
from lvba.products.report.html import details, table, text

LEAD = (
    "The recording was solved in overlapping parts, merged, and finished as one problem. Each row says how two parts "
    "differed over the frames that both hold before they were merged, and how thick walls are across the seam now, "
    "beside walls that one side saw alone."
)


def section(facts: Mapping[str, Any]) -> str:
    """Tables of seams, loops and joint rounds; nothing for an undivided recording."""
    merge = facts.get("merge")
    if not merge:
        return ""
    return (
        table(["Parts", "Scans shared", "Jump", "Exposure", "Walls before", "Walls now", "One side"],
              [_seam(row) for row in merge["seams"]])
        + table(["Seen again", "Used", "Missed by", "Left", "Why"], [_loop(row) for row in merge["loops"]])
        + details("Joint rounds", _rounds(merge))
        + _accounted(merge)
    )  # fmt: skip


def _names(row: Mapping[str, Any]) -> str:
    return f"{row['first'] + 1} and {row['second'] + 1}"


def _seam(row: Mapping[str, Any]) -> list[str]:
    return [
        _names(row),
        words.count(row["scans"]),
        f"{words.length(row['jump_m'])}, {words.number(row['jump_deg'], 3, 'deg')}",
        words.number(row.get("exposure_ratio"), 3, ""),
        *(words.length(row.get(name)) for name in ("wall_rough_m", "wall_m", "wall_one_side_m")),
    ]


def _loop(row: Mapping[str, Any]) -> list[str]:
    return [
        _names(row),
        "yes" if row["used"] else "no",
        f"{words.length(row['before_m'])}, {words.number(row['before_deg'], 2, 'deg')}",
        f"{words.length(row['after_m'])}, {words.number(row['after_deg'], 3, 'deg')}",
        text(row["reason"]),
    ]


def _rounds(merge: Mapping[str, Any]) -> str:
    scans = [
        [
            f"scans {k + 1}",
            words.count(row["planes"]),
            words.number(row["cost"], 4, ""),
            words.length(row["moved"]),
        ]
        for k, row in enumerate(merge["scan_rounds"])
    ]
    images = [
        [
            f"cameras {k + 1}",
            words.count(row["points"]),
            words.number(row["cost"], 4, ""),
            words.length(row["moved_m"]),
        ]
        for k, row in enumerate(merge["image_rounds"])
    ]
    return table(["Round", "Planes or points", "Cost", "Furthest move"], [*scans, *images])


def _accounted(merge: Mapping[str, Any]) -> str:
    poses = merge["poses"]
    return (
        f"<p>{len(merge['parts'])} parts; {poses['scans_accounted_for']} of {poses['scans']} scans and "
        f"{poses['images_accounted_for']} of {poses['images']} images are in the result, each from one part.</p>"
    )
