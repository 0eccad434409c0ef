"""Cutting a long recording into overlapping parts, each small enough to be solved at once.

Every scan and every image belongs to the core of exactly one part; a part also holds its neighbors' frames on both
sides, as far as the overlap reaches. Source: Li et al., section III (subsequences); method and limits are ours.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Indices
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.settings import check, setting
from lvba.trajectory import Trajectory

FEWEST_SCANS = 10
"""A core of fewer scans than this is no part: too few share a plane."""
FEWEST_REGIONS = 16
"""Of space: enough for many workers."""
REGION_POINTS = 2e6
"""Points of a region up to which parts own space together: their map takes less memory than a part's images."""
NEAR_M = 8.0
"""Frames that other parts took within this distance of a part's path join it in the joint visual bundle adjustment, so
that places seen again tie poses and exposures."""
_PAUSE = 3.0
"""Ten scans that reach over so many times the core are before and after a pause, or a jump of the path."""
LEAST_OVERLAP = 3
"""Scans that neighboring parts must share at least: from fewer no relative pose can be trusted."""


@dataclass(frozen=True)
class SplitConfig:
    """How a long recording is cut into parts."""

    by: Literal["memory", "length", "time", "count", "none"] = setting(
        "memory",
        meaning="memory: as many parts as keep one within `split.memory_gb`, one where all fits; length: parts of "
        "`split.size` meters of path; time: of `split.size` seconds; count: of `split.size` scans; none: never split.",
        choices=("memory", "length", "time", "count", "none"),
        change_when="Parts should have a size of their own, as for a cluster with many small machines.",
    )
    size: float = setting(
        0.0,
        meaning="How long the core of a part is, for `split.by` length, time and count.",
        unit="m, s or scans",
        low=0,
        change_when="`split.by` is length, time or count: then it must be above 0.",
    )
    overlap: float = setting(
        0.0,
        meaning="How far a part reaches over its core on each side, in the unit of `split.size` (scans for memory). 0: a "
        "quarter of the core, and at least 10 scans.",
        unit="m, s or scans",
        low=0,
        change_when="The report shows seams between parts (larger).",
        advanced=True,
    )
    memory_gb: float = setting(
        4.0,
        meaning="Memory that one part may take, for `split.by` memory.",
        unit="GB",
        low=0.5,
        high=1000,
        change_when="The machine, or a worker of the cluster, has less or much more.",
    )
    starts: tuple[float, ...] = setting(
        (),
        meaning="Your own cuts: where the second and later parts begin, after the first scan, ascending. Used instead of "
        "`split.by`.",
        unit="s",
        change_when="Cuts should lie at certain places, as at stops.",
        advanced=True,
    )

    def __post_init__(self) -> None:
        check(self)
        if self.by in ("length", "time", "count") and not self.starts and not 0 < self.size < np.inf:
            raise ValueError(f"size is {self.size}, must be above 0 with split.by {self.by}")
        if not self.overlap < np.inf:
            raise ValueError(f"overlap is {self.overlap}, must be finite")
        if not all(a < b < np.inf for a, b in zip((0.0, *self.starts), self.starts, strict=False)):
            raise ValueError(f"starts are {self.starts}, must be finite, ascending and above 0")


@dataclass(frozen=True)
class Frames:
    """Some frames of a recording. scans (n,), images (m,): int64, ascending numbers; core_images: as in `Part`."""

    scans: np.ndarray
    images: np.ndarray
    core_images: tuple[int, int]


@dataclass(frozen=True)
class Part:
    """One part: half-open ranges of scan and image numbers.

    core_*: what belongs to no other part; scans, images: with what is shared
    """

    number: int
    scans: tuple[int, int]
    core_scans: tuple[int, int]
    images: tuple[int, int]
    core_images: tuple[int, int]

    @property
    def scan_numbers(self) -> np.ndarray:
        """All scans of the part, (n,) int64."""
        return np.arange(*self.scans)

    @property
    def image_numbers(self) -> np.ndarray:
        """All images of the part, (n,) int64."""
        return np.arange(*self.images)

    @property
    def frames(self) -> Frames:
        """All frames of the part."""
        return Frames(self.scan_numbers, self.image_numbers, self.core_images)

    @property
    def core_of_scans(self) -> slice:
        """The core among the part's scans."""
        return slice(self.core_scans[0] - self.scans[0], self.core_scans[1] - self.scans[0])

    @property
    def core_of_images(self) -> slice:
        """The core among the part's images."""
        return slice(self.core_images[0] - self.images[0], self.core_images[1] - self.images[0])


