"""Speed and memory of `lvba run`, from files to report: 100 images of 640 x 480 and 100 scans of 30,000 points.

In processes of their own: the first with an empty cache of compiled kernels, the others with a full one; the difference
is compile time. The best of several runs counts. Processor time does not depend on what else the machine does: half of
it is what two cores of their own would take at least.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def run(scene: str = "courtyard", repeats: int = 3) -> dict[str, Any]:
    """Seconds and peak memory of each stage of the fastest run, and of the whole."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(work / "kernels"), "PYTHONPATH": str(ROOT)}
        _lvba(["simulate", scene, "--out", str(work / "recording"), "--seed", "1"], environment)
        runs = [_timed(work, number, environment) for number in range(repeats + 1)]
    first, *others = runs
    best = min(others, key=lambda other: other["seconds"])
    return {
        "name": "run",
        "threads": os.cpu_count(),
        "seconds": best["seconds"],
        "processor_seconds": min(other["processor_seconds"] for other in others),
        "peak_memory_mb": best["peak_memory_mb"],
        "compile_processor_seconds": first["processor_seconds"] - best["processor_seconds"],
        "rows": best["stages"],
    }


def _timed(work: Path, number: int, environment: dict[str, str]) -> dict[str, Any]:
    out = work / f"out{number}"
    started, used = time.perf_counter(), _processor_seconds()
    _lvba(["run", str(work / "recording"), "--out", str(out), "--quiet"], environment)
    seconds, used = time.perf_counter() - started, _processor_seconds() - used
    stages = json.loads((out / "report.json").read_text())["stages"]
    return {
        "seconds": seconds,
        "processor_seconds": used,
        "peak_memory_mb": max(stage["peak_memory_mb"] for stage in stages),
        "stages": [{name: stage[name] for name in ("name", "seconds", "peak_memory_mb")} for stage in stages],
    }


def _processor_seconds() -> float:
    """Of all processes that were started here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _lvba(arguments: list[str], environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "service.cli", *arguments]
    subprocess.run(command, check=True, capture_output=True, env=environment, cwd=ROOT)


if __name__ == "__main__":
    print(json.dumps(run(), indent=1))
