"""The steps that choose whether the camera is used as images correct it, or as it was calibrated.

Images correct a camera where patches of pairs of images call for it, and may take other errors for one of the camera:
that ranges are off, or the extrinsic, moves patches much as a lens does. A map that other images colored shows which
camera predicts images better.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lvba.blocks.decoded_images import PhotoReader, blank_photos
from lvba.blocks.decoded_scans import ScanPieces, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.products import evaluate as evaluation
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.progress import Progress, silent
from lvba.steps import acceptance, evaluate
from lvba.steps.acceptance import Figure, GateConfig
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import ScanPoses, VisualStage
from lvba.steps.part_scores import as_in_whole, in_core, leave_one_out, together

CALIBRATED, CORRECTED = "calibrated", "corrected"
IMAGES = 20
"""So many images, spread evenly, say which it is: a camera that is wrong shows in all of them."""


def compare(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    images: int,
    scans: ScanPoses,
    corrected: VisualStage,
    calibrated: VisualStage | None,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """How well some images in a part's core are predicted by its cameras with the camera as corrected, and as calibrated;
    empty: it was not corrected.

    dataset: of the part's frames, points, photos: of these; images: how many the whole recording has
    corrected, calibrated: of the part; scans: of the recording
    """
    if corrected.result is None or calibrated is None or calibrated.result is None:
        return {}
    blank = blank_photos(photos, part.images)
    asked = evaluation.judged_images(images, np.zeros(0, np.int32), IMAGES)
    core = np.setdiff1d(in_core(asked, part), blank + np.int32(part.images[0]))
    if not len(core):
        return {}
    poses = scans.world_from_scan[slice(*part.scans)]
    cloud = cloud_of(dataset, poses, progress, ScanReader(points, part.scans[0]))
    pictures = PhotoReader(photos, dataset.camera, part.images[0])
    states = {}
    for name, result in ((CALIBRATED, calibrated.result), (CORRECTED, corrected.result)):
        cameras = evaluate.refined_cameras(dataset.camera, result)
        views = evaluate.views_by(dataset, pictures, cameras)
        states[name] = State(cloud, evaluate.views_at(views, cameras))
    own = (core - part.images[0]).astype(np.int32)
    return as_in_whole(leave_one_out(states, config, own, blank, progress), part)


def choose(
    corrected: VisualStage,
    calibrated: VisualStage | None,
    compared: Sequence[Mapping[str, Scores]],
    config: GateConfig,
) -> VisualStage:
    """The cameras of a part with the camera as corrected, unless images of the recording speak for it as calibrated.

    compared: of all parts (`compare`): one camera took all images
    """
    scores = together(compared, {})
    if calibrated is None or calibrated.result is None or not scores or not config.enabled:
        return corrected
    figures = acceptance.image_figures(scores[CALIBRATED], scores[CORRECTED], config)
    if not _speak_for_calibrated(figures):
        return corrected
    result, psnr = calibrated.result, figures[0]
    warning = (
        "The visual bundle adjustment corrected the calibration, but the corrected camera predicts the images worse "
        f"(PSNR {psnr.before:.2f} -> {psnr.after:.2f} dB). The run used the original calibration. Range or extrinsic "
        "errors can cause this"
    )
    return replace(calibrated, result=replace(result, warnings=(*result.warnings, warning)))


def _speak_for_calibrated(figures: Sequence[Figure]) -> bool:
    """Whether images are predicted worse by the corrected camera, by PSNR, and SSIM does not deny it; over the pixels of
    each state and over those of both alike."""
    finding = {each.name: each.finding for each in figures}
    worse = all(finding[name] == "worse" for name in ("psnr_leave_one_out", "psnr_compared"))
    denied = all(finding[name] == "better" for name in ("ssim_leave_one_out", "ssim_compared"))
    return worse and not denied
