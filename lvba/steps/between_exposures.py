"""The steps that find exposures of images between keyframes, by the map that keyframes color.

Interpolated, they miss what the camera did between keyframes: 2 % where images are .3 s apart. A map colored by these,
with their exposures, shows each other image as bright as it would be at an exposure of one. So it does keyframes whose
own patches tell little of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba.blocks.decoded_images import PhotoReader, blank_photos
from lvba.blocks.decoded_scans import ScanPieces, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.products import brightness
from lvba.products import evaluate as evaluation
from lvba.products.evaluate import EvaluateConfig, State
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.steps.evaluate import refined_cameras, views_at, views_by
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import ScanPoses, VisualStage
from lvba.steps.part_scores import in_core
from lvba.trajectory import nearest_in_time
from lvba.visual import exposures_between
from lvba.visual.result import VisualResult

_WITNESSES = 40
"""Keyframes that tell how good exposures by the map are."""
_LEAST = 1e-4
"""No exposure is known better than that."""


@dataclass(frozen=True)
class BetweenKeyframes:
    """images: (J,) int64, numbers in the whole recording; log_exposure: (J,) float64, natural logs, in the scale of the
    keyframes' exposures; sigma: (J,) float64, their standard deviations beside those of these"""

    images: np.ndarray
    log_exposure: np.ndarray
    sigma: np.ndarray


def measure(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    scans: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> BetweenKeyframes:
    """Exposures of the images in a part's core that are no keyframes, or of which little is known, where the map that the
    others color shows them.

    dataset: of the part's frames, points, photos: of these; scans, visual: of the whole
    """
    nothing = BetweenKeyframes(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    result = visual.result
    if result is None:
        return nothing
    numbers = np.arange(*part.images)
    certain = np.intersect1d(numbers, _certain(result))
    unknown = in_core(np.setdiff1d(numbers, certain), part)
    if not len(unknown):
        return nothing
    blank = blank_photos(photos, part.images)
    known = np.setdiff1d(certain - part.images[0], blank).astype(np.int32)
    asked = np.setdiff1d(unknown - part.images[0], blank).astype(np.int32)
    if not (len(known) and len(asked)):
        return nothing
    views = _views(dataset, part, photos, result)
    poses = scans.world_from_scan[slice(*part.scans)]
    cloud = cloud_of(dataset, poses, progress, ScanReader(points, part.scans[0]))
    others = np.setdiff1d(np.arange(len(numbers), dtype=np.int32), known)
    [colored] = evaluation.color_by_paper([State(cloud, views)], others, progress)
    witnesses = evaluation.spread_evenly(known, _WITNESSES)
    log_exposure, sigma = brightness.of_others(colored, views, asked, witnesses, config.render)
    times, own = dataset.images.times, result.log_exposure_sigma[numbers[asked]]
    line = exposures_between.off_line(times[known], result.log_exposure[numbers[known]], times[asked])
    seen = _tells(sigma, own, line)
    return BetweenKeyframes(numbers[asked[seen]], log_exposure[seen], sigma[seen])


def _tells(sigma: np.ndarray, own: np.ndarray, line: np.ndarray) -> np.ndarray:
    """(J,) bool: exposures to which the map adds something.

    Of what nothing else is known, the line through the others may still be the better guess.
    sigma: (J,) float64, standard deviations by the map; own: known before, inf: nothing; line: of that line
    """
    return np.asarray(np.isfinite(sigma) & (np.isfinite(own) | (sigma < line)))


def _certain(result: VisualResult) -> np.ndarray:
    """(n,) int64, ascending: keyframes of whose exposures their own patches tell about as much as of most."""
    sigma = result.log_exposure_sigma[result.keyframes]
    return np.asarray(result.keyframes[np.isfinite(sigma) & ~exposures_between.uncertain(sigma)], np.int64)


def _views(dataset: Dataset, part: Part, photos: Pieces[np.ndarray], result: VisualResult) -> Views:
    """The images of a part at the poses and exposures found. Arguments as of `measure`"""
    cameras = refined_cameras(dataset.camera, result).of(slice(*part.images))
    pictures = PhotoReader(photos, dataset.camera, part.images[0])
    return views_at(views_by(dataset, pictures, cameras), cameras)


def merge(visual: VisualStage, parts: Sequence[BetweenKeyframes]) -> VisualStage:
    """The stage with the exposures of images between keyframes by what the map says and by interpolation, each by how far
    it may be off."""
    known = [each for each in parts if len(each.images)]
    if visual.result is None or not known or not len(_certain(visual.result)):
        return visual
    images = np.concatenate([each.images for each in known])
    value = np.concatenate([each.log_exposure for each in known])
    sigma = np.concatenate([each.sigma for each in known])
    # keyframes may have moved a little since
    over = visual.over_fused
    moved = 0.0 if over is None else (over.log_exposure - visual.result.log_exposure)[images]
    return replace(
        visual,
        result=_with(visual.result, images, value, sigma),
        over_fused=None if over is None else _with(over, images, value + moved, sigma),
    )


def _with(result: VisualResult, images: np.ndarray, value: np.ndarray, sigma: np.ndarray) -> VisualResult:
    """The result with what the map says of the exposures of some images (J,)."""
    log_exposure, spread = result.log_exposure.copy(), result.log_exposure_sigma.copy()
    certain = _certain(result)
    nearest = certain[nearest_in_time(certain, images)]
    by_map = np.hypot(np.maximum(sigma, _LEAST), spread[nearest])
    weights = 1 / np.stack([by_map, np.maximum(spread[images], _LEAST)]) ** 2
    log_exposure[images] = (weights * np.stack([value, log_exposure[images]])).sum(axis=0) / weights.sum(
        axis=0
    )
    spread[images] = 1 / np.sqrt(weights.sum(axis=0))
    return replace(result, log_exposure=log_exposure - log_exposure[0], log_exposure_sigma=spread)
