"""Ways to read images: direction of the extrinsic, and how far stamps are off; decided by what points look like.

The same points of the map are looked up in two images that moved differently: read rightly, both show the same
brightness there, but for exposure.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import cv2
import numpy as np

from lvba import geometry, lens
from lvba.arrays import Pose, Times, Vectors
from lvba.camera import Camera
from lvba.sources.importing import decision, offset
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.track import Track

MOST_PAIRS = 40
_POINTS = 16000
"""Of a segment. Of a spinning LiDAR a camera sees few: with a quarter of them, chance makes scores so rough that, on a
straight drive, they are least 60 ms off, alike for many pairs."""
_FEWEST_SEEN = 60
_CELL_PX = 12
_BEHIND = 0.05
_BEHIND_M = 0.2
"""Points farther than the nearest one in their cell of the image by more than this part and length are hidden."""
_FINE_PX, _COARSE_PX = 1.5, 12.0
_MOST_APART_S = 1.3
_UNLIKE = 1.0
_FIT_STEP_S = 8e-3
_FIT_STEPS_S = (_FIT_STEP_S, 2 * _FIT_STEP_S, 4 * _FIT_STEP_S)
"""Between offsets that a parabola is laid through: where scores hardly change over one, a wider one knows more."""
_SIGNIFICANT_SIGMAS, _SIGNIFICANT_S = 4.0, 0.02
"""An offset in time that is larger than both is no chance, and more than all pairs may have in common; smaller ones
are found by the bundle adjustment, and no reason to take an unusual answer."""
_TOLD_SIGMAS = 3.0
"""A smaller one that is larger than this is told, at least."""
WARN_SCORE = 0.9
"""Images that agree less than this with each other by the best reading say nothing about it."""
_CLEAR_SCORE = 0.8
"""Those that agree less do not show that an extrinsic is of a link: of many readings, the best agrees a bit by chance."""
_SAME = 1e-6
"""Entries of two transforms that differ by less are one, but for the digits that files print."""


AS_GIVEN, INVERSE, LINK = "camera_from_lidar", "lidar_from_camera", "camera_link_from_lidar"
"""What a given extrinsic may be; of a link, the camera looks along x, with z up."""
_OPTICAL_FROM_LINK = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Source: REP 103 of ROS, suffix frames."""


@dataclass(frozen=True)
class ImageReading:
    """extrinsic: what the given one is, `AS_GIVEN`, `INVERSE` or `LINK`; offset: s, added to stamps of images."""

    extrinsic: str = AS_GIVEN
    offset: float = 0.0

    def answered(self, question: str, value: Any) -> "ImageReading":
        """With another answer to a question: extrinsic, or image_offset (s)."""
        return replace(self, **{"offset" if question == "image_offset" else question: value})

    def camera_from_lidar(self, given: Pose) -> Pose:
        """(4, 4), by a given extrinsic."""
        if self.extrinsic == INVERSE:
            return geometry.inverse(given)
        return np.asarray(_OPTICAL_FROM_LINK @ given) if self.extrinsic == LINK else given


@dataclass(frozen=True)
class TimedImage:
    """stamp: s; gray: (H, W) uint8; camera: of an image of this size."""

    stamp: float
    gray: np.ndarray
    camera: Camera

    @cached_property
    def bright(self) -> np.ndarray:
        """(H, W) float32, the image without what is coarser or finer than some pixels."""
        gray = self.gray.astype(np.float32)
        fine = cv2.GaussianBlur(gray, (0, 0), _FINE_PX)
        return np.asarray(fine - cv2.GaussianBlur(gray, (0, 0), _COARSE_PX))


@dataclass(frozen=True)
class ImagePair:
    """Two images and the points (N, 3) float64, m, world, that scans saw about then.

    segment: of the recording; its pairs share images and points, so that they err together
    """

    one: TimedImage
    other: TimedImage
    points: np.ndarray
    segment: int = 0


