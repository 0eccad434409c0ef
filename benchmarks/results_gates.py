"""Rows of docs/results.md about the gate: the judged gain of every part, all else equal, and what the truth says of it.

    python benchmarks/results_gates.py run --data DIR --work DIR [--frames 50] [--seeds 301]
    python benchmarks/results_gates.py add NAME=OUT ... [--uncertain M DEG]   rows of result folders that are there

Called by hand, as benchmarks/results.py; rows go to the same docs/results.json. What the truth says is from
`reference.judged` of report.json; within the uncertainty of the reference it says nothing.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import results
import results_table

Facts = dict[str, Any]

UNCERTAIN = {"tum_fr1_rpy": (0.007, 0.4), "seven_scenes_kitchen": (0.01, 0.4)}
"""Of the references of real recordings, m and degrees; see their README."""
SAME = 0.02
"""Errors that differ by less than this part are the same."""
_PARTS = (
    ("scans", "lidar", ""), ("exposures", "visual", "exposures_"), ("cameras", "visual", ""), ("fusion", "fusion", ""),
)  # fmt: skip


def rows(report: Facts, uncertain: tuple[float, float] = (0.0, 0.0)) -> dict[str, Facts]:
    """By part: the figures that decided, the verdict, errors before and after, and whether the verdict was right."""
    table = {}
    truths = (report.get("reference") or {}).get("judged") or {}
    for part, section, prefix in _PARTS:
        facts = report.get(section) or {}
        figures = facts.get(f"{prefix}judged")
        if not figures:
            continue
        accepted, truth = bool(facts[f"{prefix}accepted"]), truths.get(part)
        says = None if truth is None else what_truth_says(truth["before"], truth["after"], uncertain)
        table[part] = {
            "figures": {figure["name"]: figure for figure in figures},
            "accepted": accepted,
            "truth": truth,
            "truth_says": says,
            "verdict": verdict(accepted, says),
        }
    return table


def what_truth_says(before: Facts, after: Facts, uncertain: tuple[float, float]) -> str:
    """better, worse, both (position and rotation differ in this) or neither."""
    kinds = (("rms_percent", 0.0), ("ate_m", uncertain[0]), ("rotation_deg", uncertain[1]))
    changes = [
        (after[kind] - before[kind], max(least, SAME * before[kind]))
        for kind, least in kinds
        if kind in before
    ]
    better = any(-change > least for change, least in changes)
    worse = any(change > least for change, least in changes)
    return "both" if better and worse else "better" if better else "worse" if worse else "neither"


def verdict(accepted: bool, says: str | None) -> str:
    """What the truth makes of the gate's verdict."""
    if says not in ("better", "worse"):
        return "open"
    if accepted:
        return "right" if says == "better" else "WRONG"
    return "right" if says == "worse" else "gain refused"


def add(name: str, out: Path, uncertain: tuple[float, float]) -> None:
    report = json.loads((out / "report.json").read_text())
    for part, row in rows(report, uncertain).items():
        results.save("gates", f"{name}: {part}", row)


def run(arguments: argparse.Namespace) -> None:
    """The recordings, with all rough poses that come with them, and simulated scenes."""
    work = arguments.work
    for dataset in sorted(arguments.data.iterdir()):
        if (dataset / "config.yaml").exists():
            reference = dataset / "reference"
            given = UNCERTAIN.get(dataset.name, (0.0, 0.0))
            for name, folder in results.drawn(dataset, work):
                results.run_lvba(folder, work / f"{name}_out", [], reference if reference.exists() else None)
                add(name, work / f"{name}_out", given)
    for seed in arguments.seeds:
        for scene in results.SCENES:
            for lidar in results.LIDARS:
                folder = work / f"{scene}_{lidar}_{seed}_{arguments.frames}"
                results.simulate(scene, folder, seed=seed, lidar=lidar, frames=arguments.frames)
                results.run_lvba(folder, work / f"{folder.name}_out", [], folder / "reference")
                add(
                    f"{scene}, {lidar.replace('_', '-')}, seed {seed}",
                    work / f"{folder.name}_out",
                    (0.0, 0.0),
                )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    everything = commands.add_parser("run")
    everything.add_argument("--data", type=Path, required=True)
    everything.add_argument("--work", type=Path, required=True)
    everything.add_argument("--frames", type=int, default=50)
    everything.add_argument("--seeds", type=int, nargs="+", default=[301])
    there = commands.add_parser("add")
    there.add_argument("results", nargs="+", metavar="NAME=OUT")
    there.add_argument("--uncertain", type=float, nargs=2, default=(0.0, 0.0), metavar=("M", "DEG"))
    arguments = parser.parse_args()
    if arguments.command == "run":
        arguments.work.mkdir(parents=True, exist_ok=True)
        run(arguments)
    else:
        for each in arguments.results:
            name, _, out = each.rpartition("=")
            add(name, Path(out), tuple(arguments.uncertain))
    results.MARKDOWN.write_text(results_table.markdown(json.loads(results.JSON.read_text())))


if __name__ == "__main__":
    main()
