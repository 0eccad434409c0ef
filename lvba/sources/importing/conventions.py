"""All that is decided about a source from its survey: clocks, what poses are of, and how images are read."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.errors import InputError
from lvba.sources.importing import (
    camera_choice,
    image_readings,
    imu_clock,
    motion,
    point_clock,
    readings,
)
from lvba.sources.importing.clocks import ONE, Clocks, name_of
from lvba.sources.importing.decision import Decision
from lvba.sources.importing.image_readings import ImageScorer, ImagesRead, TimedImage
from lvba.sources.importing.imu_clock import ImuRead
from lvba.sources.importing.options import FRAME, NO_GUESS, Guess, ImportOptions
from lvba.sources.importing.point_clock import ScanClock
from lvba.sources.importing.readings import Choices, Extrinsics, Reading, ScansRead, Scorer
from lvba.sources.importing.rig import TRANSFORMS, RigFacts
from lvba.sources.importing.survey import Survey
from lvba.sources.importing.thickness import TimedScan
from lvba.sources.importing.track import Track

_SAME_STAMP_S = 2e-3
_SAME_OFFSET_S = 5e-3
_LATER_S = (0.2, -0.2, 0.3, -0.3)
"""Offsets that are tried beside usual ones where clocks are known by when records were recorded, which may be so late."""
_AGREEING = 0.9
_OF_IMAGES = ("images", "extrinsic", "image_offset")
_FORMAT, _FRAMES = "the format", "names of frames"


@dataclass(frozen=True)
class Conventions:
    """What holds of a source.

    lidar: world from LiDAR, on the clock of the points; motion: how it moves from pose to pose
    scans, imu, images: what was decided, and from what; images: None without images
    body_from_lidar: (4, 4), of the frame that scans are written in; camera_from_lidar: (4, 4), None without images
    clocks: what stamps had been added before anything was decided
    """

    clock: ScanClock
    lidar: Track
    motion: tuple[Decision, ...]
    scans: ScansRead
    imu: ImuRead
    images: ImagesRead | None
    body_from_lidar: np.ndarray
    camera_from_lidar: np.ndarray | None
    clocks: Clocks
    warnings: tuple[str, ...]

    @property
    def deskews(self) -> bool:
        """Whether points have times and are not yet as seen at the stamp."""
        return bool(self.clock.unit) and self.scans.reading.points != "deskewed"

    @property
    def image_offset(self) -> float:
        """s, added to stamps of images, beside what `clocks` adds."""
        return 0.0 if self.images is None else self.images.reading.offset


class Origin(StrEnum):
    """Where poses come from: a stream of the source, a file (quaternions may be w first), or lvba's own odometry."""

    STREAM = "stream"
    FILE = "file"
    OWN = "own"


def clock_of(survey: Survey) -> ScanClock:
    """What times of points count, by the samples of scans."""
    samples = [scan for segment in survey.segments for scan in segment.scans]
    stamps = np.array([scan.stamp for scan in samples], np.int64)
    return point_clock.find([scan.times for scan in samples], stamps, _period(survey))


def _period(survey: Survey) -> float:
    """s, from scan to scan."""
    return float(np.median(np.diff(survey.scan_stamps)) * 1e-9) if len(survey.scan_stamps) > 1 else 0.1