@dataclass(frozen=True)
class Load:
    """What a recording asks of memory.

    points_per_scan: mean number of points; pixels_per_image: width times height
    reach_m, range_m: how far all but few points are from the sensor, and half of them
    """

    points_per_scan: float
    pixels_per_image: float
    reach_m: float = 100.0
    range_m: float = 10.0

    @property
    def every(self) -> int:
        """All but the map takes every so many-th point of each scan."""
        return max(1, round(self.points_per_scan / ENOUGH_POINTS))

    @property
    def solved_per_scan(self) -> float:
        """Mean number of points of a scan that all but the map takes."""
        return self.points_per_scan / self.every


ENOUGH_POINTS = 100_000
"""Of a scan, to solve with and to judge by. More of them say the same again: what a sensor is off by, neighboring points
are off by together. A third of the 290,000 points of depth images left poses as good or better (13 mm instead of 15,
9.5 of 9.9), half of 200,000 of a spinning LiDAR at noise alone cost 0 to 0.1 mm of 0.1 to 0.7."""
BASE_BYTES = 350e6
"""What a process holds before any data: libraries and compiled kernels."""
BYTES_PER_POINT = 250.0
"""Of all LiDAR points at once: judging takes most, which colors them for up to four states, with vignetting; LiDAR bundle
adjustment takes half. Measured on 15 million points, as the figures below on 400 images of 640 x 480."""
BYTES_PER_PAIR_OF_SCANS = 3 * 36 * 8.0
"""The dense Hessian of a part, its factor or inverse, and what is copied of them."""
HELD_BYTES_PER_POINT = 12.0
"""Of LiDAR points that are not solved with ..."""
MAP_BYTES_PER_POINT = 70.0
"""... and of all points while the map is thinned. Of 97 scans of 284,000."""
VISUAL_BYTES_PER_POINT = 50.0
"""Of LiDAR points with their planes, while the images are in memory ..."""
BYTES_PER_PIXEL = 8.0
"""... with all levels ..."""
BYTES_PER_IMAGE = 4e6
"""... and what is known of the pairs of points and images that see them, about 1,300 for each image whatever its size. Of
57 images of 320 x 240, and 34 of 640 x 480."""


def memory_bytes(load: Load, scans: float, images: float) -> float:
    """Peak memory that a part of so many scans and images takes, bytes."""
    solved, others = load.solved_per_scan * scans, (load.points_per_scan - load.solved_per_scan) * scans
    lidar = BYTES_PER_POINT * solved + HELD_BYTES_PER_POINT * others + BYTES_PER_PAIR_OF_SCANS * scans**2
    return max(BASE_BYTES + lidar, map_bytes(load, scans), visual_bytes(load, scans, images))


def map_bytes(load: Load, scans: float) -> float:
    """Peak memory of what takes all points of so many scans, bytes."""
    return BASE_BYTES + MAP_BYTES_PER_POINT * load.points_per_scan * scans


def visual_bytes(load: Load, scans: float, images: float) -> float:
    """Peak memory of the steps that look at so many images and the planes of so many scans, bytes."""
    points, pixels = load.solved_per_scan * scans, load.pixels_per_image * images
    visual = VISUAL_BYTES_PER_POINT * points + BYTES_PER_PIXEL * pixels + BYTES_PER_IMAGE * images
    return BASE_BYTES + visual


def parts(dataset: Dataset, config: SplitConfig, load: Load) -> list[Part]:
    """The parts in order; one that holds everything where nothing is to be split.

    Raises InputError: parts too short, or with too little overlap.
    """
    scans = len(dataset.scans)
    if config.by == "none" and not config.starts:
        return [_whole(dataset)]
    position = _position(dataset, config)
    _check_count(config, position)
    first = _cuts(dataset, config, load, position)
    if len(first) == 1:
        return [_whole(dataset)]
    bounds = [*first, scans]
    _check_cores(bounds)
    cut = []
    for number, (begin, end) in enumerate(pairwise(bounds)):
        back, on = (config.overlap,) * 2 if config.overlap else _default_overlaps(position, begin, end)
        low = int(np.searchsorted(position, position[begin] - back, side="left"))
        high = int(np.searchsorted(position, position[end - 1] + on, side="right"))
        cut.append(_part(dataset, number, (low, high), (begin, end)))
    _check_overlaps(cut, config)
    return cut


