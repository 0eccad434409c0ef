"""What a reference says of a run: of the result, of the errors that it predicts, and of each part that was judged."""

from typing import Any

import numpy as np

from lvba.dataset import Dataset
from lvba.io.exposures import Exposures
from lvba.io.reference import Reference
from lvba.products import reference as references
from lvba.steps import uncertainty
from lvba.steps.lidar import carry_cameras
from lvba.steps.outcomes import Accepted, FusionStage, LidarStage, ScanPoses, VisualStage
from lvba.steps.uncertainty import Expected
from lvba.trajectory import Trajectory


def collect(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    visual: VisualStage,
    fused: FusionStage,
    accepted: Accepted,
    expected: Expected,
    reference: Reference,
) -> dict[str, Any]:
    """Errors of the result and those that the covariances predict; in `rough` of the input, in `judged` of each part."""
    final_scans = Trajectory(dataset.scans.times, accepted.world_from_scan)
    final_images = Trajectory(dataset.images.times, accepted.world_from_camera)
    facts = _errors(
        dataset, reference, accepted.world_from_scan, accepted.world_from_camera, accepted.log_exposure
    )
    rough = _errors(dataset, reference, dataset.scans.world_from_sensor, dataset.images.world_from_sensor)
    for part, predicted in _predicted(
        expected, visual, accepted, final_scans, final_images, reference
    ).items():
        facts.setdefault(part, {}).update(predicted)
    return {**facts, "rough": rough, "judged": _judged(dataset, lidar, scans, visual, fused, reference)}


def _judged(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    visual: VisualStage,
    fused: FusionStage,
    reference: Reference,
) -> dict[str, Any]:
    """Errors before and after each part that was found, accepted or not, all else as the gate judged it."""
    judged: dict[str, Any] = {}

    def compare(part: str, figure: str, before: tuple[Any, ...], after: tuple[Any, ...]) -> None:
        pair = [_errors(dataset, reference, *state).get(figure) for state in (before, after)]
        if None not in pair:
            judged[part] = dict(zip(("before", "after"), pair, strict=True))

    poses, images = scans.world_from_scan, dataset.images.world_from_sensor
    if lidar.result is not None:
        compare(
            "scans",
            "lidar",
            (dataset.scans.world_from_sensor, images),
            (lidar.result.world_from_scan, images),
        )
    if visual.result is not None:
        carried, result = carry_cameras(dataset, poses), visual.result
        compare("cameras", "camera", (poses, carried), (poses, result.world_from_camera))
        compare("exposures", "exposure", (poses, carried), (poses, carried, result.log_exposure))
    if fused.result is not None:
        compare("fusion", "lidar", (poses, images), (fused.result.world_from_scan, images))
    return judged


def _errors(
    dataset: Dataset,
    reference: Reference,
    world_from_scan: np.ndarray,
    world_from_camera: np.ndarray,
    log_exposure: np.ndarray | None = None,
) -> dict[str, Any]:
    """Errors of one state of the dataset's frames; log_exposure: None: all are exposed alike."""
    times = dataset.images.times
    exposures = np.zeros(len(times)) if log_exposure is None else log_exposure
    return references.compare(
        reference,
        Trajectory(dataset.scans.times, world_from_scan),
        Trajectory(times, world_from_camera),
        Exposures(times, np.exp(exposures)),
    )


def _predicted(
    expected: Expected,
    visual: VisualStage,
    accepted: Accepted,
    final_scans: Trajectory,
    final_images: Trajectory,
    reference: Reference,
) -> dict[str, dict[str, Any]]:
    """Errors that the result predicts. expected: of cameras nothing where the scans are the input's"""
    predicted: dict[str, dict[str, Any]] = {}
    scan_alignment = references.scan_alignment(reference, final_scans)
    aligned = None if scan_alignment is None else scan_alignment.reference_from_estimate
    if expected.scans is not None and reference.scans is not None:
        predicted["lidar"] = uncertainty.against(final_scans, expected.scans, reference.scans, aligned)
    if expected.cameras is not None and reference.images is not None:
        predicted["camera"] = uncertainty.against(final_images, expected.cameras, reference.images, aligned)
    if visual.result is not None and accepted.exposures.accepted and reference.exposures is not None:
        predicted["exposure"] = uncertainty.of_exposures(
            final_images.times,
            accepted.log_exposure,
            visual.result.log_exposure_sigma,
            reference.exposures.times,
            reference.exposures.relative,
        )
    return predicted