def decide(
    survey: Survey,
    rig: RigFacts,
    odometry: Track,
    origin: Origin,
    options: ImportOptions,
    where: str,
    guess: Guess = NO_GUESS,
    clocks: Clocks = ONE,
) -> Conventions:
    """The conventions of a source. guess: what is likely, which the data may contradict; clocks: what was added to stamps

    Raises InputError: data contradict what options say, or every reading.
    """
    period, clock = _period(survey), clock_of(survey)
    segments = [
        [_timed(scan.stamp, scan.points, scan.times, survey, clock) for scan in segment.scans]
        for segment in survey.segments
    ]
    extrinsics = _extrinsics(rig, survey)
    choices = _choices(survey, rig, odometry, origin, clock, period, extrinsics, options, guess)
    scorer = Scorer(odometry, extrinsics, readings.pairs_of(segments, odometry))
    scans_read = readings.find(scorer, choices, clock.sweep, where)
    imu = _imu(scorer, scans_read.reading, survey, rig, clock, options, where, guess, clocks.imu)
    survey = replace(survey, imu=imu.mended(survey.imu))
    lidar, moved_by = motion.decide(scorer, scans_read.reading, survey, rig, options, where)
    warnings = [*clocks.warnings, *scans_read.warnings, *imu.warnings]
    if guess.by and choices.known_by.get("time") == guess.by:
        [time] = [each for each in scans_read.decisions if each.question == "time"]
        against = time.against(next(iter(choices.shifts)), guess.by)
        warnings += [against] if against else []
    if not clock.unit and scans_read.reading.points == "raw" and not rig.deskewed:
        warnings.append(f"points: {clock.words}: the motion during a scan is not taken out of it")
    images = None
    if rig.camera is not None and rig.camera_from_lidar is not None and len(survey.image_stamps):
        reading = scans_read.reading
        images = _images(survey, rig, lidar, segments, reading, clock, options, where, guess, clocks.image)
        warnings += images.warnings
    pose_of = scans_read.reading.pose_of
    body = np.eye(4) if pose_of in ("lidar", "camera") else extrinsics.child_from_lidar[pose_of]
    if _body_is_open(survey, rig, extrinsics) and "pose_of" not in options.conventions:
        warnings.append(
            f"pose_of: nothing says where the body (IMU) is beside the LiDAR: poses are taken for the {pose_of}'s; "
            f"give --calibration FILE, or --convention pose_of={pose_of} if that is so"
        )
    extrinsic = None
    if images is not None and rig.camera_from_lidar is not None:
        extrinsic = images.reading.camera_from_lidar(rig.camera_from_lidar)
    return Conventions(
        clock=clock,
        lidar=lidar,
        motion=moved_by,
        scans=scans_read,
        imu=imu,
        images=images,
        body_from_lidar=body,
        camera_from_lidar=extrinsic,
        clocks=clocks,
        warnings=tuple(warnings),
    )


def _imu(
    scorer: Scorer,
    reading: Reading,
    survey: Survey,
    rig: RigFacts,
    clock: ScanClock,
    options: ImportOptions,
    where: str,
    guess: Guess,
    added: float,
) -> ImuRead:
    """When the IMU was read: as stamped, or beside points that are some part of a sweep late or early.

    added: s, to its stamps, before
    """
    first, sweep = imu_offset(clock, guess), clock.sweep
    offsets = _named((first, 0.0, sweep, -sweep, sweep / 2, -sweep / 2), added)
    said = options.conventions.get(imu_clock.QUESTION, "")
    if said and said not in offsets:
        offsets[said] = float(said) - added
    poses = readings.lidar_track(scorer.odometry, reading, scorer.extrinsics)
    known_by = guess.by if first else ""
    read = imu_clock.find(
        poses, survey.imu, rig.imu_from_lidar, offsets, options.conventions, where, known_by, added
    )
    against = read.decisions[0].against(next(iter(offsets)), known_by) if read.decisions else ""
    return replace(read, warnings=(*read.warnings, against)) if against else read


def _named(values: Iterable[float], added: float) -> dict[str, float]:
    """Offsets (s) that are 5 ms apart, the first of those that are not, by their names. added: s, to stamps, before"""
    offsets: dict[str, float] = {}
    for value in values:
        if all(abs(value - other) > _SAME_OFFSET_S for other in offsets.values()):
            offsets[name_of(value, added)] = value
    return offsets


def imu_offset(clock: ScanClock, guess: Guess) -> float:
    """s, what is added to stamps of the IMU by what is known beforehand of those of scans."""
    late = _stamped(clock, guess) or 0.0
    return late if abs(late) > 0.02 * clock.sweep else 0.0


def _timed(
    stamp: int, points: np.ndarray, times: np.ndarray | None, survey: Survey, clock: ScanClock
) -> TimedScan:
    after = clock.of_times(times, stamp, len(points))
    return readings.timed(float(survey.seconds(np.array([stamp]))[0]), after, points)


def _extrinsics(rig: RigFacts, survey: Survey) -> Extrinsics:
    """What poses may be of, the likely one first. Without an extrinsic of the body, it is the LiDAR."""
    known: dict[str, np.ndarray] = {}
    if rig.body_from_lidar is not None and not _same(rig.body_from_lidar, np.eye(4)):
        known["body"] = rig.body_from_lidar
    known["lidar"] = np.eye(4)
    if rig.camera_from_lidar is not None and not _same(rig.camera_from_lidar, np.eye(4)):
        known["camera"] = rig.camera_from_lidar
    for name, frame_from_lidar in rig.frames.items():
        if not any(_same(frame_from_lidar, other) for other in known.values()):
            known[f"{FRAME}{name}"] = frame_from_lidar
    if survey.child and survey.child == survey.lidar_frame:
        known = {"lidar": known["lidar"], **known}
    return Extrinsics(known)


