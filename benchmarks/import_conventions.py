"""Wrong conventions, injected one at a time into simulated raw recordings: found and mended, refused, or let through.

python benchmarks/import_conventions.py > docs/import_evidence.md     (20 minutes on one core)
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.inertial import consistency
from lvba.inertial.readings import Imu, in_si_units
from lvba.io import imu as imu_files
from lvba.io import pcd, tum
from lvba.io.dataset import open_dataset
from lvba.simulate import imu as simulated_imu
from lvba.simulate import raw
from lvba.simulate.raw import Conventions, Moment, PoseOf, RawTruth, Sensors
from lvba.sources.importing.importer import ImportReport, import_source
from lvba.sources.importing.options import ImportOptions
from lvba.sources.source import ImuSample, TransformSample
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
    reading: Callable[[ImuSample], ImuSample] | None = None
    """What becomes of each reading of the IMU."""
    mounting_inverse: bool = False
    """The calibration has IMU from body in place of body from IMU."""


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


IMU_MOUNTING = (0.4, -1.1, 2.0, 0.15, -0.3, 0.08)
"""Where the IMU is on the body in the cases about it, turned and shifted, as of `Conventions.imu`."""


def imu_cases() -> Iterator[Case]:
    """About the IMU; the first one is as it should be."""
    apart = Conventions(imu=IMU_MOUNTING)

    def turned(order: list[int], signs: list[float]) -> Callable[[ImuSample], ImuSample]:
        def reading(sample: ImuSample) -> ImuSample:
            rate, force = (values[order] * signs for values in (sample.gyroscope, sample.accelerometer))
            return replace(sample, gyroscope=rate, accelerometer=force)

        return reading

    def gyroscope(signs: list[float]) -> Callable[[ImuSample], ImuSample]:
        return lambda sample: replace(sample, gyroscope=sample.gyroscope * signs)

    def scaled(rate: float, force: float) -> Callable[[ImuSample], ImuSample]:
        return lambda sample: replace(
            sample, gyroscope=rate * sample.gyroscope, accelerometer=force * sample.accelerometer
        )

    def late(seconds: float) -> Callable[[ImuSample], ImuSample]:
        return lambda sample: replace(sample, stamp=sample.stamp + round(seconds * 1e9))

    yield Case("none, IMU mounted apart", apart)
    yield Case("IMU: axes y, z, x in place of x, y, z", apart, reading=turned([1, 2, 0], [1, 1, 1]))
    yield Case("IMU: turned by 90 degrees", apart, reading=turned([1, 0, 2], [1, -1, 1]))
    yield Case("IMU: axes of the gyroscope forward, right, down", apart, reading=gyroscope([1, -1, -1]))
    yield Case("IMU: axes forward, right, down", apart, reading=turned([0, 1, 2], [1, -1, -1]))
    yield Case("IMU from body in place of body from IMU", apart, mounting_inverse=True)
    yield Case("IMU: gyroscope in deg/s", apart, reading=scaled(np.degrees(1), 1))
    yield Case("IMU: accelerometer in g", apart, reading=scaled(1, 1 / 9.80665))
    yield Case("IMU: accelerometer in mg", apart, reading=scaled(1, 1e3 / 9.80665))
    yield Case("IMU: accelerometer with the sign of gravity", apart, reading=scaled(1, -1))
    for seconds in (0.1, -0.1, 0.05, 0.25):
        name = f"IMU: stamped {1000 * seconds:+.0f} ms late"
        yield Case(name, apart, decided="imu_offset", reading=late(seconds))
    yield Case("IMU: stamps since it was switched on", apart, reading=late(-raw.START_NS * 1e-9 + 30))
    yield Case("IMU: stamps of a clock one hour ahead", apart, reading=late(3600.0))


def injected(case: Case, source: raw.ListSource) -> raw.ListSource:
    """The source with what a case has wrong about the IMU."""

    def changed(record: raw.Record) -> raw.Record:
        if isinstance(record, ImuSample) and case.reading is not None:
            return case.reading(record)
        if isinstance(record, TransformSample) and record.child == raw.IMU_FRAME and case.mounting_inverse:
            return replace(record, parent_from_child=geometry.inverse(record.parent_from_child))
        return record

    return replace(source, items=tuple((stream, changed(record)) for stream, record in source.items))


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


def imu_error(out: Path, truth: RawTruth) -> tuple[float, float]:
    """rad/s and m/s^2, root mean squares of errors of readings, in the axes of the scans at their times, less biases."""
    dataset = open_dataset(out)
    readings = in_si_units(imu_files.read(dataset.imu_path)) if dataset.imu_path else None
    if readings is None or not len(readings):
        return float("inf"), float("inf")
    stamps = np.round(readings.times * 1e9).astype(np.int64)
    inside = (stamps >= truth.scans[0]) & (stamps <= truth.scans[-1])
    if not inside.any():
        return float("inf"), float("inf")
    true_mounting = geometry.exp(np.array(IMU_MOUNTING))
    exact = simulated_imu.exact(truth.motion, raw.moments(stamps[inside]), true_mounting)
    said = dataset.scan_from_imu[:3, :3]
    errors = []
    for read, true in zip((readings.rates, readings.forces), exact, strict=True):
        off = read[inside] @ said.T - true @ true_mounting[:3, :3].T
        off -= np.median(off, axis=0)
        errors.append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
    return errors[0], errors[1]


def left_out(out: Path, truth: RawTruth) -> str:
    """Why the refinement does not use the IMU of a recording, beside true poses; "": it does."""
    dataset = open_dataset(out)
    if not dataset.imu_path:
        return "the recording has none"
    stamps = np.array([int(Path(path).stem.replace(".", "")) for path in dataset.scan_paths])
    poses, count = truth.scene_from_body(stamps), len(stamps)
    exact = np.tile(np.diag(np.repeat([1e-4, 1e-3], 3)) ** 2, (count - 1, 1, 1))
    imu = Imu(imu_files.read(dataset.imu_path), stamps * 1e-9, dataset.scan_from_imu)
    judged = consistency.built(imu, poses, exact)
    if judged.factor is not None:
        judged = consistency.before(judged.factor, poses, exact, np.ones(count, bool))
    return "" if judged.factor is not None else judged.problem


@dataclass(frozen=True)
class Outcome:
    """What came of a case. state: mended, refused, warned, left out or silent

    imu: rad/s and m/s^2, zeros in cases that are not about it
    """

    state: str
    scans: float
    cameras: tuple[float, float]
    words: str
    imu: tuple[float, float] = (0.0, 0.0)


def outcome(case: Case, truth: RawTruth, sensors: Sensors, reference: Outcome | None, seed: int) -> Outcome:
    """Imports the recording with what is injected, and compares with the truth."""
    source = injected(case, raw.written(truth, case.conventions, sensors, seed))
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
        made = Outcome("", scans, cameras, _words(case, report))
        unused = ""
        if case.conventions.imu:
            unused = left_out(out, truth)
            words = f"{made.words}; the refinement leaves it out: {unused}" if unused else made.words
            made = replace(made, imu=imu_error(out, truth), words=words)
        return replace(made, state=_state(report, made, reference, unused))


def _state(report: ImportReport, made: Outcome, reference: Outcome | None, unused: str) -> str:
    """unused: why the refinement leaves the IMU out"""
    if reference is None:
        return "as it is"
    frames = [(made.scans, reference.scans), *zip(made.cameras, reference.cameras, strict=True)]
    fine = all(one <= MOST_OFF * other for one, other in frames)
    if fine and all(one <= MOST_OFF * other for one, other in zip(made.imu, reference.imu, strict=True)):
        return "mended, with a warning" if report.warnings else "mended"
    if report.facts["applied"].get("imu") == "left out" and report.warnings:
        return "left out, with a warning" if made.scans <= MOST_OFF * reference.scans else "warned"
    if report.warnings:
        return "warned"
    return "left out later" if fine and unused else "SILENT"


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
without one. Left out: the import does not write the IMU, with a warning.

Of the IMU (turned and shifted on the body): errors (rms) of rates and forces in the axes of the scans, at their
times, less what is the same all the time. Left out later: the import says nothing, but the refinement finds that it
contradicts the scans, says so and does not use it.

This page is made by `python benchmarks/import_conventions.py`.
"""


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="scene")
    parser.add_argument("--imu", action="store_true", help="the cases about the IMU alone")
    arguments = parser.parse_args()
    print(_HEAD.format(seconds=arguments.seconds, most=MOST_OFF))
    for scene, lidar in SCENES:
        if arguments.only not in scene:
            continue
        sensors = Sensors(lidar=lidar)
        truth = raw.measure(scene, seconds=arguments.seconds, seed=arguments.seed, sensors=sensors)
        print(f"## {scene}, {lidar.replace('_', '-')} LiDAR\n")
        if arguments.imu:
            _print_imu(truth, sensors, arguments.seed)
            continue
        print("| injected | outcome | points | cameras | found |\n|---|---|---|---|---|")
        reference = None
        for case in cases(scene == SCENES[0][0] and lidar == SCENES[0][1]):
            made = outcome(case, truth, sensors, reference, arguments.seed)
            reference = reference or made
            cameras = f"{100 * made.cameras[0]:.2f} cm, {made.cameras[1]:.3f} deg"
            print(f"| {case.name} | {made.state} | {100 * made.scans:.2f} cm | {cameras} | {made.words} |")
            sys.stdout.flush()
        print()
        _print_imu(truth, sensors, arguments.seed)


def _print_imu(truth: RawTruth, sensors: Sensors, seed: int) -> None:
    print("| injected | outcome | points | IMU | found |\n|---|---|---|---|---|")
    reference = None
    for case in imu_cases():
        made = outcome(case, truth, sensors, reference, seed)
        reference = reference or made
        readings = f"{made.imu[0]:.2g} rad/s, {made.imu[1]:.2g} m/s^2"
        print(f"| {case.name} | {made.state} | {100 * made.scans:.2f} cm | {readings} | {made.words} |")
        sys.stdout.flush()
    print()


if __name__ == "__main__":
    main()
