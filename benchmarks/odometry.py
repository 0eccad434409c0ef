"""`--odometry auto` on simulated walks with truth: how far off it ends, and whether the gate says so.

    python benchmarks/odometry.py [--scenes rooms courtyard street corridor] [--seeds 3 4] [--seconds 30]

A line of a table for each scene, LiDAR and seed, with the IMU and without it. "WRONG": a position is more than 10 cm off,
after one rigid alignment of all, and the odometry does not say that it is lost.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from lvba.errors import InputError
from lvba.simulate import raw
from lvba.sources.importing import conventions, own_odometry, rig, streams, survey
from lvba.sources.importing.options import ImportOptions
from lvba.sources.importing.selection import Selection
from lvba.sources.source import KnownGeometry, ListSource

_GOOD_M = 0.1


def without(source: ListSource, names: set[str]) -> ListSource:
    """The source without the streams of these names."""
    kept = tuple(each for each in source.description.streams if each.name not in names)
    items = tuple(item for item in source.items if item[0] not in names)
    return replace(source, description=replace(source.description, streams=kept), items=items)


def largest_error(estimated: np.ndarray, true: np.ndarray) -> float:
    """m, of positions, poses (N, 4, 4), after one rigid alignment of positions."""
    a, b = estimated[:, :3, 3], true[:, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return float(np.linalg.norm((a - a.mean(0)) @ turn.T - (b - b.mean(0)), axis=1).max())


def line(scene: str, lidar: str, seed: int, seconds: float, with_imu: bool, kept: dict) -> str:
    """One line of the table. kept: recordings that were made before, by scene, lidar and seed"""
    key = (scene, lidar, seed)
    if key not in kept:
        kept.clear()
        sensors = raw.Sensors(lidar=lidar, width=64, height=48, image_hz=0.5)
        kept[key] = raw.simulate_raw(scene, seconds=seconds, seed=seed, frames=400, sensors=sensors)
    whole, truth = kept[key]
    names = {raw.ODOMETRY, raw.IMAGES, raw.CAMERA_INFO} | (set() if with_imu else {raw.IMU})
    source, options = without(whole, names), ImportOptions(odometry="auto")
    chosen = streams.choose(source.describe(), options)
    surveyed = survey.survey(source.records(chosen.surveyed), chosen, 0, lambda *_: None)
    facts = rig.gather((), KnownGeometry(), surveyed, "")
    begin = time.process_time()
    head = f"| {scene} {seed} | {lidar} | {'yes' if with_imu else 'no'} |"
    try:
        clock, wanted = conventions.clock_of(surveyed), Selection.of(options, surveyed.zero, 1)
        result = own_odometry.of_scans(source, chosen.lidar, surveyed, clock, facts, wanted, lambda *_: None)
    except InputError as error:
        return f"{head} | lost | {str(error).split('is lost: ')[-1].split(' Give')[0][:160]} |"
    taken = (time.process_time() - begin) / len(truth.scans)
    track = result.track
    inside = slice(1, -1)
    stamps = np.round(track.times[inside] * 1e9).astype(np.int64) + surveyed.zero
    true = truth.scene_from_body(stamps) @ truth.rig.body_from_lidar
    error = largest_error(track.poses[inside], true)
    verdict = "good" if error <= _GOOD_M else "WRONG"
    return f"| {head[2:]} {100 * error:.1f} cm | {verdict} | {result.facts}, {1e3 * taken:.0f} ms a scan |"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["rooms", "courtyard", "street", "corridor"])
    parser.add_argument("--lidars", nargs="+", default=["spinning", "non_repetitive"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[3])
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args()
    print("| scene | LiDAR | IMU | largest error | verdict | figures |\n|---|---|---|---|---|---|")
    kept: dict = {}
    for scene in given.scenes:
        for seed in given.seeds:
            for lidar in given.lidars:
                for with_imu in (True, False):
                    print(line(scene, lidar, seed, given.seconds, with_imu, kept), flush=True)


if __name__ == "__main__":
    main()
