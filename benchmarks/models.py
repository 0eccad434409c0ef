"""What each model of what sensors do brings, and what it costs: runs with all models and without one, into results.json.

    python benchmarks/models.py gain --seeds 101 --scenes courtyard rooms     with the disturbance that it is a model of
    python benchmarks/models.py cost --seeds 101 --scenes courtyard rooms     of a clean scene, with all and without any
    python benchmarks/results.py write                                        docs/results.md from docs/results.json

Runs with and without take turns, so that a busy machine slows down both.
"""

import argparse
import resource
import shutil
import tempfile
from pathlib import Path
from typing import Any

import results
from ablations import MODELS

from lvba.simulate import disturbances

DISTURBED = {
    "camera": ("focal", "principal_point", "k1", "rolling_shutter"),
    "vignetting and response": ("vignetting", "response"),
    "white balance": ("white_balance",),
    "extrinsic": ("extrinsic",),
    "time offset": ("time_offset",),
    "errors of scans": ("intensity_bias", "incidence_bias", "motion_left"),
}
"""Disturbances of typical size that each model is of."""
ALL = "all of these"
TABLE = "models"


def gain(scene: str, seed: int, frames: int, work: Path) -> None:
    """One row for each model: the scene disturbed by what it is a model of, with and without it; then all at once."""
    for model in MODELS:
        of = [name for names in DISTURBED.values() for name in names] if model == ALL else DISTURBED[model]
        dataset = work / f"{scene}_{seed}_{model.replace(' ', '_')}"
        levels = {name: disturbances.ABOUT[name]["levels"]["typical"] for name in of}
        extra = tuple(
            word for name, size in levels.items() for word in ("--disturb", f"{name}={float(size):g}")
        )
        results.simulate(scene, dataset, seed=seed, frames=frames, extra=extra)
        row = {kind: _run(kind, model, dataset, work) for kind in ("with", "without")}
        row["disturbances"] = [f"{name} {float(size):g}" for name, size in levels.items()]
        results.save(TABLE, f"{scene}, seed {seed}, {frames} frames: {model}", row)
        shutil.rmtree(dataset)


def cost(scene: str, seed: int, frames: int, repeats: int, work: Path) -> None:
    """One row: a clean scene with all models and without any, in turns; the least seconds of each."""
    dataset = work / f"{scene}_{seed}_clean"
    results.simulate(scene, dataset, seed=seed, frames=frames)
    runs: dict[str, list[dict[str, Any]]] = {"with": [], "without": []}
    for _ in range(repeats):
        for kind, made in runs.items():
            made.append(_run(kind, ALL, dataset, work))
    row: dict[str, Any] = {kind: dict(made[-1]) for kind, made in runs.items()}
    for kind, made in runs.items():
        for seconds in ("seconds", "processor_seconds"):
            row[kind][seconds] = min(each[seconds] for each in made)
    row["disturbances"] = []
    results.save(TABLE, f"{scene}, seed {seed}, {frames} frames: {ALL}, nothing disturbed", row)
    shutil.rmtree(dataset)


def _run(kind: str, model: str, dataset: Path, work: Path) -> dict[str, Any]:
    """Errors, verdict and seconds of one run with all models, or without one. kind: with, without"""
    out = work / "result"
    shutil.rmtree(out, ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    name = "full" if kind == "with" else model
    report = results.run_ablation(name, dataset, out, [], dataset / "reference")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    row = results.errors(results.figures(report)) | results.without_truth(report)
    row["processor_seconds"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    shutil.rmtree(out, ignore_errors=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["gain", "cost"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--scenes", nargs="+", default=["courtyard", "rooms"])
    parser.add_argument("--frames", type=int, default=40, help="images and scans of a scene")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each kind for the cost")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for seed in given.seeds:
            for scene in given.scenes:
                if given.what == "gain":
                    gain(scene, seed, given.frames, Path(folder))
                else:
                    cost(scene, seed, given.frames, given.repeats, Path(folder))


if __name__ == "__main__":
    main()
