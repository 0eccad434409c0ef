"""Wrong conventions, injected one at a time into simulated raw recordings: found and mended, refused, or let through.

python benchmarks/import_conventions.py > docs/import_evidence.md     (20 minutes on one core)
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.io import pcd, tum
from lvba.simulate import raw
from lvba.simulate.raw import Conventions, Moment, PoseOf, RawTruth, Sensors
from lvba.sources.importing.importer import ImportReport, import_source
from lvba.sources.importing.options import ImportOptions
from lvba.trajectory import Trajectory

SCENES = (("courtyard", "spinning"), ("rooms", "non_repetitive"), ("street", "spinning"))
MOST_OFF = 1.5
"""Times the error of the recording without wrong conventions that a mended one may have."""


@dataclass(frozen=True)
class Case:
    """What is injected. quaternions: of a TUM file that the odometry is given as; "": it is a topic"""

    name: str
    conventions: Conventions
    quaternions: str = ""
    decided: str = ""
    """The question that it is about, where there is one."""


def units() -> Iterator[Case]:
    """Of times of points."""
    plain = Conventions()
    for unit, name, types in (
        (1.0, "s", ("float32", "float64")),
        (1e-3, "ms", ("float32", "float64")),
        (1e-6, "us", ("float32", "uint32")),
        (1e-9, "ns", ("uint32", "float64")),
    ):
        for kind in types:
            relative = replace(plain, unit=unit, time_type=kind)
            yield Case(f"times of points in {name} from the stamp ({kind})", relative)
        wide = "float64" if unit > 1e-9 else "int64"
        absolute = replace(plain, unit=unit, time_type=wide, absolute=True)
        yield Case(f"times of points in {name} since 1970 ({wide})", absolute)
    yield Case(
        "times of points since 1970, stamp at the end",
        replace(plain, absolute=True, time_type="int64", header=Moment.END),
    )


def cases(with_units: bool) -> Iterator[Case]:
    """All of them; the first one is as it should be. with_units: those of times of points, which no scene changes"""
    plain = Conventions()
    yield Case("none", plain)
    for header in Moment:
        for moment in Moment:
            if (header, moment) != (Moment.BEGIN, Moment.BEGIN):
                name = f"scans are stamped at the {header}, poses are of the {moment}"
                yield Case(name, replace(plain, header=header, pose_moment=moment), decided="time")
    yield from units() if with_units else ()
    for of in (PoseOf.LIDAR, PoseOf.CAMERA):
        yield Case(f"poses are of the {of}", replace(plain, pose_of=of), decided="pose_of")
    yield Case("poses are body from world", replace(plain, inverse=True), decided="pose_direction")
    camera = replace(plain, inverse=True, pose_of=PoseOf.CAMERA)
    yield Case("poses are camera from world", camera, decided="pose_direction")
    yield Case("poses in a TUM file", plain, "xyzw", decided="quaternions")
    yield Case("poses in a TUM file, quaternions w first", plain, "wxyz", decided="quaternions")
    yield Case(
        "LiDAR from camera in place of camera from LiDAR",
        replace(plain, extrinsic_inverse=True),
        decided="extrinsic",
    )
    for delay in (0.1, -0.1, 0.05, 0.03):
        late = replace(plain, image_delay=delay)
        yield Case(f"images are stamped {1000 * delay:+.0f} ms late", late, decided="image_offset")
    for delay in (0.1, -0.1, 0.03):
        late = replace(plain, odometry_delay=delay)
        yield Case(f"poses are stamped {1000 * delay:+.0f} ms late", late, decided="time")


def odometry_file(path: Path, source: raw.ListSource, order: str) -> Path:
    """The poses of the odometry as a TUM file. order: of the quaternions, xyzw or wxyz"""
    samples = [record for stream, record in source.items if stream == raw.ODOMETRY]
    poses = np.array([sample.parent_from_child for sample in samples])
    if order == "wxyz":
        poses = geometry.from_quaternion_translation(
            np.roll(geometry.quaternion(poses), 1, axis=-1), poses[:, :3, 3]
        )
    times = np.array([sample.stamp * 1e-9 for sample in samples])
    tum.write_trajectory(path, Trajectory(times, poses))
    return path


def without(source: raw.ListSource, stream: str) -> raw.ListSource:
    """The source without one stream."""
    items = tuple(item for item in source.items if item[0] != stream)
    streams = tuple(each for each in source.description.streams if each.name != stream)
    return replace(source, items=items, description=replace(source.description, streams=streams))


def scan_error(out: Path, truth: RawTruth) -> float:
    """m: root mean square of how far points of the recording are from where they were measured."""
    trajectory = tum.read_trajectory(out / "lidar_poses.txt")
    squares = []
    for path, pose in zip(
        sorted((out / "all_pcd_body").iterdir()), trajectory.world_from_sensor, strict=True
    ):
        scan = pcd.read_pcd(path)
        assert scan.time is not None
        number = int(np.argmin([abs(times.mean() * 1e-9 - scan.time.mean()) for times in truth.point_times]))
        placed = truth.scene_from_body(truth.point_times[number]) @ truth.rig.body_from_lidar
        true = (
            np.einsum("nij,nj->ni", placed[:, :3, :3], truth.points[number].astype(float)) + placed[:, :3, 3]
        )
        squares.append(np.sum((geometry.transform_points(pose, scan.points) - true) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def image_error(out: Path, truth: RawTruth) -> tuple[float, float]:
    """m and degrees, root mean squares of the error of poses of images."""
    images = sorted((out / "all_image").iterdir())
    trajectory = tum.read_trajectory(out / "image_poses.txt")
    known = {encoded: number for number, encoded in enumerate(truth.encoded)}
    numbers = [known[path.read_bytes()] for path in images]
    true = truth.scene_from_body(truth.images[numbers]) @ geometry.inverse(truth.rig.camera_from_body)
    config = camera_from_body(out)
    off = geometry.inverse(true) @ trajectory.world_from_sensor @ geometry.inverse(config)
    lengths = np.linalg.norm(off[:, :3, 3], axis=1)
    return float(np.sqrt(np.mean(lengths**2))), float(np.sqrt(np.mean(geometry.rotation_angle_deg(off) ** 2)))


def camera_from_body(out: Path) -> np.ndarray:
    """(4, 4), as the recording says it."""
    from lvba.io.camera_config import read_calibration

    calibration = read_calibration(out)
    return np.asarray(calibration.camera_from_lidar @ geometry.inverse(calibration.body_from_lidar))


@dataclass(frozen=True)
class Outcome:
    """What came of a case. state: mended, refused, warned, or silent"""

    state: str
    scans: float
    cameras: tuple[float, float]
    words: str


def outcome(case: Case, truth: RawTruth, sensors: Sensors, reference: Outcome | None, seed: int) -> Outcome:
    """Imports the recording with what is injected, and compares with the truth."""
    source = raw.written(truth, case.conventions, sensors, seed)
    with tempfile.TemporaryDirectory() as folder:
        out, options = Path(folder) / "recording", ImportOptions()
        if case.quaternions:
            path = odometry_file(Path(folder) / "poses.txt", source, case.quaternions)
            source, options = without(source, raw.ODOMETRY), ImportOptions(odometry=str(path))
        try:
            report = import_source(source, out, options)
        except InputError as error:
            return Outcome("refused", float("nan"), (float("nan"), float("nan")), str(error))
        scans, cameras = scan_error(out, truth), image_error(out, truth)
        return Outcome(_state(report, scans, cameras, reference), scans, cameras, _words(case, report))


def _state(
    report: ImportReport, scans: float, cameras: tuple[float, float], reference: Outcome | None
) -> str:
    if reference is None:
        return "as it is"
    fine = scans <= MOST_OFF * reference.scans and all(
        one <= MOST_OFF * other for one, other in zip(cameras, reference.cameras, strict=True)
    )
    if fine:
        return "mended, with a warning" if report.warnings else "mended"
    return "warned" if report.warnings else "SILENT"


def _words(case: Case, report: ImportReport) -> str:
    decided = report.facts["conventions"].get(case.decided)
    words = (
        report.facts["times_of_points"]["read_as"]
        if decided is None
        else f"{case.decided}: {decided['taken']}"
    )
    if decided is not None and decided["by"] == "data":
        factor, unit = (100, "cm") if decided["unit"] == "m" else (1, "")
        order = sorted(decided["scores"].values())
        words += f" ({factor * order[0]:.2f} against {factor * order[1]:.2f} {unit})".replace(" )", ")")
    return "; ".join([words, *report.warnings])


_HEAD = """\
# Wrong conventions: what the import makes of them

