"""What speaks against the files of a recording: counted, and told in a sentence each. Nothing is changed or refused."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from lvba.dataset import Dataset, InputFindings, Scan
from lvba.errors import InputError
from lvba.io import pose_readings
from lvba.io.posed_frames import PosedFrames
from lvba.trajectory import Trajectory

MOST_SPEED = 300.0
"""m/s from scan to scan (median): no vehicle that maps moves faster."""
MOST_RANGE = 2000.0
"""m (median over points): few sensors see so far, and none typically."""
_APART_S = 1.0
"""Times of images and scans further apart are of different clocks; less may be images taken after the last scan."""
_SAME_POSE = 1e-9
_DIGEST_LETTERS = 64
_SAMPLED = 3


def add(dataset: Dataset, where: Path, scans: PosedFrames, pictures: PosedFrames | None) -> Dataset:
    """The recording with what the names, times and poses of its files say against it.

    where: the file of the scan poses; scans, pictures: the frames that the recording is made of
    """
    findings = InputFindings(
        skipped_scans=scans.skipped,
        skipped_images=0 if pictures is None else pictures.skipped,
        apart_s=0.0 if pictures is None else apart(scans.poses, pictures.poses),
        repeated_scans=_repeated_files(scans.fingerprints[1:]),
        repeated_poses=_repeated_poses(scans.poses),
        speed_m_s=_absurd(_speed(scans.poses), MOST_SPEED),
    )
    warnings = (f"{where}: {words}" for words in _told(findings, scans, pictures))
    return dataclasses.replace(dataset, findings=findings, warnings=(*dataset.warnings, *warnings))


def with_points(
    dataset: Dataset, where: Path, load: Callable[[Dataset, int], Scan], readings: bool = True
) -> Dataset:
    """The recording with what the points of a few scans say against it.

    where: the file of the scan poses; load: a scan by its number; readings: whether poses may be misread
    """

    @cache
    def points(index: int) -> np.ndarray:
        return pose_readings.thinned(load(dataset, index).points)

    try:
        range_m = _absurd(_range(points, dataset), MOST_RANGE)
        poses_as = pose_readings.find(dataset.scans.world_from_sensor, points) if readings else ""
    except InputError:
        return dataset  # damaged scans are told when they are used
    findings = dataclasses.replace(dataset.findings, range_m=range_m, poses_as=poses_as)
    warnings = list(dataset.warnings)
    if range_m:
        warnings.append(
            f"{Path(dataset.scan_paths[0]).parent}: half of the points are more than {range_m / 1000:.1f} km from the "
            "sensor: they seem to be in millimeters, or in the world frame. Write meters, in the body frame."
        )
    if poses_as:
        reading = pose_readings.READINGS[poses_as]
        warnings.append(f"{where}: {reading.problem}: {reading.mend}.")
    return dataclasses.replace(dataset, findings=findings, warnings=tuple(warnings))


def blamed(error: InputError, where: Path, findings: InputFindings) -> InputError:
    """The error about image and scan poses that disagree; about the scan poses where scans say how these are meant.

    where: the file of the scan poses
    """
    if findings.poses_as not in (pose_readings.W_FIRST, pose_readings.INVERSE):
        return error
    reading = pose_readings.READINGS[findings.poses_as]
    return InputError(where, f"{error.problem}; {reading.problem}", reading.mend)


def apart(scans: Trajectory, images: Trajectory) -> float:
    """s between the times of scans and those of images, where these do not overlap at all; else 0."""
    if not len(scans) or not len(images):
        return 0.0
    gap = float(max(images.times[0] - scans.times[-1], scans.times[0] - images.times[-1]))
    return gap if gap > _APART_S else 0.0


def _told(findings: InputFindings, scans: PosedFrames, pictures: PosedFrames | None) -> Iterator[str]:
    if findings.apart_s and pictures is not None:
        offset = pictures.poses.times[0] - scans.poses.times[0]
        yield (
            f"images run from {_span(pictures.poses)}, scans from {_span(scans.poses)}: their clocks or time zones "
            f"differ (first image {offset:+.3f} s after the first scan). Give both the times of one clock."
        )
    if count := findings.repeated_scans:
        yield (
            f"{count} of {len(scans.paths)} scans have the same contents as the one before: the sensor or its driver "
            "stood still. Leave them out."
        )
    if count := findings.repeated_poses:
        yield (
            f"{count} of {len(scans.paths)} scan poses are identical to the one before: there the odometry stood still."
        )
    if findings.speed_m_s:
        yield (
            f"scan poses move by {findings.speed_m_s:.0f} m/s (median): they seem to be in millimeters, or times "
            "not in seconds. Write meters and seconds."
        )


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.times[0]:.3f} to {trajectory.times[-1]:.3f} s"


def _repeated_files(fingerprints: Sequence[str]) -> int:
    """How many have the contents of the one before; of long recordings only sizes and change times are known: none."""
    contents = [fingerprint.split(" ")[-2:] for fingerprint in fingerprints]
    pairs = pairwise(contents)
    return sum(one == other and len(one[-1]) == _DIGEST_LETTERS for one, other in pairs)


def _repeated_poses(scans: Trajectory) -> int:
    steps = np.abs(np.diff(scans.world_from_sensor, axis=0)).max(axis=(1, 2), initial=0.0)
    return int(np.count_nonzero(steps <= _SAME_POSE))


def _speed(scans: Trajectory) -> float:
    """m/s from scan to scan, median."""
    if len(scans) < 3:
        return 0.0
    lengths = np.linalg.norm(np.diff(scans.world_from_sensor[:, :3, 3], axis=0), axis=1)
    return float(np.median(lengths / np.diff(scans.times)))


def _range(load: Callable[[int], np.ndarray], dataset: Dataset) -> float:
    """m: the least median distance of points from the sensor, of a few scans."""
    sampled = np.unique(np.linspace(0, len(dataset.scans) - 1, _SAMPLED).astype(int))
    distances = [
        np.median(np.linalg.norm(load(int(index)) - dataset.sensor_position_scan, axis=1))
        for index in sampled
    ]
    return float(min(distances))


def _absurd(value: float, most: float) -> float:
    """The value where it is more than what can be; else 0."""
    return value if value > most else 0.0
