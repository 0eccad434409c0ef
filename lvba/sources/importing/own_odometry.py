"""Poses of a source that has none: by lvba's own odometry, or by a program of the user's."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.progress import Progress
from lvba.sources.importing import pose_clock, stamp_order
from lvba.sources.importing.point_clock import ScanClock
from lvba.sources.importing.rig import RigFacts
from lvba.sources.importing.selection import Selection
from lvba.sources.importing.survey import Survey, is_return
from lvba.sources.importing.track import Track
from lvba.sources.odometry import estimate as estimating
from lvba.sources.odometry import external
from lvba.sources.odometry.estimate import Estimate
from lvba.sources.odometry.sweeps import Inertial, Sweep
from lvba.sources.source import RawScan, Source

_STANDARD_GRAVITY = 9.80665
_NORMS = {1.0: (7.0, 13.0), _STANDARD_GRAVITY: (0.7, 1.3)}
"""By what accelerations are multiplied: the median norm that tells m/s^2, and g."""
_AROUND_S = 1.0
"""Registered before and after the time that is wanted."""
_MEND = (
    'give poses: --odometry FILE, or those of a tightly coupled odometry: --odometry "COMMAND {bag} {out}"'
)


@dataclass(frozen=True)
class OwnOdometry:
    """track: world from LiDAR, on the clock of the points; facts: for recording.yaml; warnings: one sentence each"""

    track: Track
    facts: dict[str, Any]
    warnings: tuple[str, ...]


def of_scans(
    source: Source,
    lidar: str,
    survey: Survey,
    clock: ScanClock,
    rig: RigFacts,
    wanted: Selection,
    progress: Progress,
) -> OwnOdometry:
    """The poses by registering the scans of a stream one after another, with the IMU where its extrinsic is known.

    wanted: by time; scans a little before and after are registered, too, for images and clocks
    Raises InputError: the odometry is lost; small_gicp is not installed.
    """
    imu, warnings = _inertial(survey, rig)
    about = wanted.widened(_AROUND_S)
    count = sum(about.inside(int(stamp)) for stamp in survey.scan_stamps)
    sweeps = _sweeps(source, lidar, survey, clock, about)
    estimated = estimating.estimate(sweeps, imu, lambda done: progress("scans registered", done, count))
    verdict = estimated.verdict
    if verdict.lost:
        where = "" if verdict.first_s is None else f", first {verdict.first_s:.1f} s after the first scan"
        raise InputError("--odometry auto", f"is lost: {'; '.join(verdict.reasons)}{where}", _MEND)
    facts = {
        "by": "registration of scans (small_gicp)" + ("" if imu is None else " and IMU"),
        "cell_of_the_map_m": round(estimated.cell, 3),
        "scans_with_open_directions": round(verdict.open_part, 4),
        "scans_off_the_motion": round(verdict.surprising_part, 4),
        "scans_off_the_map": round(verdict.unmatched_part, 4),
    }
    return OwnOdometry(_track(estimated, clock.sweep), facts, warnings)


def of_command(command: str, path: str, survey: Survey, progress: Progress) -> tuple[Track, tuple[str, ...]]:
    """The poses that a program of the user's writes, and notes; what they are of, and when they hold, the data decide.

    Raises InputError: as of `odometry.external.run`, or it writes fewer than two poses.
    """
    poses = external.run(command, Path(path), lambda: progress("odometry", 0, 0))
    if len(poses) < 2:
        raise InputError(command.split()[0], "has written fewer than two poses", "look at what it says")
    return pose_clock.of_trajectory(poses, survey, command.split()[0])


def _sweeps(
    source: Source, lidar: str, survey: Survey, clock: ScanClock, about: Selection
) -> Iterator[Sweep]:
    scans = (record for _, record in source.records((lidar,)) if isinstance(record, RawScan))
    for number, record in enumerate(scans):
        if not stamp_order.is_in_order(survey.scans_in_order, number) or not about.inside(record.stamp):
            continue
        after = clock.of_times(record.times, record.stamp, len(record.points))
        good = is_return(record.points) & np.isfinite(after)
        if good.any():
            stamp = float(survey.seconds(np.array([record.stamp]))[0])
            yield Sweep.of_middle(record.points[good], stamp + after[good])


def _inertial(survey: Survey, rig: RigFacts) -> tuple[Inertial | None, tuple[str, ...]]:
    """The IMU in the LiDAR's axes, None without or where its extrinsic is not known, and warnings."""
    imu = survey.imu
    if imu is None:
        return None, ()
    if rig.imu_from_lidar is None:
        return None, (
            "odometry: the IMU is not used, for its extrinsic to the LiDAR is not known: give it by --calibration",
        )
    rotation = rig.imu_from_lidar[:3, :3].T
    norm = float(np.median(np.linalg.norm(imu.forces, axis=1)))
    scale = next((scale for scale, (low, high) in _NORMS.items() if low < norm < high), None)
    forces = None if scale is None else scale * imu.forces @ rotation.T
    unknown = (
        f"odometry: accelerations are not used: their median norm, {norm:.3g}, is neither 9.81 m/s^2 nor 1 g"
    )
    return Inertial(imu.times, imu.rates @ rotation.T, forces), () if forces is not None else (unknown,)


def _track(estimated: Estimate, sweep: float) -> Track:
    """Poses also at the start of the first sweep and at the end of the last one, as the motion continues."""
    times, poses = estimated.times, estimated.world_from_lidar
    if len(times) < 2 or not sweep:
        return Track(times, poses)
    more = 0.55 * sweep
    first = geometry.log(geometry.inverse(poses[0]) @ poses[1]) / (times[1] - times[0])
    last = geometry.log(geometry.inverse(poses[-2]) @ poses[-1]) / (times[-1] - times[-2])
    before, after = geometry.retract(poses[0], -more * first), geometry.retract(poses[-1], more * last)
    return Track(
        np.r_[times[0] - more, times, times[-1] + more], np.concatenate([before[None], poses, after[None]])
    )
