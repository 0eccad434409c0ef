"""What whoever imports says of a source, and which of it is wanted."""

from collections.abc import Mapping
from dataclasses import dataclass

from lvba import settings
from lvba.arrays import Pose
from lvba.errors import InputError
from lvba.settings import setting

QUESTIONS = {
    "quaternions": ("xyzw", "wxyz"),
    "pose_direction": ("world_from", "inverse"),
    "pose_of": ("body", "lidar", "camera"),
    "points": ("raw", "deskewed"),
    "time": ("begin", "middle", "end"),
    "motion": ("poses", "smooth", "gyroscope", "smooth_gyroscope", "inertial"),
    "images": ("raw", "rectified"),
    "extrinsic": ("camera_from_lidar", "lidar_from_camera", "camera_link_from_lidar"),
    "image_offset": (),
    "imu_offset": (),
    "accelerometer": ("up", "down"),
}
"""What is decided, with the names of its answers; `time`, `image_offset` and `imu_offset` may also be seconds."""
IN_SECONDS = ("time", "image_offset", "imu_offset")
MOST_S = 4e9
"""Seconds, that int64 ns can hold beside times since 1970."""
AUTO = "auto"
"""As the odometry: by the scans."""
FRAME = "frame:"
"""Begins an answer to `pose_of` that is a frame of static transforms."""
NONE = "none"
"""As a topic: this kind of stream is not wanted."""


@dataclass(frozen=True)
class ImportOptions(settings.Group):
    """What is chosen of a source: said once for the command line, the service and its form. Topics are names of streams.

    odometry: a topic, a TUM file, "auto": by the scans, or a command with {bag} and {out}
    calibration: files of calibrations; conventions: answers to `QUESTIONS` that are not left to the data
    start, stop: s, since the first scan, or since 1970 where larger than 1e8; None: all
    """

    lidar: str = setting(
        "",
        meaning="Topic of the scans (default: the only one).",
        change_when="The recording has several LiDARs.",
    )
    image: str = setting(
        "",
        meaning="Topic of the images, or none (default: the only one).",
        change_when="The recording has several cameras, or one without a calibration.",
    )
    odometry: str = setting(
        "",
        meaning="Poses: a topic, a TUM file, or auto: by the scans and the IMU (default: the only topic).",
        change_when="The recording has several streams of poses, or none.",
    )
    imu: str = setting(
        "",
        meaning="Topic of the IMU, or none (default: the only one).",
        change_when="The recording has several IMUs.",
    )
    calibration: tuple[str, ...] = setting(
        (),
        meaning="Calibration files.",
        change_when="The recording does not say the intrinsics of its camera, or where it is on the LiDAR.",
    )
    camera: str = setting(
        "",
        meaning="Which camera, where a calibration file has several: its name there, or its topic (default: by the topic "
        "of the images).",
        change_when="A calibration file has several cameras.",
    )
    preset: str = setting(
        "",
        meaning="Public data set (docs/sources.md): its topics, and what is known of its clocks as a first guess.",
        change_when="The recording is of one.",
    )
    conventions: Mapping[str, str] = setting(
        {},
        meaning="Answers that are not left to the data, by question (docs/import.md); as pose_of: lidar.",
        change_when="A warning of an import says that the data cannot tell.",
        advanced=True,
    )
    start: float | None = setting(
        None,
        meaning="Start of what is imported, after the first scan, or since 1970.",
        unit="s",
        change_when="Only a part is wanted.",
        advanced=True,
    )
    stop: float | None = setting(
        None,
        meaning="End of what is imported, after the first scan, or since 1970.",
        unit="s",
        change_when="Only a part is wanted.",
        advanced=True,
    )
    every: int = setting(
        1,
        meaning="One scan in so many is imported; of a recording folder, one image in so many, too.",
        low=1,
        change_when="Scans are many more than are needed.",
        advanced=True,
    )
    rate: float = setting(
        0.0,
        meaning="At most so many scans and images a second are imported; 0: all.",
        unit="Hz",
        low=0.0,
        high=1e6,
        change_when="Scans or images are many more than are needed.",
        advanced=True,
    )


@dataclass(frozen=True)
class Guess:
    """What is likely of a source before its data are asked, which may contradict it. by: what says it

    stamp: what the LiDAR's stamp is of: begin, middle or end of a sweep, "": not known; image_offset: s, None: not known
    imu_from_lidar: (4, 4), m; None: not known
    """

    by: str = ""
    stamp: str = ""
    image_offset: float | None = None
    imu_from_lidar: Pose | None = None


NO_GUESS = Guess()
"""Nothing is known."""


def parse_conventions(texts: list[str]) -> dict[str, str]:
    """Answers by question, of texts like `pose_of=lidar`.

    Raises InputError: there is no such question or answer.
    """
    answers: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in QUESTIONS:
            raise InputError(f"--convention {text[:60]}", "is not known", f"one of {', '.join(QUESTIONS)}")
        if value == "auto":
            continue
        if name == "pose_of" and value.startswith(FRAME):
            answers[name] = value
            continue
        if value not in QUESTIONS[name] and not (name in IN_SECONDS and _is_number(value)):
            wanted = ", ".join((*QUESTIONS[name], *(["a number of seconds"] if name in IN_SECONDS else [])))
            raise InputError(
                f"--convention {name}", f"{value[:40]!r} is no answer", f"give {wanted}, or auto"
            )
        answers[name] = value
    return answers


def _is_number(text: str) -> bool:
    try:
        return abs(float(text)) < MOST_S
    except ValueError:
        return False