def _frame(named: str, survey: Survey, rig: RigFacts, extrinsics: Extrinsics) -> str:
    """What poses are said to be of, by its name among the answers: a body or an IMU may be where the LiDAR is."""
    places = {
        "body": rig.body_from_lidar,
        f"{FRAME}{survey.imu_frame}": rig.imu_from_lidar,
        f"{FRAME}{survey.lidar_frame}": np.eye(4),
    }
    place = places.get(named)
    same = (
        n for n, other in extrinsics.child_from_lidar.items() if place is not None and _same(place, other)
    )
    return named if named in extrinsics.child_from_lidar else next(same, named)


def _body_is_open(survey: Survey, rig: RigFacts, extrinsics: Extrinsics) -> bool:
    """Whether poses may be of a body that nothing is known of."""
    if rig.deskewed or rig.body_from_lidar is not None or survey.child == survey.lidar_frame != "":
        return False
    return not set(extrinsics.child_from_lidar) - {"lidar", "camera"}


def _same(one: Pose, other: Pose) -> bool:
    """Whether two transforms can hardly be told apart."""
    off = geometry.log(geometry.inverse(one) @ other)
    return bool(np.linalg.norm(off[:3]) < 1e-3 and np.linalg.norm(off[3:]) < 1e-3)


def _choices(
    survey: Survey,
    rig: RigFacts,
    odometry: Track,
    origin: Origin,
    clock: ScanClock,
    period: float,
    extrinsics: Extrinsics,
    options: ImportOptions,
    guess: Guess,
) -> Choices:
    said = {name: value for name, value in options.conventions.items() if name in readings.ORDER}
    if "pose_of" in said:
        said["pose_of"] = _frame(said["pose_of"], survey, rig, extrinsics)
    points = ("raw", "deskewed") if clock.unit else ("raw",)
    every: dict[str, tuple[str, ...]] = {
        "quaternions": ("xyzw", "wxyz") if origin is Origin.FILE else ("xyzw",),
        "pose_direction": ("world_from",) if origin is Origin.OWN else ("world_from", "inverse"),
        "pose_of": ("lidar",) if origin is Origin.OWN else tuple(extrinsics.child_from_lidar),
        "points": ("deskewed",) if rig.deskewed else points,
    }
    for name, answers in every.items():
        if name in said and said[name] not in answers:
            raise InputError(
                f"--convention {name}={said[name]}",
                "is not possible here",
                f"give one of {', '.join(answers)}",
            )
    shifts = {"as estimated": 0.0} if origin is Origin.OWN else _shifts(survey, odometry, clock, period)
    known = {"points": _FORMAT, "time": _FORMAT, "pose_direction": _FORMAT} if rig.deskewed else {}
    stamped = _stamped(clock, guess)
    if stamped is not None and origin is not Origin.OWN and not rig.deskewed:
        shifts, known["time"] = _first(shifts, stamped, 0.02 * clock.sweep, "{:+.3f}"), guess.by
    if "time" in said and said["time"] not in shifts:
        if said["time"] in ("begin", "middle", "end"):
            raise InputError(
                f"--time-convention {said['time']}",
                "says nothing here: the stamps of poses are not those of scans, or points have no times",
                "give --convention time=SECONDS, from the stamp of a pose to when it holds",
            )
        shifts = {said["time"]: float(said["time"]), **shifts}
    if survey.child and survey.child == survey.lidar_frame:
        known["pose_of"] = _FRAMES
    return Choices(**every, shifts=shifts, said=said, known_by=known)


def _shifts(survey: Survey, odometry: Track, clock: ScanClock, period: float) -> dict[str, float]:
    """s, by name, what is tried: as stamped first. Poses with stamps of scans may be of the start, middle or end."""
    sweep = clock.sweep or period
    values = [0.0, -sweep / 2, sweep / 2, -sweep, sweep]
    named: dict[str, float] = {}
    if clock.unit and _stamps_of_scans(survey, odometry):
        named = {
            name: clock.begin + part * sweep for name, part in (("begin", 0), ("middle", 0.5), ("end", 1))
        }
    shifts = {name: value for name, value in named.items() if abs(value) < 0.02 * sweep}
    if not shifts:
        shifts = {"as stamped": 0.0}
    for name, value in (*named.items(), *((f"{value:+.3f}", value) for value in values)):
        if all(abs(value - other) > 0.02 * sweep for other in shifts.values()):
            shifts[name] = value
    return shifts


def _stamped(clock: ScanClock, guess: Guess) -> float | None:
    """s from a scan's stamp to the moment that it is of, on the clock of the points; None: nothing says it.

    A driver that stamps the end of a sweep and counts times of points from 0 has points one sweep late: what other
    sensors stamp at the same time is one sweep later on the clock of the points.
    """
    if not guess.stamp or not clock.unit:
        return None
    return clock.begin + {"begin": 0.0, "middle": 0.5, "end": 1.0}[guess.stamp] * clock.sweep


