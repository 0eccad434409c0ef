"""Which streams of a source a map is made from, where nobody says."""

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass

from lvba.io import point_fields
from lvba.sources import packets
from lvba.sources.source import Kind, SourceDescription, Stream

_DERIVED = re.compile(
    r"registered|map|world|global|local|filter|feature|edge|corner|surf|effect|obstacle|sub|scan_?2"
)
"""Names of clouds that an odometry publishes, not a sensor."""
_NOT_COLOR = re.compile(r"depth|disparity|infra|thermal|mask|debug|feature|track|match|rendered|overlay")
_OTHER_POSES = re.compile(
    r"wheel|gps|gnss|rtk|fix|cmd|goal|target|setpoint|initial|ground_?truth|gt$|vicon|mocap|camera|image"
)


@dataclass(frozen=True)
class Choice:
    """Names of streams; "": there is none. others: of the same kind, by the kind, that were not taken"""

    lidar: str = ""
    image: str = ""
    odometry: str = ""
    imu: str = ""
    others: tuple[tuple[Kind, tuple[str, ...]], ...] = ()


def choose(description: SourceDescription, unusable: Collection[str] = ()) -> Choice:
    """The likely streams of a source, by their names, types, fields and counts.

    unusable: names of streams that cannot be decoded
    """
    streams = [each for each in description.streams if each.name not in unusable and each.count != 0]
    picked: dict[Kind, str] = {}
    others = []
    for kind, rank in _RANKS.items():
        ranked = sorted((each for each in streams if each.kind is kind), key=rank, reverse=True)
        first = made_of(ranked)
        ranked = [*first, *(each for each in ranked if each not in first)]
        if ranked:
            picked[kind] = ranked[0].name
        if len(ranked) > 1:
            others.append((kind, tuple(each.name for each in ranked[1:])))
    moving = [each.name for each in streams if may_move(each)]
    if Kind.POSES not in picked and len(moving) == 1:
        picked[Kind.POSES] = moving[0]
    return Choice(
        lidar=picked.get(Kind.SCANS, ""),
        image=picked.get(Kind.IMAGES, ""),
        odometry=picked.get(Kind.POSES, ""),
        imu=picked.get(Kind.IMU, ""),
        others=tuple(others),
    )


def made_of(streams: list[Stream]) -> list[Stream]:
    """Those that the driver made of packets, where it recorded both; else all."""
    return [each for each in streams if not packets.is_raw(each.message_type)] or streams


def may_move(stream: Stream) -> bool:
    """Whether it has transforms that may be poses of an odometry: tf_static and metadata of a sensor have none."""
    still = "static" in stream.name or stream.message_type.endswith("/String")
    return stream.kind is Kind.TRANSFORMS and not still


def _scan_rank(stream: Stream) -> tuple[float, ...]:
    raw = not _DERIVED.search(stream.name.lower())
    timed = bool(point_fields.times_of(name for name in map(_named, stream.fields) if name))
    return raw, timed, stream.count or 0


def _named(field: str) -> str:
    """The name of a field of points ("name type"); "": its type is not known."""
    return field.rpartition(" ")[0]


def _image_rank(stream: Stream) -> tuple[float, ...]:
    return not _NOT_COLOR.search(stream.name.lower()), stream.count or 0


def _pose_rank(stream: Stream) -> tuple[float, ...]:
    own = not _OTHER_POSES.search(stream.name.lower())
    odometry = stream.message_type.endswith("Odometry")
    path = stream.message_type.endswith("Path")
    return own, odometry, not path, stream.count or 0


def _imu_rank(stream: Stream) -> tuple[float, ...]:
    return (stream.count or 0,)


_RANKS: dict[Kind, Callable[[Stream], tuple[float, ...]]] = {
    Kind.SCANS: _scan_rank,
    Kind.IMAGES: _image_rank,
    Kind.POSES: _pose_rank,
    Kind.IMU: _imu_rank,
}
