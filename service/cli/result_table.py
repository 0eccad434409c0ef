"""The before/after table that ends a run."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lvba.products import part_verdicts

Row = tuple[str, Any, Any, str]

_EVALUATION = (
    ("PSNR, leave-one-out", "psnr_leave_one_out", "dB", 1.0),
    ("SSIM, leave-one-out", "ssim_leave_one_out", "", 1.0),
    ("PSNR, paper's protocol", "psnr", "dB", 1.0),
    ("SSIM, paper's protocol", "ssim", "", 1.0),
    ("map entropy", "map_entropy", "nats", 1.0),
)
_REFERENCE = (
    ("scans", "lidar", "ate_m", "mm", 1e3),
    ("scans, rotation", "lidar", "rotation_deg", "deg", 1.0),
    ("cameras in the map", "camera", "ate_m", "mm", 1e3),
    ("cameras, rotation", "camera", "rotation_deg", "deg", 1.0),
    ("exposures", "exposure", "rms_percent", "%", 1.0),
)


def rows(report: dict[str, Any]) -> list[Row]:
    """Name, value before, value after and unit of each figure that there is."""
    table: list[Row] = []
    reference = report.get("reference") or {}
    for title, part, name, unit, factor in _REFERENCE:
        after = reference.get(part) or {}
        before = (reference.get("rough") or {}).get(part) or {}
        table.append(
            (f"{title}, error", _times(before.get(name), factor), _times(after.get(name), factor), unit)
        )
    rough, refined = (report["evaluation"][state] for state in ("rough", "refined"))
    table += [(title, rough.get(name), refined.get(name), unit) for title, name, unit, _ in _EVALUATION]
    return [row for row in table if row[1] is not None and row[2] is not None]


def table(report: dict[str, Any]) -> str:
    """The rows as text."""
    lines = [f"{'':<28}{'before':>12}{'after':>12}"]
    lines += [
        f"{title:<28}{before:>12.4g}{after:>12.4g} {unit}" for title, before, after, unit in rows(report)
    ]
    return "\n".join(lines)


def show(report: dict[str, Any], out: Path, write: Callable[[str], Any] = sys.stdout.write) -> None:
    """Print the table, the verdict on the whole and on each part, and where the report is."""
    write(table(report) + "\n")
    if report.get("verdict"):
        write(f"{report['verdict']['level']}: {report['verdict']['summary']}\n")
    for part in part_verdicts.of_report(report):
        if part.tried or part.name == "scans" or part.name == "cameras":
            write(f"{part.name}: {part.reason}\n")
    page = out / "report.html"
    write(f"report: {page if page.exists() else out / 'report.json'}\n")


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
