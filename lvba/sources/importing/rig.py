"""Extrinsics of the sensors, and the camera: from files that are given, the source's own, and what drivers publish."""

import contextlib
from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_config
from lvba.io.image_header import ImageSize
from lvba.sources import calibrations
from lvba.sources.camera_topics import CameraTopic
from lvba.sources.importing.options import NO_GUESS, Guess
from lvba.sources.importing.survey import Survey
from lvba.sources.source import KnownGeometry

TRANSFORMS = "static transforms"
"""Origin of what they say."""
_MOST_FRAMES = 8
"""That poses may be of, where nothing says which."""


@dataclass(frozen=True)
class RigFacts:
    """What is known of the rig before data are asked.

    camera: of the images' size; other_camera, rectified: as of `CameraInfo`
    camera_from_lidar, body_from_lidar: (4, 4); each None: not known
    imu_from_lidar: (4, 4), None: not known, or there is no IMU
    imu_from_camera: (4, 4), what a calibration says, None: it does not
    image_offset: s, what a calibration says that is added to stamps of images; None: nothing says it
    frames: by name, what static transforms say beside: (4, 4), frame from LiDAR
    origins: where each comes from, by name
    deskewed: the source says that its points have no motion left
    """

    camera: Camera | None = None
    other_camera: Camera | None = None
    rectified: bool = False
    camera_from_lidar: np.ndarray | None = None
    body_from_lidar: np.ndarray | None = None
    imu_from_lidar: np.ndarray | None = None
    image_offset: float | None = None
    imu_from_camera: np.ndarray | None = None
    frames: dict[str, np.ndarray] = field(default_factory=dict)
    origins: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    deskewed: bool = False


def gather(
    files: tuple[str, ...],
    known: KnownGeometry,
    survey: Survey,
    image_topic: str,
    camera: str = "",
    guess: Guess = NO_GUESS,
) -> RigFacts:
    """What is known: files that are given count more than the source's own, these more than drivers' messages, and
    these more than a guess.

    camera: which one of files that have several; "": that of the topic

    Raises InputError: a file cannot be read as a calibration, or is of images of another shape; there is no such camera.
    """
    facts = RigFacts(deskewed=known.deskewed)
    size = ImageSize(*survey.image_size) if survey.image_size[0] else None
    if files:
        facts = _of_files(facts, files, size, image_topic, camera)
    facts = _filled(
        facts, known.camera, known.camera_from_lidar, known.body_from_lidar, "the source's own files"
    )
    if survey.camera is not None:
        facts = _of_info(facts, survey.camera)
    facts = _filled(facts, None, *_of_transforms(survey), TRANSFORMS)
    facts = _filled(facts, None, None, guess.imu_from_lidar, guess.by)
    if facts.body_from_lidar is None:
        names = sorted(
            {name for pair in survey.static or survey.repeated for name in pair}
            - {survey.lidar_frame, survey.image_frame}
        )
        ways = {name: _from_lidar(survey, name) for name in names[:_MOST_FRAMES]}
        facts = replace(facts, frames={name: way for name, way in ways.items() if way is not None})
    facts = _with_imu(facts if size is None else _sized(facts, size), survey)
    return _with_camera_on_imu(facts)


def _of_info(facts: RigFacts, info: CameraTopic) -> RigFacts:
    if facts.camera is not None:
        return facts
    facts = _filled(facts, info.camera, None, None, f"camera info {info.name}")
    return replace(facts, other_camera=info.other, rectified=info.rectified)


def _sized(facts: RigFacts, size: ImageSize) -> RigFacts:
    """With cameras of images of this size. Raises InputError: the camera is of others"""
    if facts.camera is None:
        return facts

    def sized(camera: Camera) -> Camera:
        fitted = camera_config.fitted if camera.width else calibrations.sized
        return fitted(camera, size, facts.origins["camera"])

    other = None
    if facts.other_camera is not None:
        with contextlib.suppress(InputError):  # that of images that these are not
            other = sized(facts.other_camera)
    return replace(facts, camera=sized(facts.camera), other_camera=other)


def _with_camera_on_imu(facts: RigFacts) -> RigFacts:
    """The same with the extrinsic that follows from where files say the camera is on the IMU, where nothing says it."""
    lidar, where = facts.imu_from_lidar, facts.origins.get("imu_from_lidar", "")
    if lidar is None and facts.origins.get("body_from_lidar", TRANSFORMS) != TRANSFORMS:
        lidar, where = facts.body_from_lidar, facts.origins["body_from_lidar"]
    if facts.camera_from_lidar is not None or facts.imu_from_camera is None or lidar is None:
        return facts
    origins = facts.origins | {"camera_from_lidar": f"{facts.origins['body_from_camera']}, {where}"}
    camera_from_lidar = np.asarray(geometry.inverse(facts.imu_from_camera) @ lidar)
    return replace(facts, camera_from_lidar=camera_from_lidar, origins=origins)