def regions(parts: Sequence[Part], load: Load) -> tuple[Part, ...]:
    """Successive parts that own space together, so few that each region has about REGION_POINTS points; numbered anew.

    What looks at a region reads all scans about it. In a compact place these are all scans of the recording, and with
    a region for each part reading would grow with the square of the length.
    """
    scans = parts[-1].core_scans[1]
    count = min(len(parts), max(FEWEST_REGIONS, math.ceil(scans * load.points_per_scan / REGION_POINTS)))
    bounds = _equal(len(parts), count)
    return tuple(
        Part(
            number=number,
            scans=(parts[first].scans[0], parts[end - 1].scans[1]),
            core_scans=(parts[first].core_scans[0], parts[end - 1].core_scans[1]),
            images=(parts[first].images[0], parts[end - 1].images[1]),
            core_images=(parts[first].core_images[0], parts[end - 1].core_images[1]),
        )
        for number, (first, end) in enumerate(pairwise([*bounds, len(parts)]))
    )


def with_near(dataset: Dataset, part: Part) -> Frames:
    """The part's frames and those that other parts took at the same place, within NEAR_M of its core by rough poses.

    At most half as many as the part has itself, spread evenly, so that a place seen often does not grow without bound.
    """
    own = part.frames
    core = cKDTree(dataset.scans.world_from_sensor[slice(*part.core_scans), :3, 3])
    return Frames(
        _and_near(own.scans, dataset.scans.world_from_sensor, core),
        _and_near(own.images, dataset.images.world_from_sensor, core),
        own.core_images,
    )


def _and_near(own: np.ndarray, poses: np.ndarray, core: cKDTree) -> np.ndarray:
    near = np.flatnonzero(np.isfinite(core.query(poses[:, :3, 3], distance_upper_bound=NEAR_M)[0]))
    near = np.setdiff1d(near, own)
    most = len(own) // 2
    if len(near) > most:
        near = near[np.linspace(0, len(near) - 1, most).astype(int)]
    return np.union1d(own, near).astype(np.int64)


def subset(dataset: Dataset, scans: Indices, images: Indices) -> Dataset:
    """The recording with some of its scans and images only, by ascending number; its world frame stays.

    Raises ValueError: no scans.
    """
    if len(scans) == 0:
        raise ValueError("a recording needs scans")
    named = ",".join(map(str, scans)) + ";" + ",".join(map(str, images))
    return dataclasses.replace(
        dataset,
        scan_paths=tuple(dataset.scan_paths[i] for i in scans),
        scans=Trajectory(dataset.scans.times[scans], dataset.scans.world_from_sensor[scans]),
        image_paths=tuple(dataset.image_paths[i] for i in images),
        images=Trajectory(dataset.images.times[images], dataset.images.world_from_sensor[images]),
        scan_stamps=tuple(dataset.scan_stamps[i] for i in scans) if dataset.scan_stamps else (),
        image_stamps=tuple(dataset.image_stamps[i] for i in images) if dataset.image_stamps else (),
        warnings=(),
        digest=hashlib.sha256(f"{dataset.digest} {named}".encode()).hexdigest() if dataset.digest else "",
    )