@dataclass
class ImageScorer:
    """How unlike the same points look in pairs of images, by readings. lidar: world from LiDAR.

    added: s, to stamps of images, before, which names of offsets count in
    """

    lidar: Track
    camera_from_lidar: np.ndarray
    pairs: list[ImagePair]
    added: float = 0.0
    _known: dict[ImageReading, np.ndarray] = field(default_factory=dict)

    def scores(self, reading: ImageReading) -> np.ndarray:
        """(P,) float64, of each pair: 1 less the correlation of brightness, 1 where images see nothing in common."""
        if reading not in self._known:
            self._known[reading] = np.array([self._unlike(pair, reading) for pair in self.pairs])
        return self._known[reading]

    def score(self, reading: ImageReading) -> float:
        """The geometric mean over pairs."""
        return decision.mean(self.scores(reading))

    def _unlike(self, pair: ImagePair, reading: ImageReading) -> float:
        extrinsic = reading.camera_from_lidar(self.camera_from_lidar)
        images = (pair.one, pair.other)
        poses = self.lidar.at(np.array([image.stamp + reading.offset for image in images]))
        seen = [
            _look(image, pair.points, extrinsic @ geometry.inverse(pose))
            for image, pose in zip(images, poses, strict=True)
        ]
        both = np.isfinite(seen[0]) & np.isfinite(seen[1])
        if np.count_nonzero(both) < _FEWEST_SEEN:
            return _UNLIKE
        return 1.0 - _correlation(seen[0][both], seen[1][both])


def pairs_of(
    images: list[TimedImage], lidar: Track, points: Vectors, reach: float, segment: int = 0
) -> list[ImagePair]:
    """Pairs of images of a segment, the most differently moved first.

    points: (N, 3) float64, m, world, of scans of the segment; lidar: world from LiDAR; reach: s, by which stamps may
    be off; segment: its number
    """
    if len(points) > _POINTS:
        chosen = np.random.default_rng(len(points)).choice(len(points), _POINTS, replace=False)
        points = points[np.sort(chosen)]
    inside = [image for image in images if lidar.covers(image.stamp - reach, image.stamp + reach)]
    rated = [
        (_difference(one.stamp, other.stamp, lidar), ImagePair(one, other, points, segment))
        for number, one in enumerate(inside)
        for other in inside[number + 1 :]
        if other.stamp - one.stamp <= _MOST_APART_S
    ]
    return [pair for _, pair in sorted(rated, key=lambda entry: -entry[0])]


@dataclass(frozen=True)
class ImagesRead:
    """The reading that is taken, and why.

    pairs: of images that were looked at; measured, measured_sigma: s, how long after their stamps images were taken, by
    what they show, and how uncertain that is
    camera: of the images; None: not decided yet
    """

    reading: ImageReading
    decisions: tuple[Decision, ...]
    pairs: int
    measured: float
    measured_sigma: float
    warnings: tuple[str, ...]
    camera: Camera | None = None


def best(
    scorer: ImageScorer, offsets: dict[str, float], said: dict[str, str], more: tuple[str, ...] = ()
) -> ImageReading:
    """The reading by which points look most alike; the first where nothing tells. Arguments as of `find`."""
    directions, times = _directions(scorer.camera_from_lidar, said.get("extrinsic", "")), offsets.values()
    tried = [
        ImageReading(*values)
        for values in product(
            [said["extrinsic"]] if "extrinsic" in said else [*directions, *more],
            [offsets[said["image_offset"]]] if "image_offset" in said else times,
        )
    ]
    return min(tried, key=scorer.score) if scorer.pairs else tried[0]


def find_with_links(
    scorer: ImageScorer, offsets: dict[str, float], said: dict[str, str], where: object, known_by: str = ""
) -> ImagesRead:
    """As `find`, of an extrinsic that frames of a driver give: where images say nothing by the usual readings, their
    frame may be that of a link."""
    read = find(scorer, offsets, said, where, known_by)
    if "extrinsic" in said or not scorer.pairs or scorer.score(read.reading) <= WARN_SCORE:
        return read
    other = find(scorer, offsets, said, where, known_by, (LINK,))
    if other.reading.extrinsic != LINK or scorer.score(other.reading) > _CLEAR_SCORE:
        return read
    words = (
        "extrinsic: the frame of the images looks along x, as images show, not along z as those of cameras: "
        f"{LINK} is taken"
    )
    return replace(other, warnings=(words, *other.warnings))


