"""A source to a recording folder: survey, conventions, files, evidence."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lvba import geometry
from lvba.dataset import BODY, DESKEWED_BY
from lvba.errors import InputError
from lvba.io import calibration, files, image_poses, scan_poses, tum
from lvba.io.dataset import IMAGE_POSES, SCAN_POSES
from lvba.progress import Progress, silent
from lvba.sources.importing import (
    clocks,
    data_set,
    folder,
    image_bits,
    imu_clock,
    own_odometry,
    pose_clock,
    rig,
    streams,
    survey,
    thinning,
)
from lvba.sources.importing import conventions as deciding
from lvba.sources.importing.clocks import Clocks
from lvba.sources.importing.conventions import Conventions, Origin
from lvba.sources.importing.imu_clock import ImuRead
from lvba.sources.importing.options import Guess, ImportOptions
from lvba.sources.importing.own_odometry import OwnOdometry
from lvba.sources.importing.rig import RigFacts
from lvba.sources.importing.selection import Selection
from lvba.sources.importing.streams import Streams
from lvba.sources.importing.survey import Survey
from lvba.sources.importing.track import Track
from lvba.sources.importing.writing import Writer, Written, stamp_text
from lvba.sources.source import Source, SourceDescription
from lvba.trajectory import Trajectory

Announce = Callable[[str, int, int], None]
"""Called as announce(name, index, total) when a pass begins."""


@dataclass(frozen=True)
class ImportReport:
    """What an import made: the facts of recording.yaml, and whether all of it was there before."""

    facts: dict[str, Any]
    reused: bool

    @property
    def warnings(self) -> list[str]:
        """One sentence each."""
        return [str(each) for each in self.facts.get("warnings", [])]


def import_source(
    source: Source,
    out: str | Path,
    options: ImportOptions | None = None,
    progress: Progress = silent,
    announce: Announce = silent,
) -> ImportReport:
    """Writes the recording folder of a source; continues where the same import was stopped, and gives the same bytes.

    Raises InputError: a stream, poses or a calibration are missing; data contradict what is said, or every way to read
    the source; the folder holds something else.
    """
    options, out = options or ImportOptions(), Path(out)
    description = source.describe()
    if thinning.is_meant(description, options):
        return _thinned(description, options, out, progress)
    _check_camera(options)
    known = data_set.of_source(description, options)
    chosen = streams.choose(description, options, known.topics)
    key = _key(description, options)
    if folder.prepare(out, key):
        return ImportReport(_read(out), reused=True)
    passes = 2 if chosen.odometry or chosen.odometry_file else 3
    announce("survey", 0, passes)
    source, surveyed, apart = _surveyed(source, chosen, options, progress)
    lost = list(source.losses())
    facts = rig.gather(
        options.calibration, source.geometry(), surveyed, chosen.image, options.camera, known.guess
    )
    _check_images(facts, surveyed, chosen, known.calibration, lost)
    origin, estimated = _origin(chosen), None
    if passes > 2:
        announce("odometry", 1, passes)
    if origin is Origin.OWN:
        wanted = Selection.of(options, surveyed.zero, 1)
        estimated = _own_odometry(source, chosen, surveyed, facts, known.guess, wanted, progress)
        odometry = estimated.track
    else:
        odometry, notes = _odometry(chosen, surveyed, description.path, options, progress)
        facts = replace(facts, notes=(*facts.notes, *notes))
    where = chosen.odometry_said
    decided = deciding.decide(surveyed, facts, odometry, origin, options, where, known.guess, apart)
    announce("write", passes - 1, passes)
    writer = Writer(out, surveyed, decided, options)
    frames = tuple(name for name in (chosen.lidar, chosen.image) if name)
    written = writer.write(source.records(chosen.written), _count(description, frames), progress)
    lost = list(dict.fromkeys([*lost, *source.losses()]))
    _check_written(written, chosen, odometry, surveyed)
    _write_texts(out, surveyed, facts, decided, written)
    evidence = _evidence(description, chosen, surveyed, facts, decided, written, lost)
    if known.facts:
        evidence["preset"] = dict(known.facts)
        evidence["warnings"] = [*known.warnings, *evidence["warnings"]]
    if estimated is not None:
        evidence["odometry"] = estimated.facts
        evidence["warnings"] = [*estimated.warnings, *evidence["warnings"]]
    _write_evidence(out, evidence)
    folder.finish(out, key)
    return ImportReport(evidence, reused=False)


def _surveyed(
    source: Source, chosen: Streams, options: ImportOptions, progress: Progress
) -> tuple[Source, Survey, Clocks]:
    """The source with its streams on one clock, its survey, and what was added to stamps for that."""
    description = source.describe()
    count = _count(description, chosen.surveyed)
    surveyed = survey.survey(source.records(chosen.surveyed), chosen, count, progress)
    apart = clocks.find(description, chosen, surveyed, options)
    if shifts := apart.shifts(chosen):
        source = clocks.OnOneClock(source, shifts)
        surveyed = survey.survey(source.records(chosen.surveyed), chosen, count, progress)
    return source, surveyed, apart


def _check_camera(options: ImportOptions) -> None:
    if options.camera and not options.calibration:
        raise InputError(
            f"--camera {options.camera[:80]}", "says nothing without a calibration", "give --calibration FILE"
        )


def _thinned(
    description: SourceDescription, options: ImportOptions, out: Path, progress: Progress
) -> ImportReport:
    key = _key(description, options)
    if folder.prepare(out, key):
        return ImportReport(_read(out), reused=True)
    facts = {"software": _software(), **thinning.thin(description.path, options, out, progress)}
    _write_evidence(out, facts)
    folder.finish(out, key)
    return ImportReport(facts, reused=False)


def _write_evidence(out: Path, facts: dict[str, Any]) -> None:
    head = "# How this recording was made of its source, what was decided about it, and by what.\n"
    text = yaml.safe_dump(facts, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    files.write_text(out / folder.RECORDING, head + text, durable=True)


def _key(description: SourceDescription, options: ImportOptions) -> str:
    """Equal for the same source and options."""
    asked = asdict(options)
    asked["files"] = [
        files.sha256(path)
        for path in (*options.calibration, options.odometry)
        if path and Path(path).is_file()
    ]
    name = Path(description.path).name
    seen = [name, description.format, description.size, [asdict(stream) for stream in description.streams]]
    text = json.dumps([seen, asked, _software()], default=str, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _software() -> str:
    return f"lvba {metadata.version('lvba')}"


def _read(out: Path) -> dict[str, Any]:
    facts = yaml.safe_load(files.read_text(out / folder.RECORDING))
    return facts if isinstance(facts, dict) else {}


def _count(description: SourceDescription, names: tuple[str, ...]) -> int:
    """Records of streams of these names; 0: unknown."""
    counts = [stream.count for stream in description.streams if stream.name in names]
    return 0 if None in counts else sum(count for count in counts if count is not None)


def _origin(chosen: Streams) -> Origin:
    if chosen.odometry:
        return Origin.STREAM
    return Origin.FILE if chosen.odometry_file or chosen.odometry_command else Origin.OWN


def _own_odometry(
    source: Source,
    chosen: Streams,
    surveyed: Survey,
    facts: RigFacts,
    guess: Guess,
    wanted: Selection,
    progress: Progress,
) -> OwnOdometry:
    """The poses that scans tell, and the IMU where there is one. guess: what is known of such recordings"""
    clock = deciding.clock_of(surveyed)
    late = deciding.imu_offset(clock, guess)
    on_clock = replace(surveyed, imu=imu_clock.shifted(surveyed.imu, late))
    return own_odometry.of_scans(source, chosen.lidar, on_clock, clock, facts, wanted, progress)


def _odometry(
    chosen: Streams, surveyed: Survey, path: str, options: ImportOptions, progress: Progress
) -> tuple[Track, tuple[str, ...]]:
    """The poses that are given, and notes on them. path: of the source

    Raises InputError: there are fewer than two poses, or they are of another clock.
    """
    notes: tuple[str, ...] = ()
    if chosen.odometry_command:
        command = chosen.odometry_command
        odometry, notes = own_odometry.of_command(command, path, surveyed, progress)
    elif chosen.odometry_file:
        odometry, notes = pose_clock.of_file(chosen.odometry_file, surveyed)
    elif surveyed.odometry is None or len(surveyed.odometry) < 2:
        raise InputError(chosen.odometry, "has fewer than two poses", "choose another one by --odometry")
    else:
        odometry = surveyed.odometry
    pose_clock.check(odometry, surveyed, chosen.odometry_said, options.conventions)
    return odometry, notes


def _check_images(
    facts: RigFacts, surveyed: Survey, chosen: Streams, where_it_is: str, lost: list[str]
) -> None:
    """where_it_is: the calibration, for people; "": not known; lost: what the survey could not read"""
    if not chosen.image:
        return
    missing = [
        words
        for words, value in (
            ("intrinsics of the camera", facts.camera),
            ("the extrinsic of camera and LiDAR", facts.camera_from_lidar),
        )
        if value is None
    ]
    if missing:
        raise InputError(
            chosen.image,
            f"nothing says {' and '.join(missing)}{_other_cameras(facts, surveyed)}{_lost(chosen, lost)}",
            "give --calibration FILE, or --image none to do without images"
            + (f" ({where_it_is})" if where_it_is else ""),
        )
    if not len(surveyed.image_stamps) or not surveyed.image_size[0]:
        raise InputError(
            chosen.image, "has no image that can be decoded", "choose another by --image, or --image none"
        )


def _other_cameras(facts: RigFacts, surveyed: Survey) -> str:
    """Which camera infos are not taken for that of the images, where there is none; "": none."""
    if facts.camera is not None or not surveyed.other_cameras:
        return ""
    return f" (not taken for its camera: {', '.join(surveyed.other_cameras[:8])})"


def _lost(chosen: Streams, lost: list[str]) -> str:
    """What was lost of camera infos and transforms, which might say it."""
    lines = [each for each in lost if each.partition(": ")[0] in chosen.others]
    return f" ({'; '.join(lines[:3])})" if lines else ""


def _check_written(written: Written, chosen: Streams, odometry: Track, surveyed: Survey) -> None:
    if len(written.scans) < 2:
        where = chosen.odometry or chosen.odometry_file
        raise pose_clock.outside(odometry, surveyed, where, len(written.scans))
    left_out = [each for each in written.sentences() if " images " in each and "of the poses" in each]
    if chosen.image and left_out and not written.images:
        raise InputError(
            chosen.image,
            f"no image lies between poses: {', '.join(left_out)}: its clock differs from theirs",
            "give --convention image_offset=SECONDS, to be added to its stamps, or --image none",
        )


def _write_texts(
    out: Path, surveyed: Survey, facts: RigFacts, decided: Conventions, written: Written
) -> None:
    """Poses and calibration."""
    lidar_from_body = geometry.inverse(decided.body_from_lidar)
    for name, stamps, comment in (
        (
            SCAN_POSES,
            written.scans,
            scan_poses.comment(DESKEWED_BY if decided.deskews else ()),
        ),
        (IMAGE_POSES, written.images, image_poses.comment(BODY)),
    ):
        if not stamps:
            continue
        times = surveyed.seconds(np.array(stamps, np.int64))
        lines = [stamp_text(stamp) for stamp in stamps]
        text = tum.trajectory_text(
            Trajectory(times, decided.lidar.at(times) @ lidar_from_body), comment=comment, stamps=lines
        )
        files.write_text(out / name, text)
    camera = decided.images.camera if decided.images is not None and written.images else None
    extrinsic = decided.camera_from_lidar if written.images else None
    more = {image_poses.KEY: BODY} if written.images else None
    body_from_imu = _body_from_imu(facts, decided)
    config = calibration.recording_text(camera, decided.body_from_lidar, extrinsic, more, body_from_imu)
    files.write_text(out / "config.yaml", config)


def _body_from_imu(facts: RigFacts, decided: Conventions) -> np.ndarray | None:
    """(4, 4), of the frame that scans are written in; None: it is the IMU, not known, or there is no IMU."""
    if facts.imu_from_lidar is None or decided.imu.left_out:
        return None
    body_from_imu = np.asarray(decided.body_from_lidar @ geometry.inverse(facts.imu_from_lidar))
    return None if np.allclose(body_from_imu, np.eye(4), rtol=0, atol=1e-12) else body_from_imu


def _evidence(
    description: SourceDescription,
    chosen: Streams,
    surveyed: Survey,
    facts: RigFacts,
    decided: Conventions,
    written: Written,
    lost: list[str],
) -> dict[str, Any]:
    used = {name: getattr(chosen, name) for name in ("lidar", "image", "imu", "gnss", "odometry")}
    if not chosen.odometry:
        used["odometry"] = Path(chosen.odometry_file).name if chosen.odometry_file else chosen.odometry_said
    decisions = (*decided.scans.decisions, *decided.imu.decisions, *decided.motion)
    answers = {each.question: each.facts() for each in decisions}
    if decided.images is not None:
        answers |= {each.question: each.facts() for each in decided.images.decisions}
    reading = decided.scans
    result: dict[str, Any] = {
        "source": {
            "name": Path(description.path).name,
            "format": description.format,
            "bytes": description.size,
        },
        "software": _software(),
        "streams": {name: value for name, value in used.items() if value},
        "written": {"scans": len(written.scans), "images": len(written.images)},
        "times_of_points": {"read_as": decided.clock.words},
        "conventions": answers,
        "applied": {
            "poses_hold_after_their_stamp_s": round(reading.reading.shift, 6),
            "added_to_stamps_of_images_s": round(decided.clocks.image + decided.image_offset, 6),
            "added_to_stamps_of_imu_s": round(decided.clocks.imu + decided.imu.offset, 6),
            **_applied_to_imu(decided.imu),
        },
        "evidence": {
            "pairs_of_scans": reading.pairs,
            "distance_of_scans_m": _rounded(reading.thickness),
            "distance_within_scans_m": _rounded(reading.floor),
            "poses_hold_after_their_stamp_s": _measured(reading.measured, reading.measured_sigma),
            "imu_read_after_its_stamp_s": _measured(
                decided.clocks.imu + decided.imu.measured, decided.imu.measured_sigma
            ),
            **_of_images(decided),
        },
        "calibration": dict(facts.origins),
        "losses": [*lost, *written.sentences()],
        "notes": [*description.notes, *facts.notes, *image_bits.notes(surveyed.image_bits)],
        "warnings": list(decided.warnings),
    }
    return result


def _applied_to_imu(read: ImuRead) -> dict[str, Any]:
    """What is done to its readings, where anything is."""
    if read.left_out:
        return {"imu": "left out"}
    factors = {"imu_rates_times": read.rates, "imu_forces_times": read.forces}
    return {name: round(factor, 9) for name, factor in factors.items() if factor != 1.0}


def _of_images(decided: Conventions) -> dict[str, Any]:
    if decided.images is None:
        return {}
    images = decided.images
    measured = _measured(decided.clocks.image + images.measured, images.measured_sigma)
    return {"pairs_of_images": images.pairs, "images_taken_after_their_stamp_s": measured}


def _measured(value: float, sigma: float) -> dict[str, float] | None:
    """None: it could not be measured."""
    if not np.isfinite(sigma):
        return None
    return {"measured": round(value, 5), "standard_deviation": round(sigma, 5)}


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None
