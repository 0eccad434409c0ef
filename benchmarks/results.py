"""Makes docs/results.md: every table in it comes from runs of the installed `lvba` command, none is typed by hand.

    python benchmarks/results.py recordings --data DIR       the real recordings, default settings
    python benchmarks/results.py foreign --data DIR          their poses, judged as those of any method
    python benchmarks/results.py simulated --seeds 101 102 103
    python benchmarks/results.py ablations --seeds 101
    python benchmarks/results.py disturbed --seeds 201 --scenes courtyard --levels typical severe
    python benchmarks/results.py degenerate                   bare plane and corridor
    python benchmarks/results.py colors                       colors of the map
    python benchmarks/results.py write                        docs/results.md from docs/results.json

Each command adds its rows to docs/results.json (one object per row, keyed by table and row) and rewrites docs/results.md.
`disturbed` does not make rows again that this version has made: stopped, it continues by the same command.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ablations import ABLATIONS

from lvba.simulate import disturbances
from lvba.steps import verdict_data

ROOT = Path(__file__).resolve().parent.parent
JSON = ROOT / "docs" / "results.json"
MARKDOWN = ROOT / "docs" / "results.md"
LVBA = [sys.executable, "-m", "service.cli"]

RECORDINGS = ("kitti360_suburb", "seven_scenes_kitchen", "balm_realworld", "tum_fr1_rpy")
SCENES = ("courtyard", "rooms", "street")
LIDARS = ("spinning", "non_repetitive")
COLORED = (
    *(("cabinet", lidar, 60) for lidar in LIDARS),
    *((scene, "spinning", 30) for scene in SCENES),
)
"""Scene, LiDAR and frames of the table of colors."""
SIDE_BY_SIDE = "parts side by side"


_PATH = re.compile(r"(?<!\S)/(?:[^\s/]+/)*([^\s/]+)")
"""An absolute path, of which the tables keep the name: where a recording lies is nobody's business."""


def run_lvba(dataset: Path, out: Path, options: list[str], reference: Path | None) -> dict[str, Any]:
    """The report of one run, with wall seconds and the command's peak memory added."""
    command = [*LVBA, "run", str(dataset), "--out", str(out)]
    for option in options:
        command += ["--set", option]
    if reference is not None:
        command += ["--reference", str(reference)]
    return report_of(command, out)


def run_ablation(name: str, dataset: Path, out: Path, options: list[str], reference: Path) -> dict[str, Any]:
    """As `run_lvba`, by the method with a part of it left out."""
    command = [sys.executable, "-m", "benchmarks.ablations", name, str(dataset), "--out", str(out)]
    for option in options:
        command += ["--set", option]
    return report_of([*command, "--reference", str(reference)], out)


def report_of(command: list[str], out: Path) -> dict[str, Any]:
    """The report in `out` of a command that writes one, with its wall seconds added; why there is none, if it failed."""
    started = time.monotonic()
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    seconds = time.monotonic() - started
    if done.returncode != 0:
        return {"failed": done.stderr.strip().splitlines()[-1] if done.stderr else f"exit {done.returncode}"}
    report = json.loads((out / "report.json").read_text())
    report["wall_seconds"] = seconds
    return report


def figures(report: dict[str, Any]) -> dict[str, Any]:
    """The row that goes into the tables."""
    if "failed" in report:
        return report
    evaluation = report.get("evaluation", {})
    row: dict[str, Any] = {
        "seconds": report["wall_seconds"],
        "peak_memory_mb": max(
            ((s.get("peak_memory_mb") or 0) for s in report.get("stages", [])), default=None
        ),
        "rough": evaluation.get("rough"),
        "refined": evaluation.get("refined"),
        "reference": report.get("reference"),
        "lidar_accepted": report.get("lidar", {}).get("accepted"),
        "visual_accepted": report.get("visual", {}).get("accepted"),
        "warnings": [_PATH.sub(r"\1", warning) for warning in report.get("warnings", [])],
    }
    return _without_arrays(row)


_LISTS = ("warnings", "reasons")


