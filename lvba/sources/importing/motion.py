"""How the LiDAR moves from pose to pose and within sweeps, as pairs of scans lie closest."""

from lvba.errors import InputError
from lvba.sources.importing import decision, inertial, readings, smoothing
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.options import ImportOptions
from lvba.sources.importing.readings import Reading, Scorer
from lvba.sources.importing.rig import RigFacts
from lvba.sources.importing.survey import Survey
from lvba.sources.importing.track import Track
from lvba.sources.importing.turning import TurningTrack


def decide(
    scorer: Scorer, reading: Reading, survey: Survey, rig: RigFacts, options: ImportOptions, where: str
) -> tuple[Track, tuple[Decision, ...]]:
    """World from LiDAR at any time, and what was decided of it.

    Raises InputError: an option says what is not possible here, or what the data contradict.
    """
    poses = readings.lidar_track(scorer.odometry, reading, scorer.extrinsics)
    tracks = _tracks(poses, survey, rig)
    said = options.conventions.get("motion", "")
    if said and said not in tracks:
        raise InputError(
            f"--convention motion={said}", "is not possible here", f"give one of {', '.join(tracks)}"
        )
    if not scorer.pairs:
        return tracks[said or "poses"], ()
    deskewed = reading.points == "deskewed"
    answers = [Answer(name, scorer.along(track, deskewed)) for name, track in tracks.items()]
    # the closest, significant or not: noise of single poses bends scans by more than pairs of scans show
    closest = min(answers, key=lambda answer: answer.score).name
    decided = decision.decide("motion", answers, said, closest, "m", where, known_by="data")
    return tracks[decided.taken], (decided,)


def _tracks(poses: Track, survey: Survey, rig: RigFacts) -> dict[str, Track]:
    """By the answers: along the poses, or smooth, with the gyroscope, or with both sensors of the IMU."""
    tracks: dict[str, Track] = {"poses": poses}
    if (smooth := smoothing.smooth(poses, None)) is not None:
        tracks["smooth"] = smooth
    turning = turnings.turning(survey.imu, rig.imu_from_lidar)
    if turning is None or survey.imu is None or rig.imu_from_lidar is None:
        return tracks
    tracks["gyroscope"] = TurningTrack(poses.times, poses.poses, turning)
    if (smooth := smoothing.smooth(poses, turning)) is not None:
        tracks["smooth_gyroscope"] = smooth
    if (moved := inertial.moved(poses, turning, survey.imu, rig.imu_from_lidar)) is not None:
        tracks["inertial"] = moved
    return tracks
