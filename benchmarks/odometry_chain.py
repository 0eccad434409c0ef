"""From a bag to the map, by poses of any odometry: how far off these are, what lvba says, and how far off the map is.

    python benchmarks/odometry_chain.py --scenes rooms --seeds 3 --programs good auto "kiss=sh kiss_icp.sh {bag} {out}"

Simulated bags (ROS 1, PointCloud2 of an Ouster), 10,000 points a scan. Programs: `good`, the topic of an odometry that
is right to 5 mm and 0.05 degrees; `auto`, lvba's own; NAME=COMMAND, a program by `--odometry`, with what follows ` -- `
as options of the import. `{calibration}` in a command: a configuration of se3-lio with the true extrinsic.
A JSON object for each: the largest and the rms error of the rough positions, m, rms errors of refined scans and cameras
after the alignment of scans, what lvba expects, its verdict and reasons. What the commands say is beside the bag.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lvba import geometry, trajectory
from lvba.io import tum
from lvba.simulate import raw
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.trajectory import Trajectory

GOOD, AUTO = "good", "auto"
SE3_LIO = Path(__file__).parent.parent / "docs/examples/odometry/se3_lio.yaml"
"""Its noise of the IMU is that of the simulated one."""


@dataclass(frozen=True)
class Bag:
    """path: with the odometry; bare: without; truth: of the same scene"""

    path: Path
    bare: Path
    truth: raw.RawTruth


def bag(folder: Path, scene: str, lidar: str, seed: int, seconds: float, rest_s: float) -> Bag:
    """The bags of a scene, made if they are not there."""
    sensors = raw.Sensors(lidar=lidar, width=320, height=240, rest_s=rest_s)
    frames = round(seconds / 0.1)
    source, truth = raw.simulate_raw(scene, seconds=seconds, seed=seed, frames=frames, sensors=sensors)
    made = Bag(folder / "walk.bag", folder / "bare.bag", truth)
    names = {stream.name for stream in source.describe().streams}
    for path, streams in ((made.path, names), (made.bare, names - {raw.ODOMETRY})):
        if not path.exists():
            write_bag(source, path, BagForm.ROS1, PointLayout.OUSTER, streams)
    return made


def calibration(folder: Path, truth: raw.RawTruth) -> Path:
    """The configuration of se3-lio that the recipe has, with the true extrinsic."""
    imu_from_lidar = truth.rig.body_from_lidar
    x, y, z, w = geometry.quaternion(imu_from_lidar).tolist()
    of_recipe = yaml.safe_load(SE3_LIO.read_text())
    of_recipe["sensors"] |= {"t_exts": imu_from_lidar[:3, 3].tolist(), "q_exts": [w, x, y, z]}
    path = folder / "se3.yaml"
    path.write_text(yaml.safe_dump(of_recipe))
    return path


def lvba(*words: str | Path) -> tuple[int, str]:
    """Exit code and what the command said."""
    command = [sys.executable, "-m", "service.cli", *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.returncode, done.stdout


def off(poses: Trajectory, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) m of poses after the alignment that errors are counted after; that alignment, (4, 4). true: (N, 4, 4)"""
    align = trajectory.align_for_errors(poses.world_from_sensor, true).reference_from_estimate
    moved = align @ poses.world_from_sensor
    return np.linalg.norm(moved[:, :3, 3] - true[:, :3, 3], axis=1), align


def stamps_of(times: np.ndarray) -> np.ndarray:
    """(N,) int64 ns. times: (N,) s since 1970, of which the last digits are lost"""
    return np.round(np.asarray(times, float) * 1e6).astype(np.int64) * 1000


def said_of(recording: Path) -> dict[str, Any]:
    """What its import wrote of it, {} where none made it."""
    said = recording / "recording.yaml"
    return yaml.safe_load(said.read_text()) if said.exists() else {}


def true_scans(recording: Path, times: np.ndarray, truth: raw.RawTruth) -> np.ndarray:
    """(N, 4, 4), of the frame in which the recording has its scans; the body where it says of none."""
    poses = truth.scene_from_body(stamps_of(times))
    of = said_of(recording).get("conventions", {}).get("pose_of", {}).get("taken", "body")
    return poses @ truth.rig.body_from_lidar if of in ("lidar", "camera") else poses


