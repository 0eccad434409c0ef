"""Which streams of a source are imported: those asked for, else the only fitting ones."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lvba.errors import InputError
from lvba.sources import choosing, packets
from lvba.sources.importing.options import AUTO, NONE, ImportOptions
from lvba.sources.odometry import external
from lvba.sources.source import Kind, SourceDescription, Stream


@dataclass(frozen=True)
class Streams:
    """Names of streams; "": there is none.

    odometry_file: a TUM file in place of a stream; odometry_command: a program that writes one; of both "" and no stream:
    lvba's own odometry
    others: camera info and transforms, which are all read
    """

    lidar: str
    image: str
    imu: str
    gnss: str
    odometry: str
    odometry_file: str
    odometry_command: str
    others: tuple[str, ...]

    @property
    def odometry_said(self) -> str:
        """Where poses come from, for people."""
        return self.odometry or self.odometry_file or self.odometry_command or f"--odometry {AUTO}"

    @property
    def surveyed(self) -> tuple[str, ...]:
        """What is read to find the conventions."""
        named = (self.lidar, self.image, self.imu, self.odometry, *self.others)
        return tuple(dict.fromkeys(name for name in named if name))

    @property
    def written(self) -> tuple[str, ...]:
        """What is read to write the recording."""
        return tuple(name for name in (self.lidar, self.image, self.imu, self.gnss) if name)


def choose(
    description: SourceDescription, options: ImportOptions, topics: Mapping[str, str] = MappingProxyType({})
) -> Streams:
    """The streams to import. topics: by lidar, image, imu and gnss, those that are taken where options name none

    Raises InputError: one that is needed is missing or not there, or several fit.
    """
    lidar, image, imu = (getattr(options, name) or topics.get(name, "") for name in ("lidar", "image", "imu"))
    lidar = _one(description, Kind.SCANS, lidar, "--lidar", needed=True)
    odometry = odometry_file = odometry_command = ""
    if external.is_command(options.odometry):
        odometry_command = options.odometry
    elif options.odometry != AUTO:
        odometry, odometry_file = _odometry(description, options)
    gnss = topics.get("gnss") or next((each.name for each in _of_kind(description, Kind.GNSS)), "")
    return Streams(
        lidar=lidar,
        image=_one(description, Kind.IMAGES, image, "--image"),
        imu=_one(description, Kind.IMU, imu, "--imu"),
        gnss=gnss,
        odometry=odometry,
        odometry_file=odometry_file,
        odometry_command=odometry_command,
        others=tuple(
            stream.name
            for stream in description.streams
            if stream.kind in (Kind.CAMERA_INFO, Kind.TRANSFORMS)
        ),
    )


def _of_kind(description: SourceDescription, kind: Kind) -> list[Stream]:
    return [stream for stream in description.streams if stream.kind is kind and stream.count != 0]


def _one(description: SourceDescription, kind: Kind, asked: str, option: str, needed: bool = False) -> str:
    fitting = _of_kind(description, kind)
    if asked == NONE and not needed:
        return ""
    if asked:
        if asked in [stream.name for stream in fitting]:
            return asked
        named = packets.only(stream for stream in description.streams if stream.name == asked)
        if named is not None:
            raise InputError(f"{option} {asked}", packets.problem(named), packets.mend(named.message_type))
        raise InputError(
            f"{option} {asked}", f"{description.path} has no such stream of {kind}", _listed(fitting)
        )
    fitting = choosing.made_of(fitting)
    if len(fitting) > 1:
        names = f"{len(fitting)} streams of {kind}"
        raise InputError(
            description.path,
            f"has {names}",
            f"choose by {option}: {_listed(fitting)}{_likely(description, kind)}",
        )
    if not fitting and needed:
        raw = packets.only(description.streams)
        if raw is not None:
            raise InputError(description.path, packets.problem(raw), packets.mend(raw.message_type))
        raise InputError(description.path, f"has no {kind}", _others(description))
    return fitting[0].name if fitting else ""


def _odometry(description: SourceDescription, options: ImportOptions) -> tuple[str, str]:
    """Stream and file of poses, one of them "".

    Raises InputError: there is none, or several.
    """
    poses = _of_kind(description, Kind.POSES)
    moving = [stream for stream in _of_kind(description, Kind.TRANSFORMS) if choosing.may_move(stream)]
    asked = options.odometry
    if asked:
        if asked in [stream.name for stream in (*poses, *moving)]:
            return asked, ""
        if os.path.isfile(asked):
            return "", asked
        problem = f"{description.path} has no such stream of poses, and there is no such file"
        raise InputError(f"--odometry {asked}", problem, _listed([*poses, *moving]))
    if len(poses) == 1:
        return poses[0].name, ""
    if poses:
        raise InputError(
            description.path,
            f"has {len(poses)} streams of poses",
            f"choose by --odometry: {_listed(poses)}{_likely(description, Kind.POSES)}",
        )
    if len(moving) == 1:
        return moving[0].name, ""
    mend = f"estimate them by the scans: --odometry {AUTO}, or give --odometry FILE (TUM: t tx ty tz qx qy qz qw)"
    if moving:
        mend = f"choose by --odometry: {_listed(moving)}, or a TUM file"
    raise InputError(description.path, "has no poses", mend)


def _likely(description: SourceDescription, kind: Kind) -> str:
    """Which one of several streams it may be, by their names and fields."""
    choice = choosing.choose(description)
    by_kind = {
        Kind.SCANS: choice.lidar,
        Kind.IMAGES: choice.image,
        Kind.IMU: choice.imu,
        Kind.POSES: choice.odometry,
    }
    return f"; likely {by_kind[kind]}" if by_kind.get(kind) else ""


def _listed(streams: list[Stream]) -> str:
    return ", ".join(f"{stream.name} ({stream.message_type})" for stream in streams) or "there is none"


def _others(description: SourceDescription) -> str:
    kinds = [f"{stream.name} ({stream.kind})" for stream in description.streams]
    return f"its streams: {', '.join(kinds)}" if kinds else "it has no streams at all"
