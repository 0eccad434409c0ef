"""Memory and time against the length of a recording that is solved in parts, and what a second worker brings.

Streets of 200, 400, 800 and 1600 scans and images, one every two meters, solved in parts of 40 by two worker processes of
one thread each: peak memory of the largest worker, what is said of it before the run, and seconds of work in all tasks
together. Images are small, scans thin, to be done in minutes; docs/images/length.svg shows the table. One length of one
scene alone, also of a compact site with loops everywhere: `bench_length.py --scene site --scans 1000`. Then a street of
160 scans of 30,000 points and images of 640 x 480 by two workers, by one with one thread, and in one process without
Dask: what tasks bring and cost.
Last, what a task costs that does nothing: store, scheduler and all.
"""

import argparse
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
PICTURE = ROOT / "docs" / "images" / "length.svg"
SHORTEST, PART, USUAL = 200, 40, 160
METERS = {"street": 2.0, "site": 1.0}
"""Of path, from one scan to the next."""
_THIN = ("--points", "6000", "--width", "320", "--height", "240")
_CUT = {"by": "count", "size": PART}
CUT = [text for name, value in _CUT.items() for text in ("--set", f"split.{name}={value}")]
"""Options of a run in parts."""
JOINT = ("lidar-merge", "lidar-start", "lidar-step", "lidar-joint", "lidar-gate", "visual-merge", "visual-exposures",
         "visual-step", "evaluate", "visual-gate", "evaluate-result", "merge-facts",
         "pictures", "facts", "survey")  # fmt: skip
"""Steps of which there is one for all parts; names with a number at their end aside."""


def run(lengths: tuple[int, ...] = (1, 2, 4, 8)) -> dict[str, Any]:
    """A row per length, and the figures of the other two questions."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for times in lengths:
            simulate(work / f"street{times}", "street", SHORTEST * times, _THIN)
        simulate(work / "usual", "street", USUAL, ())
        _run(work, f"street{lengths[0]}", "warm", [])  # kernels are compiled once
        rows = [
            _row(work / f"street{times}", _run(work, f"street{times}", "two", ["--workers", "2"]))
            for times in lengths
        ]
        two, one, alone = (
            _row(work / "usual", _run(work, "usual", name, options))
            for name, options in (
                ("two", ["--workers", "2"]),
                ("one", ["--workers", "1", "--threads", "1"]),
                ("alone", ["--threads", "1"]),
            )
        )
        per_task = _seconds_per_task(work)
    draw(rows)
    return {
        "name": "length",
        "usual_wall_seconds_without_dask": alone["wall s"],
        "usual_wall_seconds_of_one_worker": one["wall s"],
        "usual_wall_seconds_of_two_workers": two["wall s"],
        "faster_by_a_second_worker": one["wall s"] / two["wall s"],
        "faster_on_the_stages_of_parts": (one["wall s"] - one["joint s"]) / (two["wall s"] - two["joint s"]),
        "milliseconds_per_empty_task": 1e3 * per_task,
        "usual_processor_seconds_of_one_worker": one["processor s"],
        "usual_processor_seconds_of_two_workers": two["processor s"],
        "usual_tasks": two["tasks"],
        "usual_work_seconds_without_dask": alone["work s"],
        "rows": rows,
    }


def one(scene: str, scans: int, workers: int = 2) -> dict[str, Any]:
    """A row of one scene of so many thin scans and images."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        simulate(work / scene, scene, scans, _THIN)
        return _row(work / scene, _run(work, scene, "alone", ["--workers", str(workers)]))


def simulate(dataset: Path, scene: str, frames: int, sizes: tuple[str, ...]) -> None:
    """A recording of so many scans and images; sizes: options of `lvba simulate`."""
    _lvba(["simulate", scene, "--out", str(dataset), "--seed", "1", "--frames", str(frames), "--scans", str(frames),
           "--length", str(METERS[scene] * frames), *sizes])  # fmt: skip


def _run(work: Path, street: str, name: str, options: list[str]) -> dict[str, Any]:
    out = work / f"{street}-{name}"
    started, spent = time.perf_counter(), _processor_seconds()
    _lvba(["run", str(work / street), "--out", str(out), "--quiet", *CUT, *options])
    seconds, spent = time.perf_counter() - started, _processor_seconds() - spent
    return {**json.loads((out / "report.json").read_text()), "wall": seconds, "processor": spent}


