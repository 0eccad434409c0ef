"""The steps that score the states of a recording and choose the one that becomes the result."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from lvba.dataset import Dataset
from lvba.products import evaluate as evaluation
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.recorded_images import views_of
from lvba.progress import Progress, silent
from lvba.steps import acceptance, scan_acceptance
from lvba.steps.acceptance import (
    CARRIED,
    EXPOSED,
    FUSED,
    FUSED_POSED,
    POSED,
    ROUGH,
    VISUAL,
    GateConfig,
    Verdict,
)
from lvba.steps.lidar import carry_cameras, cloud_of
from lvba.steps.outcomes import Accepted, ScanPoses, VisualStage


@dataclass(frozen=True)
class Choice:
    """The judged state that is used, and the verdicts on what it holds of what the visual stage and the fusion found."""

    state: str
    cameras: Verdict
    exposures: Verdict
    fusion: Verdict


def evaluate(
    dataset: Dataset,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of the input and of what each stage made of it, by name (see `acceptance`); empty without images.

    Of states that are neither input nor result there are only the figures that decide; the others are NaN.
    """
    if not dataset.image_paths:
        return {}
    states = judged_states(dataset, scans, fused, visual, progress)
    entropies = entropies_of(states, scans, fused)
    expected = next(name for name in (FUSED, VISUAL, CARRIED) if name in states)
    brief = set(states) - {ROUGH, expected}
    scores = evaluation.evaluate(states, config, entropies=entropies, brief=brief, progress=progress)
    chosen = choose(scores, scans, fused, visual, gates).state
    if chosen in brief:
        only = evaluation.evaluate({chosen: states[chosen]}, config, entropies=entropies, progress=progress)
        scores[chosen] = evaluation.completed(scores[chosen], only[chosen])
    return scores


def entropies_of(states: Iterable[str], scans: ScanPoses, fused: ScanPoses) -> dict[str, float]:
    """Mean map entropy of the judged states, nats, by name."""
    special = {ROUGH: scans.entropy_rough, FUSED: fused.entropy, FUSED_POSED: fused.entropy}
    return {name: special.get(name, scans.entropy) for name in states}


def judged_states(
    dataset: Dataset, scans: ScanPoses, fused: ScanPoses, visual: VisualStage, progress: Progress = silent
) -> dict[str, State]:
    """Cloud and views of each state that is judged, by name."""
    rough = cloud_of(dataset, dataset.scans.world_from_sensor, progress)
    own = cloud_of(dataset, scans.world_from_scan, progress) if scans.verdict.accepted else rough
    clouds = {ROUGH: rough}
    if fused.verdict.accepted:
        clouds[FUSED] = clouds[FUSED_POSED] = cloud_of(dataset, fused.world_from_scan, progress)
    base = views_of(dataset)
    return {
        name: State(
            clouds.get(name, own),
            dataclasses.replace(base, world_from_camera=poses, log_exposure=log_exposure),
        )
        for name, (poses, log_exposure) in camera_states(dataset, scans, fused, visual).items()
    }


def camera_states(
    dataset: Dataset, scans: ScanPoses, fused: ScanPoses, visual: VisualStage
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World_from_camera (I, 4, 4) and log exposure (I,) of each state that is judged, by name."""
    equal = np.zeros(len(dataset.image_paths))
    rough = dataset.images.world_from_sensor
    carried = carry_cameras(dataset, scans.world_from_scan) if scans.verdict.accepted else rough
    states = {ROUGH: (rough, equal), CARRIED: (carried, equal)}
    if visual.result is None:
        return states
    poses, exposures = visual.result.world_from_camera, visual.result.log_exposure
    states |= {EXPOSED: (carried, exposures), POSED: (poses, equal), VISUAL: (poses, exposures)}
    if fused.verdict.accepted:
        states |= {FUSED_POSED: states[POSED], FUSED: states[VISUAL]}
    return states


def choose(
    scores: Mapping[str, Scores], scans: ScanPoses, fused: ScanPoses, visual: VisualStage, config: GateConfig
) -> Choice:
    """Each part that the visual stage and the fusion found, judged by itself: all else is equal on both sides.

    Exposures at the camera poses found, and once more at the carried ones where those are not used; cameras with the
    exposures that are used; fused scans with the cameras and exposures that are used.
    """
    if visual.result is None:
        nothing = Verdict(False, f"input kept: {visual.problem}")
        return Choice(CARRIED, nothing, nothing, fused.verdict)
    exposures = acceptance.judge_exposures(scores[POSED], scores[VISUAL], config)
    before, after = (EXPOSED, VISUAL) if exposures.accepted else (CARRIED, POSED)
    cameras = acceptance.judge_cameras(scores[before], scores[after], config)
    if not cameras.accepted:
        exposures = acceptance.judge_exposures(scores[CARRIED], scores[EXPOSED], config)
        state = EXPOSED if exposures.accepted else CARRIED
        fusion = fused.verdict
        if fusion.accepted:
            fusion = Verdict(
                False, "scans stay where the LiDAR has them: the cameras were not accepted", fusion.figures
            )
        return Choice(state, cameras, exposures, fusion)
    if not fused.verdict.accepted:
        return Choice(after, cameras, exposures, fused.verdict)
    together = FUSED if exposures.accepted else FUSED_POSED
    images = acceptance.image_figures(scores[after], scores[together], config)
    fusion = acceptance.judge_fusion(
        scan_acceptance.rough_gain(scans), fused.verdict.figures[0], images, config
    )
    return Choice(together if fusion.accepted else after, cameras, exposures, fusion)


def decide(
    dataset: Dataset,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    scores: Mapping[str, Scores],
    config: GateConfig,
) -> Accepted:
    """The state that holds every part that was accepted, and the input's where one was not."""
    chosen = choose(scores, scans, fused, visual, config)
    used = fused if chosen.fusion.accepted else scans
    return Accepted(
        used.world_from_scan,
        *camera_states(dataset, scans, fused, visual)[chosen.state],
        scans.verdict,
        chosen.cameras,
        chosen.exposures,
        chosen.fusion,
        chosen.state,
        _remark(scores, chosen.state),
    )


def _remark(scores: Mapping[str, Scores], state: str) -> str:
    """What is to be said of images that are predicted no better from the result; empty: nothing."""
    if not scores:
        return ""
    rough, final = (scores[name].psnr_leave_one_out for name in (ROUGH, state))
    if not final < rough:
        return ""
    return f"images are predicted no better, within chance (leave-one-out PSNR {rough:.3f} -> {final:.3f} dB)"