def find(
    scorer: ImageScorer,
    offsets: dict[str, float],
    said: dict[str, str],
    where: object,
    known_by: str = "",
    more: tuple[str, ...] = (),
) -> ImagesRead:
    """The reading by which points look alike in pairs of images.

    offsets: s, by name, the first is taken where data cannot tell; said: answers that options give
    known_by: what says the first offset, beside the data; more: answers to `extrinsic` beside the usual ones
    Raises InputError: data contradict what an option says.
    """
    directions = (*_directions(scorer.camera_from_lidar, said.get("extrinsic", "")), *more)
    every: dict[str, dict[str, object]] = {
        "extrinsic": {name: name for name in directions},
        "image_offset": dict(offsets),
    }
    likely = best(scorer, offsets, said, more)
    place, sigma = _offset(scorer, likely)
    reading, decisions = likely, []
    for question in every:
        answers = [
            Answer(key, scorer.scores(likely.answered(question, value)) if scorer.pairs else np.ones(1))
            for key, value in every[question].items()
        ]
        excluded = offset.away(offsets, place, sigma, _SIGNIFICANT_S) if question == "image_offset" else []
        said_here = said.get(question, "")
        known = known_by if question == "image_offset" else ""
        decided = decision.decide(
            question, answers, said_here, answers[0].name, "unlikeness", where, excluded, known
        )
        decisions.append(decided)
        reading = reading.answered(question, every[question][decided.taken])
    usual = reading.offset == next(iter(offsets.values()))
    far = (
        max(_SIGNIFICANT_SIGMAS * sigma, _SIGNIFICANT_S)
        if usual
        else max(offset.NEAR_SIGMAS * sigma, _FIT_STEP_S)
    )
    if abs(place - reading.offset) > far and "image_offset" not in said:
        reading, decisions[-1] = _measured(scorer, reading, decisions[-1], place, sigma, usual)
    else:
        decisions[-1] = _with_what_is_left(decisions[-1], reading, place, sigma, scorer.added)
    warnings = [each.warning for each in decisions if each.warning]
    if scorer.pairs and scorer.score(reading) > WARN_SCORE:
        warnings.append(
            "images: points do not look alike in different images by any reading (unlikeness "
            f"{scorer.score(reading):.2f} of 1): check the calibration of the camera, and the clock of the images, or "
            "import without them: --image none"
        )
    return ImagesRead(
        reading=reading,
        decisions=tuple(decisions),
        pairs=len(scorer.pairs),
        measured=place,
        measured_sigma=sigma,
        warnings=tuple(warnings),
    )


def _directions(camera_from_lidar: Pose, said: str) -> tuple[str, ...]:
    """Answers to `extrinsic`: one where both are one transform, as where depth is registered to the image."""
    if np.allclose(camera_from_lidar, geometry.inverse(camera_from_lidar), rtol=0, atol=_SAME):
        return (said or AS_GIVEN,)
    return (AS_GIVEN, INVERSE, LINK) if said == LINK else (AS_GIVEN, INVERSE)


def _with_what_is_left(
    decided: Decision, reading: ImageReading, place: float, sigma: float, added: float
) -> Decision:
    """The decision on the offset, with a warning where images seem to be taken at another one.

    added: s, as of the scorer
    """
    if abs(place - reading.offset) <= max(_TOLD_SIGMAS * sigma, _FIT_STEP_S) or decided.warning:
        return decided
    size = f"{1000 * (place + added):+.0f} ms (+- {1000 * sigma:.0f})"
    words = (
        f"image_offset: the data suggest {size} after their stamps, and {decided.taken} was applied: the bundle "
        f"adjustment estimates the rest, or give --convention image_offset={place + added:.4f}"
    )
    return replace(decided, warning=words)


