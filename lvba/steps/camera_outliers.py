"""The steps that look for single cameras that the visual stage left in a wrong place, and put them where their neighbors
have them.

One camera that is degrees off colors the points about it wrongly, so that its neighbors are predicted worse as well: a
gain of all others is not beyond chance then, and the gate refuses all of them. A camera is an outlier where it leaves the
LiDAR trajectory by far more than its neighbors do, and where images say that it is wrong: PSNR and SSIM of its image,
left out, are better at its neighbors' deviation from the trajectory. The gate judges the result of it as any other.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from lvba import geometry, spline
from lvba.arrays import Indices, Poses, Times
from lvba.blocks.decoded_images import PhotoReader, blank_photos
from lvba.blocks.decoded_scans import ScanPieces, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.carried import far
from lvba.dataset import Dataset
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.progress import Progress, silent
from lvba.steps import acceptance, evaluate
from lvba.steps.lidar import carry_cameras, cloud_of
from lvba.steps.outcomes import ScanPoses, VisualStage
from lvba.steps.part_scores import as_in_whole, in_core, leave_one_out, together
from lvba.trajectory import Trajectory
from lvba.visual.result import VisualResult
from lvba.wording import first_of

SOLVED = "solved"
"""The state with the cameras as the visual stage left them; the others are named after their `Expectation`."""
OUTLIER = 5.0
"""Times the median by which a camera must miss its neighbors' deviation to be asked about: 7.7 standard deviations, were
these normal."""
MOST = 0.05
"""Part of the keyframes that may be asked about, by each path: a stage that fails in more is judged as it is ..."""
LEAST = 2
"""... but so many always."""
FEWEST = 8
"""Keyframes below which no median says what an outlier is."""
_NAMED = 8
"""Images that are named at most."""


@dataclass(frozen=True)
class Expectation:
    """One way to tell where the cameras are without their images, and by what the keyframes solved deviate from it.

    world_from_camera: (I, 4, 4) of all images; deviation: (K, 6) of the keyframes, in the frame of the camera
    known: (K,) bool, keyframes that it says something about
    """

    name: str
    world_from_camera: Poses
    deviation: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Outliers:
    """outlying: (r,) int64, keyframes that leave the trajectory by far more than their neighbors, as numbers of images
    by_all: (r,) bool, by two expectations, and by all that say something about them
    others: (n,) int64, the other keyframes; expectations: that they contradict
    """

    outlying: np.ndarray
    by_all: np.ndarray
    others: np.ndarray
    expectations: tuple[Expectation, ...]

    @property
    def keyframes(self) -> np.ndarray:
        """(K,) int64, all of them."""
        return np.union1d(self.outlying, self.others)

    @property
    def kept(self) -> np.ndarray:
        """(K,) bool, which of the keyframes are no outliers."""
        return np.isin(self.keyframes, self.others)

    def names_for(self, image: int) -> list[str]:
        """Of the expectations that say something about a keyframe."""
        at = int(np.searchsorted(self.keyframes, image))
        return [each.name for each in self.expectations if each.known[at]]

    def about(self, images: int, outlying: Indices) -> np.ndarray:
        """(n,) int64, some of the outliers, and images between them and the next of the others: these follow both."""
        numbers = np.arange(images)
        gaps = np.searchsorted(self.others, numbers)
        follow = ~np.isin(numbers, self.keyframes) & np.isin(gaps, gaps[outlying])
        return np.union1d(outlying, numbers[follow])


def find(dataset: Dataset, scans: ScanPoses, visual: VisualStage) -> Outliers | None:
    """The cameras that images are to be asked about; None: none."""
    if visual.result is None or len(visual.result.keyframes) < FEWEST:
        return None
    keyframes, expectations = visual.result.keyframes, _expectations(dataset, scans, visual.result)
    if not expectations:
        return None
    known = np.stack([each.known for each in expectations])
    contradicted = np.zeros_like(known)
    for row, each in zip(contradicted, expectations, strict=True):
        at = np.flatnonzero(each.known)
        row[at[outlier_indices(each.deviation[at])]] = True
    outlying = contradicted.any(axis=0)
    if not outlying.any():
        return None
    by_all = (contradicted == known).all(axis=0) & (known.sum(axis=0) > 1)
    return Outliers(keyframes[outlying], by_all[outlying], keyframes[~outlying], expectations)


def _expectations(dataset: Dataset, scans: ScanPoses, result: VisualResult) -> tuple[Expectation, ...]:
    """Cameras carried along with the scans, and on splines through them, where scans are near; the latter not between the
    two at either end, where they are three times as far off."""
    times, samples = dataset.images.times, Trajectory(dataset.scans.times, scans.world_from_scan)
    near = ~far(samples.times, times)
    expected = [("carried", carry_cameras(dataset, scans.world_from_scan), near[result.keyframes])]
    if len(samples) >= spline.FEWEST_SAMPLES:
        moments = result.moments(times)
        inside = near & (moments >= samples.times[1]) & (moments <= samples.times[-2])
        poses = spline.through(samples, moments) @ result.scan_from_camera
        expected.append(("spline", poses, inside[result.keyframes]))
    solved = result.world_from_camera[result.keyframes]
    return tuple(
        Expectation(name, poses, geometry.log(geometry.inverse(poses[result.keyframes]) @ solved), known)
        for name, poses, known in expected
        if np.count_nonzero(known) >= FEWEST
    )


def outlier_indices(deviation: np.ndarray) -> np.ndarray:
    """Those of n successive cameras whose deviation (n, 6) is not their neighbors', (r,) int64, ascending: that which
    differs most, and again without it."""
    left, most = np.arange(len(deviation)), max(LEAST, int(MOST * len(deviation)))
    typical = np.median(_sizes(_from_most(deviation)), axis=0)
    if not (typical > 0).all():
        return np.zeros(0, np.int64)
    while len(deviation) - len(left) < most:
        off = (_sizes(_from_most(deviation[left])) / typical).max(axis=1)
        if off.max() <= OUTLIER:
            break
        left = np.delete(left, off.argmax())
    return np.setdiff1d(np.arange(len(deviation)), left)


def _from_most(values: np.ndarray) -> np.ndarray:
    """(n, 6): by how much each of n values differs from the median of its four neighbors, of which two may be off."""
    first = np.clip(np.arange(len(values)) - 2, 0, len(values) - 5)
    window = first[:, None] + np.arange(5)
    others = window[window != np.arange(len(values))[:, None]].reshape(-1, 4)
    return np.asarray(values - np.median(values[others], axis=1))


def _sizes(deviation: np.ndarray) -> np.ndarray:
    """(n, 2): of rotations and positions."""
    return np.stack([np.linalg.norm(deviation[:, part], axis=1) for part in (slice(3), slice(3, 6))], axis=1)


def _from_neighbors(times: Times, values: np.ndarray, reach: int = 1) -> np.ndarray:
    """(n, 6): by how much each of n values differs from what those `reach` before and after it say, at the ends one."""
    index = np.arange(len(times))
    before, after = index - reach, index + reach
    first, last = before < 0, after >= len(times)
    before = np.where(first, np.minimum(after, len(times) - 1), before)
    after = np.where(last, np.maximum(before, 0), after)
    span = times[after] - times[before]
    fraction = np.where(span > 0, (times - times[before]) / np.where(span > 0, span, 1.0), 0.0)
    return np.asarray(values - values[before] - fraction[:, None] * (values[after] - values[before]))


def substituted(outliers: Outliers, times: Times, poses: Poses, expected: Expectation) -> np.ndarray:
    """Poses (I, 4, 4) with the outliers, and images about them, at the deviation of the keyframes next to them.

    times: (I,) s; poses: as solved
    """
    at = outliers.about(len(times), outliers.outlying)
    known, deviation = times[outliers.others], expected.deviation[outliers.kept]
    moved = np.stack([np.interp(times[at], known, deviation[:, n]) for n in range(6)], axis=1)
    changed = poses.copy()
    changed[at] = geometry.retract(expected.world_from_camera[at], moved)
    return changed


def compare(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    whole: Dataset,
    scans: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """How well the images of outliers in a part's core are predicted where they are, and by each path; empty: none is.

    dataset: of the part's frames, points, photos: of these; whole, scans, visual: of the recording
    """
    outliers = find(whole, scans, visual)
    if outliers is None or visual.result is None:
        return {}
    core = in_core(outliers.outlying, part)
    if not len(core):
        return {}
    result, mine = visual.result, slice(*part.images)
    cloud = cloud_of(
        dataset, scans.world_from_scan[slice(*part.scans)], progress, ScanReader(points, part.scans[0])
    )
    solved = evaluate.refined_cameras(whole.camera, result).of(mine)
    pictures = PhotoReader(photos, whole.camera, part.images[0])
    views = evaluate.views_by(dataset, pictures, solved)
    poses = {SOLVED: result.world_from_camera} | {
        each.name: substituted(outliers, whole.images.times, result.world_from_camera, each)
        for each in outliers.expectations
    }
    states = {
        name: State(
            cloud,
            evaluate.views_at(
                views,
                replace(solved, world_from_camera=each[mine]),
            ),
        )
        for name, each in poses.items()
    }
    images = (core - part.images[0]).astype(np.int32)
    return as_in_whole(
        leave_one_out(states, config, images, blank_photos(photos, part.images), progress), part
    )


def mend(
    dataset: Dataset, scans: ScanPoses, visual: VisualStage, compared: Sequence[Mapping[str, Scores]]
) -> VisualStage:
    """The cameras with outliers where their neighbors have them, if images say so, or say nothing and all expectations
    agree; where only one contradicts, they stay, and are as uncertain as the two poses are apart.

    compared: of all parts (`compare`)
    """
    outliers = find(dataset, scans, visual)
    scores = together(compared, dict.fromkeys((SOLVED, *_names(compared)), float("nan")))
    if outliers is None or visual.result is None or not scores:
        return visual
    result, times = visual.result, dataset.images.times
    choices = [_better(scores, int(image), outliers.names_for(int(image))) for image in outliers.outlying]
    better = np.array(choices, object)
    better[(better == "") & outliers.by_all] = _nearest(outliers).name
    for expected in outliers.expectations:
        result = _moved(result, outliers, times, expected, outliers.outlying[better == expected.name])
    result = _widened(result, outliers, times, outliers.outlying[better == ""])
    if len(result.substituted):
        named = [
            dataset.image_paths[image] for image in outliers.outlying[(better != "") & (better != SOLVED)]
        ]
        result = replace(result, warnings=(*result.warnings, _warning(named)))
    return replace(visual, result=result)


def _nearest(outliers: Outliers) -> Expectation:
    """The expectation that the other cameras follow most closely, rotations and positions alike."""

    def spread(expected: Expectation) -> float:
        kept = outliers.kept & expected.known
        return float(np.log(_sizes(_from_most(expected.deviation[kept])) + 1e-12).sum(axis=1).mean())

    return min(outliers.expectations, key=spread)


def _names(compared: Sequence[Mapping[str, Scores]]) -> Collection[str]:
    return {name for each in compared for name in each}


def _better(scores: Mapping[str, Scores], image: int, names: Sequence[str]) -> str:
    """The one of these states that predicts an image best, if better than where it was solved by PSNR and SSIM, over its
    own pixels and over common ones; SOLVED: all are worse; "": neither."""
    at = int(np.searchsorted(scores[SOLVED].images, image))
    gains = {
        name: {
            figure: each.per_image[figure][at] - scores[SOLVED].per_image[figure][at]
            for figure in acceptance.LOSSES
        }
        for name, each in scores.items()
        if name in names
    }
    better = {
        name: gain["psnr_compared"]
        for name, gain in gains.items()
        if all(gain[figure] > least for figure, least in acceptance.LOSSES.items())
    }
    if better:
        return max(better, key=lambda name: better[name])
    worse = (
        all(-gain[figure] > least for figure, least in acceptance.LOSSES.items()) for gain in gains.values()
    )
    return SOLVED if all(worse) else ""


def _moved(
    result: VisualResult, outliers: Outliers, times: Times, expected: Expectation, moved: Indices
) -> VisualResult:
    """The result with some outliers (r,) where they are expected, more uncertain by as much as others are off that."""
    if not len(moved):
        return result
    at = outliers.about(len(times), moved)
    poses = result.world_from_camera.copy()
    poses[at] = substituted(outliers, times, poses, expected)[at]
    errors = [_error(outliers, times, expected, int(image)) for image in at]
    return replace(
        _less_certain(result, at, np.array(errors).reshape(-1, 6, 6)),
        world_from_camera=poses,
        keyframes=np.setdiff1d(result.keyframes, moved),
        substituted=np.union1d(result.substituted, at),
    )


def _error(outliers: Outliers, times: Times, expected: Expectation, image: int) -> np.ndarray:
    """(6, 6): how far cameras are off that take their deviation from others as far away, as the others show."""
    gaps = np.searchsorted(outliers.others, outliers.outlying)
    gap = int(np.searchsorted(outliers.others, image))
    missing = int(np.count_nonzero(gaps == gap))
    kept = outliers.kept & expected.known
    deviation, moments = expected.deviation[kept], times[outliers.keyframes[kept]]
    if 0 < gap < len(outliers.others):
        off = _from_neighbors(moments, deviation, (missing + 2) // 2)
    else:
        off = deviation[missing:] - deviation[:-missing]
    return np.asarray(off.T @ off / max(len(off), 1))


def _widened(result: VisualResult, outliers: Outliers, times: Times, unclear: Indices) -> VisualResult:
    """The result with some outliers (r,) as uncertain as they are off where they are expected, by the nearest."""
    if not len(unclear):
        return result
    solved = result.world_from_camera[unclear]
    apart = np.stack(
        [
            geometry.log(
                geometry.inverse(solved)
                @ substituted(outliers, times, result.world_from_camera, expected)[unclear]
            )
            for expected in outliers.expectations
        ]
    )
    nearest = np.linalg.norm(apart, axis=-1).argmin(axis=0)
    off = apart[nearest, np.arange(len(unclear))]
    return _less_certain(result, unclear, off[:, :, None] * off[:, None, :])


def _less_certain(result: VisualResult, images: np.ndarray, errors: np.ndarray) -> VisualResult:
    """The result with poses of some images (n,) less certain by errors of their own (n, 6, 6)."""
    more = np.zeros_like(result.covariance)
    more[images] = errors
    return replace(
        result,
        covariance=result.covariance + more,
        local_covariance=result.local_covariance + more,
        own_covariance=result.own_covariance + more,
    )


def _warning(images: Sequence[str]) -> str:
    """images: their files"""
    listed = first_of([PurePath(image).name for image in images], _NAMED)
    return (
        f"The cameras of {listed} left the trajectory, and their images do not support these poses. Each got the pose "
        "that follows from its neighbors; its expected error is larger. Look at these images: blur, a covered lens and "
        "people before the camera can cause this"
    )