def path_length(dataset: Dataset) -> np.ndarray:
    """Length of the path up to each scan, (S,) m."""
    steps = np.linalg.norm(np.diff(dataset.scans.world_from_sensor[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _position(dataset: Dataset, config: SplitConfig) -> np.ndarray:
    """Where each scan is along what is cut, (S,): m, s or numbers."""
    if config.starts or config.by == "time":
        return np.asarray(dataset.scans.times - dataset.scans.times[0])
    if config.by == "length":
        return path_length(dataset)
    return np.arange(len(dataset.scans), dtype=float)


def _cuts(dataset: Dataset, config: SplitConfig, load: Load, position: np.ndarray) -> list[int]:
    """The first scan of each core."""
    if config.starts:
        return [0, *(int(np.searchsorted(position, start)) for start in config.starts)]
    scans = len(position)
    if config.by == "memory":
        return _equal(scans, _parts_for_memory(dataset, config, load))
    total = scans if config.by == "count" else position[-1]
    count = max(1, round(total / config.size))
    first = [int(np.searchsorted(position, total * k / count)) for k in range(count)]
    return _joined(sorted(set(first)), position)


def _joined(first: list[int], position: np.ndarray) -> list[int]:
    """The first scan of each core where cores of too few scans, as about a pause, are part of the nearer neighbor.

    As given where cores of too few are the usual: then parts are too short.
    """
    bounds = [*first, len(position)]
    if np.median(np.diff(bounds)) < FEWEST_SCANS:
        return first
    while len(bounds) > 2 and (sizes := np.diff(bounds)).min() < FEWEST_SCANS:
        short = int(sizes.argmin())
        gaps = [_gap(position, bound) for bound in bounds[short : short + 2]]
        del bounds[short + int(gaps[1] < gaps[0])]
    return bounds[:-1]


def _gap(position: np.ndarray, bound: int) -> float:
    """How far the scans on either side of a bound are apart; inf at the ends of the recording."""
    return float(position[bound] - position[bound - 1]) if 0 < bound < len(position) else math.inf


def _equal(scans: int, count: int) -> list[int]:
    return [scans * k // count for k in range(count)]


def _check_count(config: SplitConfig, position: np.ndarray) -> None:
    """That parts of a size are no more than scans: before as many are made."""
    if config.by == "memory" or config.starts:
        return
    scans = len(position)
    total = scans if config.by == "count" else float(position[-1])
    if total > scans * config.size:
        unit = {"length": " m", "time": " s", "count": " scans"}[config.by]
        raise InputError(
            "split.size",
            f"parts of {config.size:g}{unit} would be more than the {scans} scans that there are ({total:.6g}{unit})",
            "make the parts longer",
        )


def _parts_for_memory(dataset: Dataset, config: SplitConfig, load: Load) -> int:
    """The fewest parts of equal length that fit."""
    scans, images = len(dataset.scans), len(dataset.image_paths)
    budget = config.memory_gb * 1e9
    for count in range(1, max(scans // FEWEST_SCANS, 1) + 1):
        core = scans / count
        held = scans if count == 1 else core + 2 * (config.overlap or max(core / 4, 10))
        if memory_bytes(load, held, images * held / scans) <= budget:
            return count
    need = memory_bytes(load, 3 * FEWEST_SCANS, images * 3 * FEWEST_SCANS / scans) / 1e9
    raise InputError(
        "split.memory_gb",
        f"{config.memory_gb:g} GB hold not even {3 * FEWEST_SCANS} scans with their images",
        f"give at least {need:.1f} GB, or thin the scans",
    )


def _default_overlaps(position: np.ndarray, begin: int, end: int) -> tuple[float, float]:
    """How far a part reaches back and on: a quarter of the core, and at least 10 scans on either side, along `position`;
    where there is a pause, as far as that on its own side only."""
    last = len(position) - 1
    core = position[end - 1] - position[begin]
    if (longest := np.diff(position[begin:end]).max()) > core / 2:
        core -= longest  # a pause within it
    on = position[min(end - 1 + 10, last)] - position[end - 1]
    back = position[begin] - position[max(begin - 10, 0)]
    both = max([core / 4, *(ten for ten in (back, on) if ten <= _PAUSE * core)])
    return float(max(both, back)), float(max(both, on))


def _check_cores(bounds: list[int]) -> None:
    sizes = np.diff(bounds)
    if sizes.min() < FEWEST_SCANS:
        raise InputError(
            "split",
            f"part {int(sizes.argmin()) + 1} of {len(sizes)} would hold {int(sizes.min())} scans of its own; "
            f"at least {FEWEST_SCANS} are needed",
            "make the parts longer (split.size, split.starts, split.memory_gb)",
        )


def _check_overlaps(cut: list[Part], config: SplitConfig) -> None:
    for left, right in pairwise(cut):
        shared = left.scans[1] - right.scans[0]
        if shared < LEAST_OVERLAP:
            raise InputError(
                "split.overlap",
                f"parts {left.number + 1} and {right.number + 1} would share {max(shared, 0)} scans with an overlap of "
                f"{config.overlap:g}; at least {LEAST_OVERLAP} are needed",
                "make it larger, or leave it at 0 for a quarter of a part",
            )


def _whole(dataset: Dataset) -> Part:
    scans, images = (0, len(dataset.scans)), (0, len(dataset.image_paths))
    return Part(0, scans, scans, images, images)


def _part(dataset: Dataset, number: int, scans: tuple[int, int], core: tuple[int, int]) -> Part:
    return Part(number, scans, core, _images(dataset, scans), _images(dataset, core))


def _images(dataset: Dataset, scans: tuple[int, int]) -> tuple[int, int]:
    """The images whose nearest scan in time is among the scans."""
    times, stamps = dataset.scans.times, dataset.images.times
    middles = 0.5 * (times[1:] + times[:-1])
    nearest = np.searchsorted(middles, stamps)
    return int(np.searchsorted(nearest, scans[0])), int(np.searchsorted(nearest, scans[1]))
