"""Bags of every container with points of every driver, from bag to map, against a folder without an error of any driver.

    python benchmarks/bag_forms.py --work DIR [--scenes rooms street] [--seconds 8] [--seeds 3]

Simulated sensors with an IMU and an odometry that is right to 5 mm and 0.05 degrees. The folder has scans that are
deskewed by the true motion, and the poses of that odometry at the true times. Bags with points of one driver must give
the same recording, byte for byte, from every container; one of them is run. A line of a table for each driver: rms
errors of scans and cameras after the alignment of scans, verdict, and how many containers gave these bytes.
"""

import argparse
import hashlib
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
from odometry_chain import lvba, result_of

from lvba import geometry, trajectory
from lvba.inertial.readings import ImuReadings
from lvba.io import calibration, files, imu, pcd, tum
from lvba.simulate import raw
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.importing.writing import stamp_text
from lvba.sources.source import ImuSample, ListSource, PoseSample
from lvba.trajectory import Trajectory

LAYOUTS = {
    "spinning": (PointLayout.OUSTER, PointLayout.VELODYNE, PointLayout.HESAI, PointLayout.ROBOSENSE),
    "non_repetitive": (PointLayout.LIVOX_CUSTOM_1, PointLayout.LIVOX_CUSTOM_2, PointLayout.LIVOX_CLOUD),
}


def write_folder(source: ListSource, truth: raw.RawTruth, out: Path) -> None:
    """A recording in which all is as it was, but for the noise of the odometry."""
    scans, images = files.make_folder(out / "all_pcd_body"), files.make_folder(out / "all_image")
    for begin, points, times in zip(truth.scans, truth.points, truth.point_times, strict=True):
        lidar = truth.scene_from_body(times) @ truth.rig.body_from_lidar
        scene = np.einsum("nij,nj->ni", lidar[:, :3, :3], points) + lidar[:, :3, 3]
        [body_from_scene] = geometry.inverse(truth.scene_from_body(np.array([begin])))
        here = geometry.transform_points(body_from_scene, scene)
        pcd.write_pcd(scans / f"{stamp_text(int(begin))}.pcd", here)
    for taken, encoded in zip(truth.images, truth.encoded, strict=True):
        files.write_bytes(images / f"{stamp_text(int(taken))}.jpg", encoded)
    samples = [record for _, record in source.items if isinstance(record, PoseSample)]
    odometry = Trajectory(
        np.array([sample.stamp * 1e-9 for sample in samples]),
        np.array([sample.parent_from_child for sample in samples]),
    )
    for folder, stamps, name in (
        (scans, truth.scans, "lidar_poses.txt"),
        (images, truth.images, "image_poses.txt"),
    ):
        times = stamps * 1e-9
        tum.write_trajectory(folder / name, Trajectory(times, trajectory.sample(odometry, times)))
    felt = [record for _, record in source.items if isinstance(record, ImuSample)]
    readings = (np.array([getattr(each, name) for each in felt]) for name in ("gyroscope", "accelerometer"))
    imu.write(out / imu.NAME, ImuReadings(np.array([each.stamp * 1e-9 for each in felt]), *readings))
    camera_from_lidar = truth.rig.camera_from_body @ truth.rig.body_from_lidar
    text = calibration.recording_text(truth.camera, truth.rig.body_from_lidar, camera_from_lidar)
    files.write_text(out / "config.yaml", text)


def digest(recording: Path) -> str:
    """Of all files that a run reads."""
    whole = hashlib.sha256()
    for path in sorted(recording.rglob("*")):
        if path.is_file() and path.name not in ("recording.yaml", ".import.json"):
            whole.update(f"{path.relative_to(recording)} {files.sha256(path)}\n".encode())
    return whole.hexdigest()


def ran(recording: Path, out: Path, truth: raw.RawTruth) -> str:
    """Cells of a table: errors of scans and cameras, and the verdict."""
    code, said = lvba("run", recording, "--out", out, "--quiet")
    if code:
        return f"refused: {said.strip().splitlines()[-1]}"
    facts = result_of(recording, out, truth)
    errors = (f"{1e3 * float(facts[name]):.2f}" for name in ("scans_m", "cameras_m"))
    return " | ".join([*errors, facts["verdict"]])


def line(
    source: ListSource, truth: raw.RawTruth, layout: PointLayout, folder: Path, forms: Sequence[BagForm]
) -> str:
    """The cells of one driver."""
    recordings = dict[str, list[str]]()
    for form in forms:
        bag, recording = folder / f"{form}.bag", folder / form
        write_bag(source, bag, form, layout)
        code, said = lvba("import", bag, "--out", recording)
        if code:
            return f"{form} refused: {said.strip().splitlines()[-1]}"
        recordings.setdefault(digest(recording), []).append(form)
    first, same = next(iter(recordings.values()))[0], max(map(len, recordings.values()))
    return f"{ran(folder / first, folder / 'result', truth)} | {same} of {len(forms)}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["rooms", "street"])
    parser.add_argument("--lidars", nargs="+", default=list(LAYOUTS))
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seeds", nargs="+", type=int, default=[3])
    parser.add_argument("--forms", nargs="+", type=BagForm, default=list(BagForm), help="containers")
    parser.add_argument("--work", type=Path, required=True, help="a folder for bags, recordings and results")
    given = parser.parse_args()
    print("| scene | LiDAR | source | scans mm | cameras mm | verdict | containers with the same bytes |")
    print("|---|---|---|---:|---:|---|---|", flush=True)
    for scene, lidar, seed in product(given.scenes, given.lidars, given.seeds):
        sensors = raw.Sensors(lidar=lidar)
        frames = round(given.seconds / 0.1)
        source, truth = raw.simulate_raw(
            scene, seconds=given.seconds, seed=seed, frames=frames, sensors=sensors
        )
        head, folder = f"| {scene} {seed} | {lidar}", given.work / f"{scene}-{lidar}-{seed}"
        write_folder(source, truth, folder / "folder")
        cells = ran(folder / "folder", folder / "folder-result", truth)
        print(f"{head} | folder | {cells} | |", flush=True)
        for layout in LAYOUTS[lidar]:
            cells = line(source, truth, layout, files.make_folder(folder / layout), given.forms)
            print(f"{head} | {layout} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