def _offset(scorer: ImageScorer, best: ImageReading) -> tuple[float, float]:
    """s: how long after their stamps images were taken, as measured beside the best reading, and its deviation."""
    if not scorer.pairs:
        return best.offset, float("inf")
    segment = np.array([pair.segment for pair in scorer.pairs])
    measured = (0.0, float("inf"))
    for step in _FIT_STEPS_S:
        wider = offset.measure(
            lambda by: scorer.scores(best.answered("image_offset", best.offset + by)), step, 1, segment
        )
        measured = min(measured, wider, key=lambda each: each[1])
        if measured[1] <= step:
            break
    return best.offset + measured[0], measured[1]


def _measured(
    scorer: ImageScorer, reading: ImageReading, decided: Decision, place: float, sigma: float, usual: bool
) -> tuple[ImageReading, Decision]:
    """Reading and decision where images are of another time (s) than the reading says; usual: this is the usual one."""
    other = reading.answered("image_offset", round(place, 4))
    scores = [Answer("", scorer.scores(each)) for each in (reading, other)]
    total = other.offset + scorer.added
    size = f"{1000 * total:+.0f} ms (+- {1000 * sigma:.0f}) after their stamps"
    # beside an unusual answer, what is measured is the better guess; the usual one must be beaten
    beaten = scores[1].score < scores[0].score if usual else not decision.better(*scores)
    if not beaten:
        words = f"image_offset: the data suggest {size}, but that does not improve the fit: not applied"
        return reading, replace(decided, warning=decided.warning or words)
    words = f"image_offset: images were taken {size}, by what they show: applied"
    return other, decided.measured(f"{total:+.4f}", scorer.score(other), words)


def _difference(one: float, other: float, lidar: Track) -> float:
    step = 0.1
    poses = lidar.at(np.array([one, one + step, other, other + step]))
    twists = geometry.log(geometry.inverse(poses[0::2]) @ poses[1::2]) / step
    off = twists[1] - twists[0]
    return float(10 * np.linalg.norm(off[:3]) + np.linalg.norm(off[3:]))


def _look(image: TimedImage, points: np.ndarray, camera_from_world: Pose) -> np.ndarray:
    """(N,) float32: brightness where points (N, 3), m, are seen; NaN where they are not in the image, or hidden."""
    camera = image.camera
    seen = geometry.transform_points(camera_from_world, points)
    depth = np.where(seen[:, 2] > 0.2, seen[:, 2], np.nan)
    x, y = seen[:, 0] / depth, seen[:, 1] / depth
    narrow = np.hypot(x, y) < np.tan(min(lens.widest_angle(camera.lens, camera.distortion), np.radians(80)))
    u, v = lens.distort(camera.lens, camera.distortion, x, y)
    column, row = camera.fx * u + camera.cx, camera.fy * v + camera.cy
    inside = narrow & (column >= 1) & (row >= 1) & (column < camera.width - 2) & (row < camera.height - 2)
    values = np.full(len(points), np.nan, np.float32)
    [index] = np.nonzero(inside)
    index = index[_in_front(column[index], row[index], depth[index])]
    where = np.stack([column[index], row[index]], axis=1).astype(np.float32)
    if len(index):
        values[index] = cv2.remap(image.bright, where[:, :1], where[:, 1:], cv2.INTER_LINEAR)[:, 0]
    return values


def _in_front(column: np.ndarray, row: np.ndarray, depth: Times) -> np.ndarray:
    """(N,) bool: which points are about as near as the nearest in their cell of the image."""
    across, down = column.astype(np.int64) // _CELL_PX, row.astype(np.int64) // _CELL_PX
    cell = down * (across.max(initial=0) + 1) + across
    nearest = np.full(cell.max(initial=-1) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    return np.asarray(depth <= nearest[cell] * (1 + _BEHIND) + _BEHIND_M)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of two sets of values (N,), without their outermost ones: a few bright spots must not decide."""
    values = []
    for each in (one, other):
        low, high = np.quantile(each, [0.02, 0.98])
        clipped = np.clip(each.astype(float), low, high)
        values.append(clipped - clipped.mean())
    size = np.sqrt(np.sum(values[0] ** 2) * np.sum(values[1] ** 2))
    return float(np.sum(values[0] * values[1]) / size) if size > 0 else 0.0
