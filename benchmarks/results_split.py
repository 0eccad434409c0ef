"""Rows of docs/results.md about recordings in parts: against the undivided solution, and with loops.

    python benchmarks/results_split.py street --work DIR      400 m in five parts, and what each step brings
    python benchmarks/results_split.py loops --work DIR       ends that miss each other, and places that only look alike

Called by hand, as benchmarks/results.py; rows go to the same docs/results.json.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import results  # noqa: E402
import results_table  # noqa: E402

from lvba.io import tum  # noqa: E402
from lvba.trajectory import align, pose_error  # noqa: E402

CUT = ["split.by=count", "split.size=80"]
NO_ROUNDS = ["merge.coarse_rounds=0", "merge.scan_rounds=0", "merge.image_rounds=0"]
NOT_MERGED = "in 5 parts, side by side, not merged"
WAYS = {
    "undivided": ["split.by=none"],
    "in 5 parts": CUT,
    "in 5 parts, merged, without joint rounds": [*CUT, *NO_ROUNDS],
    NOT_MERGED: [*CUT, *NO_ROUNDS],
}
LOOPS = {
    "block, easy drift": ("block", "easy", ("--closing", "0", "0")),
    "block, ends miss each other by 1 m and 2 degrees": ("block", "medium", ("--closing", "1", "2")),
    "lanes that look alike": ("terrace", "medium", ()),
}


def street(work: Path) -> None:
    """All ways to solve one street, each against the truth and against the undivided solution."""
    dataset = work / "street400"
    results.simulate("street", dataset, seed=101, frames=400, extra=("--length", "400"))
    undivided = work / "undivided"
    for name, options in WAYS.items():
        # one folder for all in parts: what they share is made once
        out = undivided if name == "undivided" else work / "parts"
        truth = dataset / "reference"
        if name == NOT_MERGED:
            report = results.run_ablation(results.SIDE_BY_SIDE, dataset, out, options, truth)
        else:
            report = results.run_lvba(dataset, out, options, truth)
        row = results.figures(report)
        if name != "undivided" and "failed" not in row:
            row["undivided"] = differences(undivided, out)
            row["merge"] = of_merge(report)
        results.save("parts", f"street of 400 m: {name}", row)


def differences(undivided: Path, out: Path) -> dict[str, float]:
    """Largest differences of scans, cameras and exposures, after the scans have been aligned."""
    (scans, cameras), (here, there) = (
        [tum.read_trajectory(folder / name).world_from_sensor for name in ("lidar_poses.txt", "image_poses.txt")]
        for folder in (undivided, out)
    )  # fmt: skip
    aligned = align(here, scans)
    off, camera_off = pose_error(here, scans, aligned=aligned), pose_error(there, cameras, aligned=aligned)
    ratio = np.log(_exposures(out) / _exposures(undivided))
    return {
        "scans_max_m": off.ate_max_m,
        "scans_max_deg": off.rotation_max_deg,
        "cameras_max_m": camera_off.ate_max_m,
        "cameras_max_deg": camera_off.rotation_max_deg,
        "exposure_max_percent": float(100 * np.abs(ratio - ratio.mean()).max()),
    }


def _exposures(out: Path) -> np.ndarray:
    return np.loadtxt(out / "exposures.csv", delimiter=",", skiprows=1)[:, 1]


def of_merge(report: dict[str, Any]) -> dict[str, Any]:
    """What the report says about seams and loops, in few numbers."""
    merge = report["merge"]
    walls = [row["wall_m"] / row["wall_one_side_m"] for row in merge["seams"] if row.get("wall_m")]
    used = [row for row in merge["loops"] if row["used"]]
    return {
        "parts": len(merge["parts"]),
        "walls_over_one_side": float(np.mean(walls)) if walls else None,
        "loops_used": len(used),
        "loops_refused": len(merge["loops"]) - len(used),
    }


def loops(work: Path) -> None:
    """Loops that must be closed, and one that must not."""
    for name, (scene, difficulty, extra) in LOOPS.items():
        dataset = work / name.replace(" ", "_").replace(",", "")
        results.simulate(scene, dataset, seed=101, difficulty=difficulty, frames=160, extra=extra)
        out = dataset.with_name(f"{dataset.name}_out")
        options = ["split.by=count", "split.size=32"]
        report = results.run_lvba(dataset, out, options, dataset / "reference")
        row = results.figures(report)
        if "failed" not in row:
            row["merge"] = of_merge(report)
        results.save("loops", name, row)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", choices=["street", "loops"])
    parser.add_argument("--work", type=Path, required=True, help="folder for recordings and results")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    (street if arguments.table == "street" else loops)(arguments.work)
    results.MARKDOWN.write_text(results_table.markdown(json.loads(results.JSON.read_text())))


if __name__ == "__main__":
    main()
