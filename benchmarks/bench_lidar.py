"""LiDAR bundle adjustment from files to poses: as BALM2 does it and by the default method, on a recording and on a scene.

The recording is BALM2's own, 177 scans of which every fourth point is left, with its planes found once at 2 m; it is left
out where it is not at hand (LVBA_DATA names the folder of recordings). The scenes are simulated: 100 scans of 30,000
points. Each task runs in a process of its own, several times: the best run counts, so compile time does not. Processor
time beside time: where others use the machine too, it says what a quiet one would need.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ablations import balm2

from lvba import geometry, trajectory
from lvba.io.dataset import open_dataset
from lvba.io.pcd import read_pcd
from lvba.lidar import mixed_cells, rounds, surface, voxel_map
from lvba.lidar.bundle_adjustment import LidarResult, refine
from lvba.lidar.config import LidarConfig
from lvba.lidar.plane_feature import PlaneFeatures, fit
from lvba.lidar.problem import LidarSolution, Problem, solve
from lvba.lidar.scan import Scans, gather
from lvba.lidar.weights import observation_weights

ROOT = Path(__file__).resolve().parent.parent
RECORDING = Path(os.environ.get("LVBA_DATA", ROOT.parent / "shared" / "data")) / "balm_realworld"
COST = "cost on BALM2's planes (m²)"
"""Sum of squared distances to the planes that BALM2's test finds at the rough poses; its own result: 6,242.603."""


def run() -> dict[str, Any]:
    """Seconds, memory and outcome of each task."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scenes = [Path(folder) / name for name in ("courtyard", "staircase")]
        for scene in scenes:
            _python(["-m", "service.cli", "simulate", scene.name, "--out", str(scene), "--seed", "1"])
        places = [("balm2", RECORDING), ("recording", RECORDING), *(("scene", scene) for scene in scenes)]
        for name, place in places:
            if place.is_dir():
                rows.append(json.loads(_python([__file__, name, str(place)])))
    return {"name": "lidar", "threads": os.cpu_count(), "rows": rows}


def _python(arguments: list[str]) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout


def row(task: str, seconds: float, processor_s: float, **figures: Any) -> dict[str, Any]:
    """A line of the table."""
    seconds_of = ("read_s", "planes_s", "loop_s", "hessian_s", "surfaces_s", "mixed_cells_s")
    kinds = (*seconds_of, "steps", "planes", COST, "ate_mm")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    fields = {"task": task, "seconds": seconds, "processor_s": processor_s, "peak_memory_mb": peak}
    return {**fields, **{kind: figures.get(kind, "") for kind in kinds}}


def best(function: Callable[[], Any], repeats: int) -> tuple[float, float, Any]:
    """Fewest seconds and fewest seconds of processors of some runs after a first one, and the last result."""
    seconds, processor, result = [], [], None
    for _ in range(repeats + 1):
        start, spent = time.perf_counter(), time.process_time()
        result = function()
        seconds.append(time.perf_counter() - start)
        processor.append(time.process_time() - spent)
    return min(seconds[1:]), min(processor[1:]), result


def read_poses(path: Path) -> np.ndarray:
    """(S, 4, 4) of a TUM file."""
    table = np.loadtxt(path)
    return geometry.from_quaternion_translation(table[:, 4:8], table[:, 1:4])


def features_of(scans: Scans, poses: np.ndarray) -> PlaneFeatures:
    """BALM2's planes at some poses."""
    stage = balm2.stage()
    grid = voxel_map.build(scans, poses, stage.sizes)
    return voxel_map.find_planes(grid, poses, np.zeros(3), stage.plane_test).features


class Recording:
    """BALM2's recording."""

    def __init__(self, folder: Path) -> None:
        self.paths = sorted((folder / "all_pcd_body").glob("*.pcd"))
        self.rough = read_poses(folder / "oracle" / "poses_initial.txt")

    def read(self) -> list[np.ndarray]:
        """The points of every scan."""
        return [read_pcd(path).points for path in self.paths]