def _without_arrays(value: Any) -> Any:
    """Drops per-frame lists: tables hold scalars."""
    if isinstance(value, dict):
        return {
            k: _without_arrays(v) for k, v in value.items() if not (isinstance(v, list) and k not in _LISTS)
        }
    return value


def simulate(
    scene: str,
    out: Path,
    *,
    seed: int,
    lidar: str | None = None,
    difficulty: str = "medium",
    frames: int | None = None,
    extra: tuple[str, ...] = (),
) -> None:
    """A dataset with truth in its reference folder."""
    command = [
        *LVBA,
        "simulate",
        scene,
        "--out",
        str(out),
        "--seed",
        str(seed),
        "--difficulty",
        difficulty,
        *(["--lidar", lidar] if lidar else []),
        *extra,
    ]
    if frames:
        command += ["--frames", str(frames)]
    if not out.exists():
        subprocess.run(command, check=True, capture_output=True)


def save(table: str, row: str, values: dict[str, Any]) -> None:
    """Adds one row to docs/results.json and says so."""
    results = json.loads(JSON.read_text()) if JSON.exists() else {}
    results.setdefault(table, {})[row] = values
    JSON.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    sys.stdout.write(f"{table} / {row}: {values.get('failed', 'done')}\n")
    sys.stdout.flush()


def recordings(data: Path, work: Path) -> None:
    for name, dataset, reference in held(data, work):
        report = run_lvba(dataset, work / f"{name}_out", [], reference)
        save("recordings", name, figures(report))


def held(data: Path, work: Path) -> Iterator[tuple[str, Path, Path | None]]:
    """Name, folder and reference of each recording that a folder has, and of each with other rough poses, as `drawn`."""
    for recording in RECORDINGS:
        if not (data / recording).is_dir():  # its rows stay as they are
            continue
        reference = data / recording / "reference"
        for name, dataset in drawn(data / recording, work):
            yield name, dataset, reference if reference.exists() else None


def drawn(dataset: Path, work: Path) -> list[tuple[str, Path]]:
    """Name and folder of a recording, and of it with each other set of rough poses (`rough_*`) in place of its own."""
    recordings = [(dataset.name, dataset)]
    for rough in sorted(dataset.glob("rough_*")):
        folder = work / f"{dataset.name}_{rough.name}"
        for kind, poses in (("all_image", "image_poses.txt"), ("all_pcd_body", "lidar_poses.txt")):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            for frame in (dataset / kind).iterdir():
                link = folder / kind / frame.name
                if frame.suffix != ".txt" and not link.exists():
                    link.symlink_to(frame.resolve())
            (folder / kind / poses).write_text((rough / poses).read_text())
        (folder / "config.yaml").write_text((rough / "config.yaml").read_text())
        recordings.append((folder.name, folder))
    return recordings


def foreign(data: Path, work: Path) -> None:
    """Input, result and reference of each recording, each given to `lvba evaluate` as poses of another method, all with
    exposures and camera of the result, so that only poses differ.

    Results of `recordings` in `work` are taken where they are there.
    """
    for name, dataset, reference in held(data, work):
        result = work / f"{name}_out"
        if not (result / "report.json").exists():
            run_lvba(dataset, result, [], reference)
        sources = {"input": (dataset / "all_pcd_body", dataset / "all_image"), "result": (result, result)}
        if reference is not None:
            sources["reference"] = (reference, reference)
        for kind, (scans, images) in sources.items():
            poses = {
                "--lidar-poses": scans / "lidar_poses.txt",
                "--image-poses": images / "image_poses.txt",
                "--exposures": result / "exposures.csv",
                "--calibration": result / "calibration.yaml",
            }
            if poses["--lidar-poses"].exists():
                out = work / f"{name}_{kind}_judged"
                save("foreign", f"{name}: {kind}", judged(dataset, poses, out, reference))


