"""What an IMU adds: simulated recordings with truth, refined with imu.csv and without.

    python benchmarks/imu_factors.py [--scene rooms] [--lidar non_repetitive] [--seeds 3 4 5] [--out FOLDER]

Each seed adds a row to docs/results.json; `benchmarks/results.py write` makes the table of it, and says what is in it.
"""

import argparse
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import results

from lvba import result, trajectory
from lvba.io import dataset as recordings
from lvba.io import reference as references
from lvba.simulate import simulate


def make(folder: Path, scene: str, lidar: str, seed: int, frames: int) -> Path:
    """A recording of that name in the folder; what is there is not made again."""
    out = folder / f"{scene}-{lidar}-{seed}-{frames}"
    if not (out / "imu.csv").exists() and not (out / "imu.off").exists():
        simulate(scene, out, frames=frames, seed=seed, lidar=lidar, width=320, height=240, imu=True)
    return out


def errors(refined: result.Result, true: np.ndarray) -> np.ndarray:
    """(S,): m, of scan positions after the alignment that errors are counted after."""
    poses = refined.world_from_scan.copy()
    poses[:, :3, 3] += refined.dataset.origin
    moved = trajectory.align_for_errors(poses, true).reference_from_estimate @ poses
    return np.asarray(np.linalg.norm(moved[:, :3, 3] - true[:, :3, 3], axis=1))


def tilt(refined: result.Result, true: np.ndarray, down: np.ndarray) -> dict[str, float]:
    """Degrees: how far the direction of gravity is off in the frame of the true poses, and its standard deviation."""
    facts: dict[str, Any] = refined.report["lidar"].get("imu") or {}
    if not facts.get("used"):
        return {}
    turn = trajectory.align_for_errors(refined.world_from_scan, true).reference_from_estimate[:3, :3]
    sine = float(np.linalg.norm(np.cross(turn @ facts["down"], down)))
    return {"tilt_deg": math.degrees(math.asin(min(sine, 1.0))), "tilt_sigma_deg": facts["tilt_sigma_deg"]}


def row(refined: result.Result, true: np.ndarray, down: np.ndarray, held: np.ndarray) -> dict[str, Any]:
    """What a run came to. held: (S,) bool, scans that planes alone hold"""
    facts = refined.report["reference"]
    keys = ("ate_m", "ate_median_m", "ate_p95_m", "ate_max_m", "rotation_deg", "nees")
    parts = {part: facts.get(part) or {} for part in ("lidar", "camera")}
    made: dict[str, Any] = {part: {key: of.get(key) for key in keys} for part, of in parts.items()}
    if not held.all():
        made["open_m"] = float(np.sqrt(np.mean(errors(refined, true)[~held] ** 2)))
    return made | tilt(refined, true, down)


def main() -> None:
    """Adds the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="rooms")
    parser.add_argument("--lidar", default="non_repetitive")
    parser.add_argument("--seeds", nargs="+", type=int, default=[3, 4, 5])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "lvba-imu")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for seed in given.seeds:
        root = make(given.out, given.scene, given.lidar, seed, given.frames)
        truth = references.read_reference(root / "reference")
        assert truth.scans is not None
        true = truth.scans.world_from_sensor
        down = np.array(json.loads((root / "reference" / "simulation.json").read_text())["imu"]["down"])
        csv, away, held = root / "imu.csv", root / "imu.off", None
        both: dict[str, Any] = {}
        for imu, there, other in (("without", away, csv), ("with", csv, away)):
            if other.exists():
                os.replace(other, there)
            dataset = recordings.open_dataset(root)
            refined = result.refine(dataset, reference=truth)
            if held is None:
                held = np.array(refined.report["lidar"]["degenerate_scans"]) == 0
                both["open"] = int(np.count_nonzero(~held))
            both[imu] = row(refined, true, down, held)
        lidar = given.lidar.replace("_", "-")
        results.save("imu", f"{given.scene}, {lidar}, seed {seed}, {given.frames} frames", both)


if __name__ == "__main__":
    main()
