"""Reasons of the verdict that lie in the files of the recording: what was left out, repeated, or is meant otherwise."""

from collections.abc import Iterator

from lvba.io import pose_readings
from lvba.steps.verdict_figures import Figures, Reason

_MANY_SKIPPED = 0.1
"""Part of the scans or images above which those left out are a reason."""
_MANY_REPEATED, _MOST_REPEATED = 0.05, 0.5
"""Part of the scans above which repeated ones are a reason, and one not to rely on the result."""


def reasons(figures: Figures) -> Iterator[Reason]:
    """What the files say against the result."""
    yield from _skipped(figures)
    yield from _repeated(figures)
    yield from _misread(figures)


def _skipped(figures: Figures) -> Iterator[Reason]:
    for count, used, kind in (
        (figures.input.skipped_scans, figures.scans, "scan"),
        (figures.input.skipped_images, figures.images, "image"),
    ):
        if count > _MANY_SKIPPED * (count + used):
            yield Reason(
                f"{count} of {count + used} {kind} files were left out (see the warnings).",
                f"Give every {kind} a pose at its time, and copy files that are bad again.",
            )


def _repeated(figures: Figures) -> Iterator[Reason]:
    scans, poses = figures.input.repeated_scans, figures.input.repeated_poses
    if scans > _MANY_REPEATED * figures.scans:
        bad = scans > _MOST_REPEATED * figures.scans
        yield Reason(
            f"{scans} of {figures.scans} scans have the same contents as the one before.",
            "Leave them out; look at the driver of the sensor.",
            "bad" if bad else "check",
            more=True,
            unknown=bad,
        )
    if poses > _MANY_REPEATED * figures.scans:
        yield Reason(
            f"{poses} of {figures.scans} scan poses are identical to the one before: there the odometry stood still.",
            "Nothing to do if the sensor did, too; else run the odometry again.",
        )


def _misread(figures: Figures) -> Iterator[Reason]:
    findings = figures.input
    if findings.poses_as:
        reading, world = pose_readings.READINGS[findings.poses_as], findings.poses_as == pose_readings.WORLD
        yield Reason(
            f"{reading.problem[0].upper()}{reading.problem[1:]}.",
            f"{reading.mend[0].upper()}{reading.mend[1:]}.",
            "bad" if world else "check",
            more=True,
            unknown=world,
        )
    if findings.apart_s:
        yield Reason(
            f"Images and scans have no time in common: {findings.apart_s:.0f} s lie between them.",
            "Give both the times of one clock and time zone.",
        )
    if findings.speed_m_s:
        yield Reason(
            f"Scan poses move by {findings.speed_m_s:.0f} m/s (median): they seem to be in millimeters.",
            "Write meters, and times in seconds.",
            more=True,
        )
    if findings.range_m:
        yield Reason(
            f"Half of the points are more than {findings.range_m / 1000:.1f} km from the sensor: they seem to be in "
            "millimeters, or in the world frame.",
            "Write meters, in the body frame.",
            more=True,
        )
