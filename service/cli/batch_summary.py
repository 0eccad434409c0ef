"""How every recording of a batch went: JSON and CSV that are rewritten as it goes, and a table that ends it."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lvba.io import files
from service.cli import result_table

WAITING, RUNNING, DONE, FAILED = "waiting", "running", "done", "failed"


@dataclass
class Row:
    """One recording. Figures are those of the report, before and after; None where it has none."""

    name: str
    dataset: str
    state: str = WAITING
    seconds: float | None = None
    psnr_before: float | None = None
    psnr_after: float | None = None
    entropy_before: float | None = None
    entropy_after: float | None = None
    message: str = ""
    """Why it failed: the line that `lvba run` ended with."""


def take_report(row: Row, out: Path) -> None:
    """Fill in the figures of a finished run; seconds are those of the runs that made its stages."""
    report = json.loads(files.read_text(out / "report.json"))
    row.seconds = round(sum(stage["seconds"] for stage in report["stages"]), 1)
    figures = {title: (before, after) for title, before, after, _ in result_table.rows(report)}
    row.psnr_before, row.psnr_after = figures.get("PSNR, leave-one-out", (None, None))
    row.entropy_before, row.entropy_after = figures.get("map entropy", (None, None))


def write(folder: Path, rows: Sequence[Row]) -> None:
    """Write summary.json and summary.csv, each the old one or the whole new one."""
    records = [asdict(row) for row in rows]
    files.write_text(folder / "summary.json", json.dumps(records, indent=1) + "\n", durable=True)
    text = io.StringIO()
    table = csv.DictWriter(text, list(records[0]))
    table.writeheader()
    table.writerows(records)
    files.write_text(folder / "summary.csv", text.getvalue(), durable=True)


def table(rows: Sequence[Row]) -> str:
    """The rows as text."""
    width = max(len(row.name) for row in rows) + 2
    lines = [f"{'':<{width}}{'':<9}{'seconds':>8}  {'PSNR (dB)':>16}  {'map entropy':>16}"]
    for row in rows:
        start = f"{row.name:<{width}}{row.state:<9}"
        if row.state != DONE:
            lines.append(f"{start}{row.message}".rstrip())
            continue
        psnr, entropy = _pair(row.psnr_before, row.psnr_after), _pair(row.entropy_before, row.entropy_after)
        lines.append(f"{start}{row.seconds:>8}  {psnr:>16}  {entropy:>16}".rstrip())
    return "\n".join(lines)


def _pair(before: float | None, after: float | None) -> str:
    return "" if before is None or after is None else f"{before:.2f} -> {after:.2f}"