def _first(values: dict[str, float], value: float, near: float, form: str) -> dict[str, float]:
    """Values by name, with what is within `near` of this value first; a new one where there is none."""
    name = min(values, key=lambda each: abs(values[each] - value))
    if abs(values[name] - value) > near:
        name = form.format(value)
    return {name: values.get(name, value), **values}


def _stamps_of_scans(survey: Survey, odometry: Track) -> bool:
    """Whether poses have the stamps of scans."""
    stamps = survey.seconds(survey.scan_stamps)
    inside = odometry.times[(odometry.times >= stamps[0]) & (odometry.times <= stamps[-1])]
    if not len(inside):
        return False
    after = (
        np.clip(np.searchsorted(stamps, inside), 1, len(stamps) - 1)
        if len(stamps) > 1
        else np.zeros(len(inside), int)
    )
    nearest = np.minimum(np.abs(stamps[after] - inside), np.abs(stamps[after - 1] - inside))
    return bool(np.mean(nearest < _SAME_STAMP_S) >= _AGREEING)


def _images(
    survey: Survey,
    rig: RigFacts,
    lidar: Track,
    segments: list[list[TimedScan]],
    reading: Reading,
    clock: ScanClock,
    options: ImportOptions,
    where: str,
    guess: Guess,
    added: float,
) -> ImagesRead:
    """How images are read. added: s, to their stamps, before"""
    assert rig.camera is not None
    assert rig.camera_from_lidar is not None
    offsets, known_by = _offsets(survey, rig, clock, guess, added)
    guessed = next(iter(offsets))
    said = {name: value for name, value in options.conventions.items() if name in _OF_IMAGES}
    if "image_offset" in said and said["image_offset"] not in offsets:
        offsets = {said["image_offset"]: float(said["image_offset"]) - added, **offsets}
    reach = max(abs(value) for value in offsets.values())
    ranked = []
    for number, (segment, scans) in enumerate(zip(survey.segments, segments, strict=True)):
        placed = [
            scan.in_world(lidar, reading.points == "deskewed")
            for scan in scans
            if lidar.covers(*scan.span) and len(scan.points)
        ]
        if not placed:
            continue
        stamps = survey.seconds(np.array([image.stamp for image in segment.images], np.int64))
        images = [
            TimedImage(float(stamp), image.gray, rig.camera.scaled(image.factor))
            for image, stamp in zip(segment.images, stamps, strict=True)
        ]
        ranked.append(image_readings.pairs_of(images, lidar, np.concatenate(placed), reach, number))
    pairs = [ranks[rank] for rank in range(6) for ranks in ranked if len(ranks) > rank]
    scorer = ImageScorer(lidar, rig.camera_from_lidar, pairs[: image_readings.MOST_PAIRS], added)
    scorer, camera, chosen = camera_choice.choose(scorer, rig, offsets, said, where)
    by_frames = rig.origins.get("camera_from_lidar") == TRANSFORMS
    find = image_readings.find_with_links if by_frames else image_readings.find
    read = find(scorer, offsets, said, where, known_by)
    against = read.decisions[-1].against(guessed, known_by)
    warnings = (*(each.warning for each in chosen), *read.warnings, against)
    return replace(
        read,
        camera=camera,
        decisions=(*chosen, *read.decisions),
        warnings=tuple(words for words in warnings if words),
    )


def _offsets(
    survey: Survey, rig: RigFacts, clock: ScanClock, guess: Guess, added: float
) -> tuple[dict[str, float], str]:
    """s, by name: what a calibration or a guess says, or none; a period of the camera, and parts of a sweep, either way.

    And what says the first of them, beside the data; "": it is none, or of a calibration.
    added: s, to stamps, before; a calibration may be of stamps without or with it
    """
    period = float(np.median(np.diff(survey.image_stamps)) * 1e-9) if len(survey.image_stamps) > 1 else 0.1
    stamped = imu_offset(clock, guess)
    guessed = stamped + (guess.image_offset or 0.0)
    known_by = guess.by if rig.image_offset is None and (guess.image_offset is not None or stamped) else ""
    first = guessed if rig.image_offset is None else rig.image_offset
    if abs(first - added) < abs(first):
        first -= added
    sweep = clock.sweep
    usual = (first, guessed, 0.0, period, -period, sweep, -sweep, sweep / 2, -sweep / 2)
    offsets = _named((*usual, *(_LATER_S if added else ())), added)
    return offsets, known_by