def judged(dataset: Path, poses: dict[str, Path], out: Path, reference: Path | None) -> dict[str, Any]:
    """Figures of poses, and exposures, by `lvba evaluate`; poses: files by the option that they are given with."""
    options = [word for option, file in poses.items() if file.exists() for word in (option, str(file))]
    if reference is not None:
        options += ["--reference", str(reference)]
    return figures(report_of([*LVBA, "evaluate", str(dataset), "--out", str(out), *options], out))


def simulated(seeds: list[int], scenes: list[str], difficulty: str, work: Path) -> None:
    for seed in seeds:
        for scene in scenes:
            for lidar in LIDARS:
                name = f"{scene}, {lidar.replace('_', '-')}, seed {seed}"
                dataset = work / f"{scene}_{lidar}_{seed}_{difficulty}"
                simulate(scene, dataset, seed=seed, lidar=lidar, difficulty=difficulty)
                report = run_lvba(dataset, work / f"{dataset.name}_out", [], dataset / "reference")
                save(f"simulated, {difficulty}", name, figures(report))


def ablations(seeds: list[int], scenes: list[str], work: Path) -> None:
    for seed in seeds:
        for scene in scenes:
            dataset = work / f"{scene}_{seed}"
            simulate(scene, dataset, seed=seed)
            for name in ABLATIONS:
                if name == SIDE_BY_SIDE:  # of recordings in parts, see results_split
                    continue
                out = work / f"{scene}_{seed}_{name.replace(' ', '_').replace('/', '_')}"
                report = run_ablation(name, dataset, out, [], dataset / "reference")
                save("ablations", f"{scene}, seed {seed}: {name}", figures(report))


def disturbed(
    seeds: list[int], scenes: list[str], names: list[str], levels: list[str], frames: int, work: Path
) -> None:
    """Rows that this version has made already are kept."""
    version = code_version()
    known = json.loads(JSON.read_text()).get("disturbed", {}) if JSON.exists() else {}
    for seed in seeds:
        for scene in scenes:
            for name, size in _sizes(names, levels):
                row = f"{scene}, seed {seed}, {frames} frames: {name}" + (f" {size:g}" if size else "")
                if known.get(row, {}).get("version") != version:
                    made = _disturbed_row(scene, seed, frames, name, size, work)
                    save("disturbed", row, made | {"version": version})


def _sizes(names: list[str], levels: list[str]) -> list[tuple[str, float]]:
    """Each disturbance by its size at each level, once where levels are alike; first none."""
    sizes = [(name, float(disturbances.ABOUT[name]["levels"][level])) for name in names for level in levels]
    return [("none", 0.0), *dict.fromkeys(sizes)]


def _disturbed_row(scene: str, seed: int, frames: int, name: str, size: float, work: Path) -> dict[str, Any]:
    """Simulated, refined and compared with the truth; the files are removed."""
    dataset = work / f"{scene}_{seed}_{frames}_{name}_{size:g}"
    out = work / f"{dataset.name}_out"
    extra = ("--disturb", f"{name}={size:g}") if size else ()
    try:
        simulate(scene, dataset, seed=seed, frames=frames, extra=extra)
        report = run_lvba(dataset, out, [], dataset / "reference")
    finally:
        for folder in (dataset, out):
            shutil.rmtree(folder, ignore_errors=True)
    return errors(figures(report)) | without_truth(report)


