"""LiDAR bundle adjustment: from files to poses on a recording, as BALM2 does it and as we do, and on a simulated scene.

    python benchmarks/bench_lidar.py --recording shared/data/balm_realworld [--scene DATASET]

The recording: a folder with all_pcd_body/*.pcd and oracle/poses_initial.txt, or any dataset folder.
"""

import argparse
import json
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry, trajectory
from lvba.io.pcd import read_pcd
from lvba.lidar import voxel_map
from lvba.lidar.bundle_adjustment import balm2, refine
from lvba.lidar.normal_equations import Problem, linearize
from lvba.lidar.plane_feature import PlaneFeatures, fit
from lvba.lidar.scan import gather
from lvba.lidar.solver import solve


def read_poses(path: Path) -> np.ndarray:
    """(S, 4, 4) of a TUM file."""
    table = np.loadtxt(path)
    return geometry.from_quaternion_translation(table[:, 4:8], table[:, 1:4])


def best(function: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Fewest seconds of some runs (others use the machine too), and the last result."""
    seconds, result = [], None
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result


def features_of(scans: Any, poses: np.ndarray) -> PlaneFeatures:
    """BALM2's planes at some poses."""
    grid = voxel_map.build(scans, poses, balm2().stages[0].sizes)
    return voxel_map.find_planes(grid, poses, np.zeros(3), balm2().stages[0].plane_test).features


def as_balm2(folder: Path, repeats: int = 5) -> dict[str, float]:
    """BALM2's own association, once, at 2 m: its cost, and the time of each part."""
    paths = sorted((folder / "all_pcd_body").glob("*.pcd"))
    rough = read_poses(folder / "oracle" / "poses_initial.txt")

    def load() -> Any:
        return gather([read_pcd(path).points for path in paths])

    def loop(features: PlaneFeatures) -> Any:
        problem = Problem(features, 1.0, None)
        return solve(problem, rough, np.full(6, 1.0), steps=10, exact=True, tolerance=1e-6)

    features = features_of(load(), rough)  # compiles
    found = loop(features)
    load_s, scans = best(load, repeats)
    associate_s, features = best(lambda: features_of(scans, rough), repeats)
    loop_s, found = best(lambda: loop(features), repeats)
    problem = Problem(features, 1.0, None)
    hessian_s, _ = best(lambda: linearize(problem, rough), repeats)
    total_s, _ = best(lambda: loop(features_of(load(), rough)), repeats)
    return {
        "load_s": load_s,
        "associate_s": associate_s,
        "hessian_s": hessian_s,
        "loop_s": loop_s,
        "total_s": total_s,
        "steps": found.steps,
        "planes": len(features),
        "observations": len(features.scan),
        "cost_initial": fit(features, rough).cost,
        "cost_final": fit(features, found.world_from_scan).cost,
    }


def as_ours(folder: Path, repeats: int = 2) -> dict[str, float]:
    """The default method on the same files, and how its poses score on BALM2's own planes."""
    paths = sorted((folder / "all_pcd_body").glob("*.pcd"))
    rough = read_poses(folder / "oracle" / "poses_initial.txt")

    def run() -> Any:
        return refine([read_pcd(path).points for path in paths], rough)

    run()
    seconds, result = best(run, repeats)
    scans = gather([read_pcd(path).points for path in paths])
    anew = features_of(scans, result.world_from_scan)
    points = float(anew.clusters.count.sum())
    return {
        "total_s": seconds,
        "rounds": len(result.history),
        "cost_on_balm2_planes_of_rough": fit(features_of(scans, rough), result.world_from_scan).cost,
        "cost_on_balm2_planes_of_refined": fit(anew, result.world_from_scan).cost,
        "rms_on_balm2_planes_of_refined_mm": 1e3
        * float(np.sqrt(fit(anew, result.world_from_scan).cost / points)),
        "points_in_balm2_planes_of_refined": points,
    }


def on_scene(folder: Path, repeats: int = 2) -> dict[str, float]:
    """The default method on a simulated dataset with its truth in reference/."""
    from lvba.io.dataset import open_dataset

    dataset = open_dataset(folder)
    scans = [read_pcd(Path(dataset.root) / path).points for path in dataset.scan_paths]
    truth = read_poses(folder / "reference" / "lidar_poses.txt")
    truth[:, :3, 3] -= dataset.origin
    rough = dataset.scans.world_from_sensor

    def run() -> Any:
        return refine(scans, rough, sensor_position=dataset.sensor_position_scan)

    run()
    seconds, result = best(run, repeats)
    error = trajectory.pose_error(result.world_from_scan, truth)
    return {
        "total_s": seconds,
        "rounds": len(result.history),
        "ate_mm": 1e3 * error.ate_m,
        "rotation_deg": error.rotation_deg,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def figures(recording: Path | None = None, scene: Path | None = None) -> dict[str, dict[str, float]]:
    """All figures that the given data allow."""
    found: dict[str, dict[str, float]] = {}
    if scene is not None:
        found["lidar_scene"] = on_scene(scene)
    if recording is not None:
        found["lidar_as_balm2"] = as_balm2(recording)
        found["lidar"] = as_ours(recording)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--scene", type=Path)
    options = parser.parse_args()
    print(json.dumps(figures(options.recording, options.scene), indent=2))
