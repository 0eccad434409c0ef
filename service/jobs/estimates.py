"""What a run will take, told before: from counts of the recording, set right by the runs that were finished here."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.db.tables import DONE, Dataset, Job

_HISTORY = 20
_PIXELS = 640 * 480
_IMPORT_S = 0.02
"""Of a scan or image of a bag."""
_IMAGE_BYTES = 2 * _PIXELS
"""Of an image as it lies in a recording."""
_CORES = 2
"""Of the machine on which the figures below were taken."""


@dataclass(frozen=True)
class Estimate:
    """Of one run."""

    seconds: float
    memory_bytes: int
    disk_bytes: int


def of_counts(facts: dict[str, Any], cores: int) -> Estimate:
    """From the numbers of scans, images, pixels and bytes alone."""
    images = facts["images"] * max(facts["width"] * facts["height"] / _PIXELS, 0.1)
    points_mb = facts["scan_bytes"] / 1e6
    work = 0.05 * facts["scans"] + 0.15 * images + 0.05 * points_mb
    memory = 500e6 + 3.5e6 * images + 8e6 * points_mb
    disk = 10e6 + 1e6 * facts["scans"] + 3e6 * images + 3e6 * points_mb
    if facts.get("format") is not None:
        work += _IMPORT_S * (facts["scans"] + facts["images"])
        disk += facts["scan_bytes"] + _IMAGE_BYTES * images
    return Estimate(round(6.0 + work * _CORES / max(cores, 1), 1), int(memory), int(disk))


def estimate(session: Session, dataset: Dataset, threads: int | None) -> dict[str, Any]:
    """As the API shows it, with where it comes from and warnings."""
    if dataset.facts is None:
        return {}
    plain = of_counts(dataset.facts, threads or os.cpu_count() or 1)
    ratios = _ratios(session)
    needed = int(plain.memory_bytes * ratios["memory"])
    fields: dict[str, Any] = {
        "seconds": round(plain.seconds * ratios["seconds"], 1),
        "memory_bytes": needed,
        "disk_bytes": int(plain.disk_bytes * ratios["disk"]),
        "basis": f"{ratios['runs']} runs on this server" if ratios["runs"] else "counts of scans and images",
        "warnings": [],
        "plain": {
            "seconds": plain.seconds,
            "memory_bytes": plain.memory_bytes,
            "disk_bytes": plain.disk_bytes,
        },
    }
    memory = memory_bytes()
    if memory and needed > memory:
        fields["warnings"].append(
            f"about {needed / 1e9:.1f} GB of memory are needed, this machine has {memory / 1e9:.1f} GB"
        )
    return fields


def memory_bytes() -> int:
    """Of this machine; 0: not known."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return 0


def _ratios(session: Session) -> dict[str, float]:
    """Medians of what runs took to what was estimated from their counts."""
    wanted = select(Job).where(Job.state == DONE).order_by(Job.updated.desc()).limit(_HISTORY)
    jobs = [job for job in session.scalars(wanted) if job.estimate.get("plain") and job.stages]
    seconds, memory, disk = [], [], []
    for job in jobs:
        plain = job.estimate["plain"]
        seconds.append(sum(stage["seconds"] or 0.0 for stage in job.stages) / plain["seconds"])
        peak = max(stage["peak_memory_mb"] or 0.0 for stage in job.stages) * 1e6
        memory.append(peak / plain["memory_bytes"])
        disk.append(job.bytes / plain["disk_bytes"])
    return {
        "runs": len(jobs),
        "seconds": _median(seconds),
        # of what must not run out, rather too much than too little
        "memory": max([1.0, *memory]) if memory else 1.0,
        "disk": max([1.0, *disk]) if disk else 1.0,
    }


def _median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2] if values else 1.0