def _with_imu(facts: RigFacts, survey: Survey) -> RigFacts:
    """The same with the extrinsic of the IMU: the body of a calibration is the IMU, that of transforms may be another
    frame; one frame for two sensors is one extrinsic."""
    if survey.imu is None:
        return facts
    where = facts.origins.get("body_from_lidar", "")
    imu_from_lidar = facts.body_from_lidar
    if not where or where == TRANSFORMS:
        imu_from_lidar = _from_lidar(survey, survey.imu_frame)
        where = TRANSFORMS
    if imu_from_lidar is None and survey.imu_frame and survey.imu_frame == survey.lidar_frame:
        imu_from_lidar, where = np.eye(4), "names of frames"
    if imu_from_lidar is None:
        return facts
    origins = facts.origins | {"imu_from_lidar": where}
    return replace(facts, imu_from_lidar=imu_from_lidar, origins=origins)


def _of_files(
    facts: RigFacts, files: tuple[str, ...], size: ImageSize | None, topic: str, asked: str
) -> RigFacts:
    rig = calibrations.read(files, asked or topic)
    if asked and not _is_of(rig, asked):
        seen = ", ".join([*rig.names, *([rig.topic] if rig.topic else [])])
        raise InputError(f"--camera {asked[:80]}", f"the calibration is of {seen}", "give one of these")
    camera = rig.camera_for(size) if size is not None else None
    filled = replace(
        facts,
        camera=camera,
        camera_from_lidar=rig.camera_from_lidar,
        body_from_lidar=rig.body_from_lidar,
        imu_from_camera=rig.body_from_camera,
        image_offset=rig.camera_time_offset_s,
        notes=rig.notes,
    )
    return replace(filled, origins=dict(rig.origins))


def _is_of(rig: calibrations.RigCalibration, asked: str) -> bool:
    """Whether the camera of a calibration may be the one that is asked for, by name or topic; without both it may."""
    same = rig.topic.strip("/") == asked.strip("/").removesuffix("/compressed")
    return same or not (rig.names or rig.topic) or any(name in asked.split("/") for name in rig.names)


def _filled(
    facts: RigFacts,
    camera: Camera | None,
    camera_from_lidar: Pose | None,
    body_from_lidar: Pose | None,
    where: str,
) -> RigFacts:
    new = {"camera": camera, "camera_from_lidar": camera_from_lidar, "body_from_lidar": body_from_lidar}
    missing = {name for name, value in new.items() if value is not None and getattr(facts, name) is None}
    return replace(
        facts,
        camera=camera if "camera" in missing else facts.camera,
        camera_from_lidar=camera_from_lidar if "camera_from_lidar" in missing else facts.camera_from_lidar,
        body_from_lidar=body_from_lidar if "body_from_lidar" in missing else facts.body_from_lidar,
        origins=facts.origins | dict.fromkeys(sorted(missing), where),
    )


def _of_transforms(survey: Survey) -> tuple[np.ndarray | None, np.ndarray | None]:
    """camera_from_lidar and body_from_lidar by static transforms, each None where these do not lead there.

    The body is what the odometry says that it is of, or else the frame of the IMU.
    """
    body = _from_lidar(survey, survey.child)
    body = _from_lidar(survey, survey.imu_frame) if body is None else body
    return _from_lidar(survey, survey.image_frame), body


def _from_lidar(survey: Survey, frame: str) -> np.ndarray | None:
    """(4, 4), a frame from the LiDAR's, by static transforms, else also by those that are repeated and never change; None
    where there is no way."""
    way = static_transform(survey.static, frame, survey.lidar_frame)
    if way is None and survey.repeated:
        way = static_transform(survey.repeated | survey.static, frame, survey.lidar_frame)
    return way


def static_transform(static: dict[tuple[str, str], np.ndarray], target: str, start: str) -> np.ndarray | None:
    """(4, 4), target from start, along transforms between them; None where there is no way."""
    if not target or not start:
        return None
    reached = {start: np.eye(4)}
    while target not in reached:
        count = len(reached)
        for (parent, child), parent_from_child in static.items():
            if child in reached and parent not in reached:
                reached[parent] = parent_from_child @ reached[child]
            elif parent in reached and child not in reached:
                reached[child] = geometry.inverse(parent_from_child) @ reached[parent]
        if len(reached) == count:
            return None
    return reached[target]
