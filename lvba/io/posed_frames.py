"""Scans or images with poses, checked: what every importer makes on the way to a `Dataset`."""

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import frames
from lvba.io.frames import Frame
from lvba.io.image_header import ImageSize
from lvba.trajectory import Trajectory

MIN_IMAGE_SIDE = 24
"""px; smaller images hold next to no patch that two of them could share."""
FAR_FROM_ORIGIN = 1000.0
"""m; recordings further away are shifted by whole meters, so that float32 and squares of coordinates stay exact."""


@dataclass(frozen=True)
class PosedFrames:
    """Good frames in time order.

    stamps: times as results write them, with all digits known; none: the shortest text of the times
    fingerprints: name and content of each, after one of the pose file; sizes: of images, empty for scans
    skipped: files of the folder that are not among them
    """

    paths: tuple[str, ...]
    poses: Trajectory
    fingerprints: tuple[str, ...]
    sizes: tuple[ImageSize, ...]
    warnings: tuple[str, ...]
    stamps: tuple[str, ...] = ()
    skipped: int = 0


def checked(
    matched: Sequence[Frame],
    poses: Trajectory,
    check: Callable[[Path, bytes | None], int] | Callable[[Path, bytes | None], ImageSize],
    kind: str,
    pose_fingerprint: str,
    warnings: tuple[str, ...],
    stamps: Sequence[str] = (),
    skipped: int = 0,
) -> PosedFrames:
    """The frames whose files pass the check.

    poses, stamps: of `matched`, in order; check: as in `frames.check_all`; pose_fingerprint: of the pose file
    skipped: files that are not in `matched`
    Raises: the first InputError if more than half of the frames are bad.
    """
    hashed = frames.total_bytes(matched) <= frames.HASHED_BYTES
    checks = frames.check_all(matched, check, hashed)
    good, bad_warnings = frames.split_bad(matched, checks, kind)
    names = (f"{kind} {matched[index].path.name} {checks[index].fingerprint}" for index in good)
    return PosedFrames(
        paths=tuple(str(matched[index].path) for index in good),
        poses=Trajectory(poses.times[good], poses.world_from_sensor[good]),
        fingerprints=(pose_fingerprint, *names),
        sizes=tuple(facts for index in good if isinstance(facts := checks[index].facts, ImageSize)),
        warnings=(*warnings, *bad_warnings),
        stamps=tuple(stamps[index] for index in good) if stamps else (),
        skipped=skipped + len(matched) - len(good),
    )


def of_one_size(pictures: PosedFrames, where: object) -> PosedFrames:
    """The images of the size that most have, with a warning about others.

    Raises: InputError if no size is that of more than half of them, or that size is too small.
    """
    size, count = Counter(pictures.sizes).most_common(1)[0]
    if 2 * count <= len(pictures.sizes):
        other = next(index for index, each in enumerate(pictures.sizes) if each != pictures.sizes[0])
        raise InputError(
            pictures.paths[other],
            f"images of different sizes: {_text(pictures.sizes[other])}, but {_text(pictures.sizes[0])} in "
            f"{Path(pictures.paths[0]).name}",
            "give images of one camera",
        )
    if min(size.width, size.height) < MIN_IMAGE_SIDE:
        raise InputError(
            where,
            f"images of {_text(size)} px are too small to be matched",
            f"give images of {MIN_IMAGE_SIDE} px or more on each side",
        )
    if count == len(pictures.sizes):
        return pictures
    good = [index for index, each in enumerate(pictures.sizes) if each == size]
    others = [
        Path(path).name for path, each in zip(pictures.paths, pictures.sizes, strict=True) if each != size
    ]
    return PosedFrames(
        paths=tuple(pictures.paths[index] for index in good),
        poses=Trajectory(pictures.poses.times[good], pictures.poses.world_from_sensor[good]),
        fingerprints=(pictures.fingerprints[0], *(pictures.fingerprints[index + 1] for index in good)),
        sizes=tuple(pictures.sizes[index] for index in good),
        warnings=(
            *pictures.warnings,
            *frames.left_out(others, f"images that are not {_text(size)} px", where),
        ),
        stamps=tuple(pictures.stamps[index] for index in good) if pictures.stamps else (),
        skipped=pictures.skipped + len(others),
    )


def digest(scans: PosedFrames, pictures: PosedFrames | None, others: Sequence[str]) -> str:
    """sha256 over all fingerprints."""
    lines = [*scans.fingerprints, *(() if pictures is None else pictures.fingerprints), *others]
    return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def shifted(dataset: Dataset) -> Dataset:
    """The same dataset with the first scan's place, in whole meters, as origin if it is far from zero."""
    positions = dataset.scans.world_from_sensor[:, :3, 3]
    if np.abs(positions).max() <= FAR_FROM_ORIGIN:
        return dataset
    origin = np.round(positions[0])
    return dataclasses.replace(
        dataset, scans=_moved(dataset.scans, -origin), images=_moved(dataset.images, -origin), origin=origin
    )


def _moved(trajectory: Trajectory, by: np.ndarray) -> Trajectory:
    poses = trajectory.world_from_sensor.copy()
    poses[:, :3, 3] += by
    return Trajectory(trajectory.times, poses)


def _text(size: ImageSize) -> str:
    return f"{size.width} x {size.height}"