def as_balm2(folder: Path, repeats: int = 8) -> dict[str, Any]:
    """BALM2's method: planes once, then Newton's method to a relative change of 1e-6."""
    recording = Recording(folder)

    def loop(features: PlaneFeatures) -> LidarSolution:
        problem = Problem(features, 1.0, None)
        return solve(problem, recording.rough, np.ones(6), steps=10, exact=True, tolerance=1e-6)

    read_s, _, scans = best(lambda: gather(recording.read()), repeats)
    planes_s, _, features = best(lambda: features_of(scans, recording.rough), repeats)
    loop_s, _, solution = best(lambda: loop(features), repeats)
    hessian_s, _, _ = best(lambda: Problem(features, 1.0, None).linearize(recording.rough), repeats)
    total, processor_s, _ = best(
        lambda: loop(features_of(gather(recording.read()), recording.rough)), repeats
    )
    return row(
        "BALM2's method, its recording",
        total,
        processor_s,
        read_s=read_s,
        planes_s=planes_s,
        loop_s=loop_s,
        hessian_s=hessian_s,
        steps=solution.steps,
        planes=len(features),
        **{COST: fit(features, solution.world_from_scan).cost},
    )


def on_recording(folder: Path, repeats: int = 2) -> dict[str, Any]:
    """The default method on the same files, and the cost of its poses on BALM2's planes."""
    recording = Recording(folder)
    seconds, processor_s, result = best(lambda: refine(recording.read(), recording.rough), repeats)
    fields = row(
        "default method, BALM2's recording",
        seconds,
        processor_s,
        steps=result.iterations,
        planes=len(result.planes),
    )
    features = features_of(gather(recording.read()), recording.rough)
    return {**fields, COST: fit(features, result.world_from_scan).cost}


def on_scene(folder: Path, repeats: int = 3) -> dict[str, Any]:
    """The default method on a simulated recording with its truth in reference/."""
    dataset = open_dataset(folder)
    truth = read_poses(folder / "reference" / "lidar_poses.txt")
    truth[:, :3, 3] -= dataset.origin

    def run() -> LidarResult:
        scans = [read_pcd(Path(dataset.root) / path).points for path in dataset.scan_paths]
        return refine(scans, dataset.scans.world_from_sensor, sensor_position=dataset.sensor_position_scan)

    seconds, processor_s, result = best(run, repeats)
    ate = 1e3 * trajectory.pose_error(result.world_from_scan, truth).ate_m
    scans = gather([read_pcd(Path(dataset.root) / path).points for path in dataset.scan_paths])
    surfaces_s, _, _ = best(surfaces_of(scans, result.world_from_scan, dataset.sensor_position_scan), repeats)
    mixed_s, _, _ = best(mixed_of(scans, result.world_from_scan, dataset.sensor_position_scan), repeats)
    fields = row(
        f"default method, simulated {folder.name}",
        seconds,
        processor_s,
        surfaces_s=surfaces_s,
        mixed_cells_s=mixed_s,
        steps=result.iterations,
    )
    return {**fields, "planes": len(result.planes), "ate_mm": ate}


def surfaces_of(scans: Scans, poses: np.ndarray, sensor: np.ndarray) -> Callable[[], Any]:
    """What makes planes of all points near them from those of cells at some poses (S, 4, 4)."""
    stage = LidarConfig().stages[-1]
    grid = rounds.build_grid(scans, poses, stage)
    planes = rounds.planes_in(grid, poses, sensor, stage)
    weights = observation_weights(planes.features, poses)
    return lambda: surface.extract(scans, grid, planes, weights, poses, sensor)


def mixed_of(scans: Scans, poses: np.ndarray, sensor: np.ndarray) -> Callable[[], Any]:
    """What looks for planes in cells that hold several surfaces, at some poses (S, 4, 4)."""
    stage = LidarConfig().stages[-1]
    grid = rounds.build_grid(scans, poses, stage)
    planes = rounds.planes_in(grid, poses, sensor, stage)
    sigma = observation_weights(planes.features, poses).sigma
    return lambda: mixed_cells.find(grid, planes, scans, poses, sensor, sigma, stage.plane_test)


TASKS = {"balm2": as_balm2, "recording": on_recording, "scene": on_scene}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("folder", type=Path, help="a folder like BALM2's recording, or a simulated dataset")
    options = parser.parse_args()
    print(json.dumps(TASKS[options.task](options.folder)))