def taken(recording: Path, times: np.ndarray, truth: raw.RawTruth) -> np.ndarray:
    """(N,) s: when images were taken, whatever offset the import gave to their stamps, (N,) s."""
    added = said_of(recording).get("applied", {}).get("added_to_stamps_of_images_s", 0.0)
    stamped = np.asarray(times, float) - added
    true = truth.images * 1e-9
    nearest = true[np.abs(true[None] - stamped[:, None]).argmin(axis=1)]
    if not np.allclose(nearest, stamped, atol=1e-3):
        raise ValueError(f"{recording}: its images have no stamps of the bag")
    return nearest


def row(made: Bag, program: str, folder: Path) -> dict[str, object]:
    """What comes of a bag by one odometry."""
    name, _, command = program.partition("=")
    folder.mkdir(parents=True, exist_ok=True)
    recording, out = folder / "recording", folder / "result"
    words: list[str] = []
    if name != GOOD:
        command, _, options = (command or AUTO).partition(" -- ")
        command = command.replace("{calibration}", str(calibration(folder, made.truth)))
        words = ["--odometry", command, *options.split()]
    source = made.path if name == GOOD else made.bare
    code, said = lvba("import", source, "--out", recording, *words)
    (folder / "import.log").write_text(said)
    if code:
        return {"refused": said.strip().splitlines()[-1]}
    rough = tum.read_trajectory(recording / "lidar_poses.txt")
    errors, _ = off(rough, true_scans(recording, rough.times, made.truth))
    made_of = {"rough_max_m": float(errors.max()), "rough_m": float(np.sqrt(np.mean(errors**2)))}
    warned = [line[9:].partition(":")[0] for line in said.splitlines() if line.startswith("warning: ")]
    code, said = lvba("run", recording, "--out", out, "--quiet")
    (folder / "run.log").write_text(said)
    if code:
        return made_of | {"warned": warned, "refused": said.strip().splitlines()[-1]}
    return made_of | {"warned": warned} | result_of(recording, out, made.truth)


def result_of(recording: Path, out: Path, truth: raw.RawTruth) -> dict[str, object]:
    """What is off in a result, and what its report says of it."""
    scans = tum.read_trajectory(out / "lidar_poses.txt")
    errors, align = off(scans, true_scans(recording, scans.times, truth))
    cameras = tum.read_trajectory(out / "image_poses.txt")
    # images of a bag have poses of the frame that scans are in, of when they were taken
    true = true_scans(recording, taken(recording, cameras.times, truth), truth)
    apart = np.linalg.norm((align @ cameras.world_from_sensor)[:, :3, 3] - true[:, :3, 3], axis=1)
    report = json.loads((out / "report.json").read_text())
    verdict = report["verdict"]
    return {
        "scans_m": float(np.sqrt(np.mean(errors**2))),
        "cameras_m": float(np.sqrt(np.mean(apart**2))),
        "verdict": verdict["level"],
        "expected_m": ((report["expected_error"] or {}).get("scans") or {}).get("position_m"),
        "reasons": [reason["text"] for reason in verdict["reasons"]],
    }


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", nargs="+", default=["courtyard", "street", "rooms", "staircase", "corridor"]
    )
    parser.add_argument("--lidars", nargs="+", default=["spinning", "non_repetitive"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[3])
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--rest", type=float, default=0.0, help="s at rest before the sensors move")
    parser.add_argument("--programs", nargs="+", default=[GOOD, AUTO])
    parser.add_argument("--work", type=Path, required=True, help="a folder for bags, recordings and results")
    given = parser.parse_args()
    for scene in given.scenes:
        for lidar in given.lidars:
            for seed in given.seeds:
                folder = given.work / f"{scene}-{lidar}-{seed}"
                folder.mkdir(parents=True, exist_ok=True)
                made = bag(folder, scene, lidar, seed, given.seconds, given.rest)
                for program in given.programs:
                    name = program.partition("=")[0]
                    facts = row(made, program, folder / name)
                    line = {"scene": scene, "lidar": lidar, "seed": seed, "program": name} | facts
                    print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