def code_version() -> str:
    """The commit that rows are made by, with a plus where files of the program differ from it."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run(
        [*git, "rev-parse", "--short=8", "HEAD"], check=True, capture_output=True, text=True
    )
    changed = subprocess.run(
        [*git, "diff", "--quiet", "HEAD", "--", "lvba", "workers", "service"], check=False
    )
    return head.stdout.strip() + ("+" if changed.returncode else "")


def errors(row: dict[str, Any]) -> dict[str, Any]:
    """Of a row, what the table of disturbances shows."""
    kept = {name: row[name] for name in ("failed", "seconds", "peak_memory_mb") if name in row}
    reference = row.get("reference") or {}
    kept["reference"] = {
        part: {
            name: value
            for name, value in (reference.get(part) or {}).items()
            if isinstance(value, float | int) and not isinstance(value, bool)
        }
        for part in ("lidar", "camera", "exposure")
    }
    return kept


def without_truth(report: dict[str, Any]) -> dict[str, Any]:
    """The verdict as a user without a reference gets it: level, reasons, and whether expected errors are lower bounds."""
    if "failed" in report:
        return {}
    facts = verdict_data.add({**report, "reference": None})
    return {
        "verdict": facts["verdict"]["level"],
        "reasons": [each["text"] for each in facts["verdict"]["reasons"]],
        "at_least": facts["expected_error"]["at_least"],
    }


def degenerate(work: Path) -> None:
    for scene in ("plane", "corridor"):
        dataset = work / scene
        simulate(scene, dataset, seed=101)
        report = run_lvba(dataset, work / f"{scene}_out", [], dataset / "reference")
        row = figures(report)
        for part in ("lidar", "visual"):
            row[f"{part}_degenerate_directions"] = report.get(part, {}).get("degenerate_directions")
        save("degenerate directions", scene, row)


def colors(work: Path) -> None:
    """Beside what this version makes, a row keeps what the version before it made."""
    kept = json.loads(JSON.read_text())["colors"]
    for scene, lidar, frames in COLORED:
        dataset = work / f"{scene}_{lidar}_{frames}_colors"
        simulate(scene, dataset, seed=101, lidar=lidar, frames=frames)
        states = {"true poses": dataset / "reference"}
        if scene == "cabinet":
            states["refined poses"] = work / f"{dataset.name}_out"
            run_lvba(dataset, states["refined poses"], [], dataset / "reference")
        for kind, poses in states.items():
            name = f"{scene}, {lidar.replace('_', '-')}, {frames} frames, {kind}"
            save("colors", name, kept.get(name, {}) | {"after": _judged_colors(dataset, poses)})


def _judged_colors(dataset: Path, poses: Path) -> dict[str, Any]:
    """How true the colors of the map are at the poses of a folder, as benchmarks/colors.py says."""
    command = [sys.executable, str(Path(__file__).with_name("colors.py")), str(dataset), str(poses)]
    return dict(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "table",
        choices=[
            "recordings",
            "foreign",
            "simulated",
            "ablations",
            "disturbed",
            "degenerate",
            "colors",
            "write",
        ],
    )
    parser.add_argument("--data", type=Path, help="folder of the real recordings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--difficulty", default="medium")
    parser.add_argument("--levels", nargs="+", choices=["typical", "severe"], default=["typical"])
    parser.add_argument(
        "--names", nargs="+", choices=list(disturbances.ABOUT), default=list(disturbances.ABOUT),
        help="disturbances (default: all)",
    )  # fmt: skip
    parser.add_argument("--frames", type=int, default=60, help="images and scans of a disturbed scene")
    parser.add_argument(
        "--json", type=Path, help="file that rows go to and tables are made from (default: docs/results.json)"
    )
    parser.add_argument(
        "--work", type=Path, help="folder for datasets and results (default: a temporary one)"
    )
    arguments = parser.parse_args()
    global JSON, MARKDOWN
    if arguments.json is not None:
        JSON, MARKDOWN = arguments.json, arguments.json.with_suffix(".md")
    if arguments.table in ("recordings", "foreign") and arguments.data is None:
        parser.error("recordings need --data, the folder that holds them")
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        if arguments.table == "recordings":
            recordings(arguments.data, work)
        elif arguments.table == "foreign":
            foreign(arguments.data, work)
        elif arguments.table == "simulated":
            simulated(arguments.seeds, arguments.scenes, arguments.difficulty, work)
        elif arguments.table == "ablations":
            ablations(arguments.seeds, arguments.scenes, work)
        elif arguments.table == "disturbed":
            disturbed(
                arguments.seeds, arguments.scenes, arguments.names, arguments.levels, arguments.frames, work
            )
        elif arguments.table == "degenerate":
            degenerate(work)
        elif arguments.table == "colors":
            colors(work)
    from results_table import markdown

    MARKDOWN.write_text(markdown(json.loads(JSON.read_text())))


if __name__ == "__main__":
    main()