*Explanation.* Simulated raw recordings of {seconds:g} s (sweeps of 0.1 s, images and odometry at 10 Hz, with a noise
of 5 mm and 0.05 degrees), each with one convention that is not the usual one. Errors (rms) are against the truth: of
points, where they were measured; of cameras, where images were taken. Mended: at most {most} times the error of the
recording without a wrong convention. Refused: an error that says so. Warned: worse, with a warning. SILENT: worse,
without one.

This page is made by `python benchmarks/import_conventions.py`.
"""


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="scene")
    arguments = parser.parse_args()
    print(_HEAD.format(seconds=arguments.seconds, most=MOST_OFF))
    for scene, lidar in SCENES:
        if arguments.only not in scene:
            continue
        sensors = Sensors(lidar=lidar)
        truth = raw.measure(scene, seconds=arguments.seconds, seed=arguments.seed, sensors=sensors)
        print(f"## {scene}, {lidar.replace('_', '-')} LiDAR\n")
        print("| injected | outcome | points | cameras | found |\n|---|---|---|---|---|")
        reference = None
        for case in cases(scene == SCENES[0][0] and lidar == SCENES[0][1]):
            made = outcome(case, truth, sensors, reference, arguments.seed)
            reference = reference or made
            cameras = f"{100 * made.cameras[0]:.2f} cm, {made.cameras[1]:.3f} deg"
            print(f"| {case.name} | {made.state} | {100 * made.scans:.2f} cm | {cameras} | {made.words} |")
            sys.stdout.flush()
        print()


if __name__ == "__main__":
    main()