def _said(dataset: Path) -> float:
    """Peak memory of the largest process as it is said before a run, MB."""
    from lvba.blocks import memory, split, survey
    from lvba.io.dataset import open_dataset
    from lvba.pipeline import Config

    config, opened = Config(), open_dataset(dataset)
    load = survey.load_of(opened)
    parts = split.parts(opened, split.SplitConfig(**_CUT), load)  # type: ignore[arg-type]
    return memory.peaks(opened, parts, load, config.visual.keyframes).largest / 1e6


def _processor_seconds() -> float:
    """Of all processes that were begun from here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _row(dataset: Path, report: dict[str, Any]) -> dict[str, Any]:
    stages = report["stages"]
    joint = [stage for stage in stages if _base(stage["name"]) in JOINT]
    return {
        "scans": report["dataset"]["scans"],
        "parts": len(report["merge"]["parts"]),
        "tasks": len(stages),
        "said MB": _said(dataset),
        "peak MB": max(stage["peak_memory_mb"] for stage in stages),
        "work s": sum(stage["seconds"] for stage in stages),
        "joint s": sum(stage["seconds"] for stage in joint),
        "processor s": report["processor"],
        "wall s": report["wall"],
    }


def _base(name: str) -> str:
    """A joint step's name without stage and round; others keep their part's number."""
    if name.startswith(("lidar-step-", "visual-step-")):
        return "-".join(name.split("-")[:2])
    return name


def _seconds_per_task(work: Path, tasks: int = 300) -> float:
    """Of tasks that return a text each, through store and scheduler, by one worker that is there already."""
    from lvba import plan
    from workers import cluster, connection, versions

    def seconds(count: int, scheduler: connection.Scheduler) -> float:
        empty = plan.Plan(versions.key_version())
        for number in range(count):
            empty.add(f"empty-{number}", plan.digest, number)
        started = time.perf_counter()
        cluster.run(empty, str(work / f"store{count}"), scheduler)
        return time.perf_counter() - started

    with connection.local(1, 1) as scheduler:
        first = seconds(10, scheduler)
        return (seconds(tasks, scheduler) - first) / (tasks - 10)


def draw(rows: list[dict[str, Any]]) -> None:
    """docs/images/length.svg: peak memory and work against the number of scans."""
    panels = [
        _panel(rows, "peak MB", "peak memory of a worker, MB", 0),
        _panel(rows, "work s", "work of all tasks, s", 330),
    ]
    PICTURE.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 240" font-family="sans-serif" font-size="12">'
        f'<rect width="660" height="240" fill="white"/>{"".join(panels)}</svg>\n'
    )


def _panel(rows: list[dict[str, Any]], name: str, title: str, left: int) -> str:
    high = 1.15 * max(row[name] for row in rows)
    last = rows[-1]["scans"]
    spots = [(left + 50 + 250 * row["scans"] / last, 200 - 160 * row[name] / high) for row in rows]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in spots)
    marks = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="#0b6e99"/>'
        f'<text x="{x:.1f}" y="{y - 8:.1f}" text-anchor="middle">{row[name]:,.0f}</text>'
        f'<text x="{x:.1f}" y="216" text-anchor="middle">{row["scans"]}</text>'
        for (x, y), row in zip(spots, rows, strict=True)
    )
    return (
        f'<text x="{left + 50}" y="20" font-weight="bold">{title}</text>'
        f'<path d="M{left + 50} 30V200H{left + 310}" fill="none" stroke="#888"/>'
        f'<polyline points="{line}" fill="none" stroke="#0b6e99" stroke-width="2"/>{marks}'
        f'<text x="{left + 180}" y="234" text-anchor="middle">scans (and images)</text>'
    )


def _lvba(arguments: list[str]) -> None:
    command = [sys.executable, "-m", "service.cli", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run(command, check=True, capture_output=True, env=environment, cwd=ROOT)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", choices=METERS, default="street")
    parser.add_argument("--scans", type=int, help="of this scene alone; default: the whole benchmark")
    given = parser.parse_args()
    print(json.dumps(run() if given.scans is None else one(given.scene, given.scans), indent=1))
