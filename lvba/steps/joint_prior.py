"""What is known of the cameras of all parts beforehand: their prior, as the parts' own solves found it."""

import functools
import operator
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lvba.blocks.split import Part
from lvba.blocks.survey import Survey, keyframes_of
from lvba.dataset import Dataset
from lvba.lidar import covariance
from lvba.steps.outcomes import LidarStage, ScanPoses, VisualStage
from lvba.visual import trajectory_prior
from lvba.visual.clock import clock_drifts, common_calibration, evidence_from
from lvba.visual.config import VisualConfig
from lvba.visual.result import VisualResult
from lvba.visual.trajectory_prior import Prior


def results_of(stages: Sequence[VisualStage]) -> list[VisualResult]:
    """Of those parts that could be solved."""
    return [part.result for part in stages if part.result is not None]


def prior_of_all(dataset: Dataset, lidar: LidarStage, scans: ScanPoses, config: VisualConfig) -> Prior:
    """Of all images, with sigmas as first guessed."""
    local_covariance = None
    if lidar.result is not None and scans.verdict.accepted:
        local_covariance = covariance.local_covariance(lidar.result.pose_covariance, scans.world_from_scan)
    return trajectory_prior.build(
        dataset.scans,
        scans.world_from_scan,
        dataset.images,
        dataset.camera_from_scan,
        config.prior,
        local_covariance,
        lidar.planes_off,
    )


def prior_of_keyframes(
    dataset: Dataset,
    cores: Sequence[Part],
    stages: Sequence[VisualStage],
    lidar: LidarStage,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> Prior:
    """Of all keyframes, with the sigmas that the parts found."""
    prior = trajectory_prior.take(prior_of_all(dataset, lidar, scans, config), survey.keyframes)
    sources = []
    for number, source in enumerate(prior.sources):
        rotation, position = source.sigma_rotation.copy(), source.sigma_position.copy()
        of_parts = []
        for core, part in zip(cores, stages, strict=True):
            if part.tuning is None or number >= len(part.tuning.correlation_inflation):
                continue
            mine, inside = _keyframes_of_core(core, survey)
            turns, moves = source.spoken[mine].T
            rotation[mine[turns]] = part.tuning.sigma_rotation[number][inside][turns]
            position[mine[moves]] = part.tuning.sigma_position[number][inside][moves]
            of_parts.append(part.tuning.correlation_inflation[number])
        factor = (
            tuple(float(value) for value in np.mean(of_parts, axis=0))
            if of_parts
            else source.correlation_inflation
        )
        sources.append(
            replace(
                source,
                sigma_rotation=rotation,
                sigma_position=position,
                correlation_inflation=(factor[0], factor[1]),
            )
        )
    known = [
        (part.tuning, part.result) for part in stages if part.tuning is not None and part.result is not None
    ]
    results = results_of(stages)
    drifting = any(tuning.drifting for tuning, _ in known) or clock_drifts(results)
    said = [
        evidence_from(tuning.evidence, prior.epoch - result.clock_epoch if drifting else 0.0)
        for tuning, result in known
        if tuning.evidence is not None
    ]
    prior = replace(prior, sources=tuple(sources), drifting=drifting)
    if said:
        prior = trajectory_prior.weighed(prior, functools.reduce(operator.add, said))
    if results:
        prior = trajectory_prior.with_late(prior, common_calibration(results, prior.epoch))
    return trajectory_prior.with_fixed(prior, fixed_in_all(stages))


def motion_of_keyframes(
    cores: Sequence[Part], stages: Sequence[VisualStage], survey: Survey
) -> np.ndarray | None:
    """(K, 6): of each keyframe, as the part of its core has it; None: no part has any."""
    if all(part.tuning is None or part.tuning.motion is None for part in stages):
        return None
    motion = np.zeros((len(survey.keyframes), 6))
    for core, part in zip(cores, stages, strict=True):
        if part.tuning is not None and part.tuning.motion is not None:
            mine, inside = _keyframes_of_core(core, survey)
            motion[mine] = part.tuning.motion[inside]
    return motion


def _keyframes_of_core(core: Part, survey: Survey) -> tuple[np.ndarray, np.ndarray]:
    """Numbers among all keyframes of those in a part's core, and which of the part's own (k,) bool these are."""
    local = core.image_numbers[keyframes_of(survey, core.frames)]
    inside = (local >= core.core_images[0]) & (local < core.core_images[1])
    return np.searchsorted(survey.keyframes, local[inside]), inside


def fixed_in_all(stages: Sequence[VisualStage]) -> list[str]:
    """The parameters of the calibration that no part corrects: a value that one proves wrong is wrong in all."""
    fixed = [set(part.tuning.fixed) for part in stages if part.tuning is not None]
    return sorted(set.intersection(*fixed)) if fixed else []
