"""The steps that score the states of a recording and choose the one that becomes the result."""

import dataclasses
import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Poses
from lvba.blocks.decoded_images import PhotoReader, blank_photos
from lvba.blocks.decoded_scans import ScanPieces, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.products import evaluate as evaluation
from lvba.products import judging_size, recorded_images
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.recorded_images import views_of
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.steps import acceptance, camera_agreement, scan_acceptance
from lvba.steps.acceptance import (
    CARRIED,
    EXPOSED,
    FUSED,
    FUSED_CARRIED,
    FUSED_EXPOSED,
    FUSED_POSED,
    POSED,
    ROUGH,
    VISUAL,
    GateConfig,
    Verdict,
)
from lvba.steps.camera_agreement import Apart
from lvba.steps.lidar import carry_cameras, cloud_of
from lvba.steps.outcomes import Accepted, ScanPoses, VisualStage
from lvba.steps.part_scores import as_in_whole, in_core, together
from lvba.visual import self_calibration
from lvba.visual.radiometry import NONE, Radiometry
from lvba.visual.result import VisualResult

CLEAR = 2.0
"""A gain of so many times the standard errors that it must exceed is one whichever images are asked ..."""
LEAST_CONFIDENCE = 2.0
"""... and of no fewer than so many times CLEAR, however few it must exceed."""


_BY_FUSED = {FUSED_CARRIED: CARRIED, FUSED_EXPOSED: EXPOSED}
"""States that are judged only where they become the result, and the same ones without the scans refined with cameras."""
_WITH_FUSED = {POSED: FUSED_POSED, VISUAL: FUSED, CARRIED: FUSED_CARRIED, EXPOSED: FUSED_EXPOSED}
"""States, and the same ones with the scans refined with the cameras."""
_OVER_FUSED = frozenset(_WITH_FUSED.values())


@dataclass(frozen=True)
class Choice:
    """The judged state that is used, and the verdicts on what it holds of what the visual stage and the fusion found."""

    state: str
    cameras: Verdict
    exposures: Verdict
    fusion: Verdict


@dataclass(frozen=True)
class Cameras:
    """world_from_camera: (I, 4, 4); log_exposure: (I,); camera: of the raw images, as these poses suppose it; radiometry:
    as these exposures do; turns: (I, 3) rad, while their rows are read, as of `VisualResult`"""

    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    camera: Camera
    radiometry: Radiometry = NONE
    turns: np.ndarray | None = None

    def of(self, images: slice) -> "Cameras":
        """Those of some images."""
        return dataclasses.replace(
            self,
            world_from_camera=self.world_from_camera[images],
            log_exposure=self.log_exposure[images],
            turns=None if self.turns is None else self.turns[images],
        )


def evaluate(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    images: int,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores, over the images in a part's core, of the input and of what each stage made of it, by name (see
    `acceptance`); empty where no image is judged.

    dataset: of the part's frames, points, photos: of these; images: how many the whole recording has
    scans, fused, visual: of the whole
    Of states that are neither input nor expected to be the result there are only the figures that decide; the others
    are NaN. Images that show nothing are not judged, and color nothing: about them all would be wrong, whatever the poses
    are. A part that is the whole recording is judged on a few images where these leave no doubt (`is_clear`).
    """
    blank = blank_photos(photos, part.images)
    asked = _judged(images, part, config)
    core = evaluation.instead_of_blank(asked, blank + np.int32(part.images[0]), part.core_images)
    if not len(core):
        return {}
    read = ScanReader(points, part.scans[0])
    states = judged_states(dataset, part, read, photos, *of_part(scans, fused, visual, part), progress)
    alone = part.core_images == (0, images)
    scores = evaluation.evaluate(
        states,
        config,
        entropies=entropies_of(states, scans, fused),
        brief=_brief(states),
        apart={ROUGH},
        held_out=blank,
        images=core - part.images[0],
        enough=functools.partial(is_clear, scans=scans, fused=fused, visual=visual, config=gates)
        if alone
        else None,
        progress=progress,
    )
    return as_in_whole(scores, part)


def complete(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    images: int,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    scores: dict[str, Scores],
    accepted: Accepted,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of a part with all figures of the state that became the result. Arguments as of `evaluate`."""
    name = accepted.state
    if not scores or name not in _brief(scores) | set(_BY_FUSED):
        return scores
    core = scores[ROUGH].images - part.images[0]
    read = ScanReader(points, part.scans[0])
    # pixels that both cover are those that the input is compared over
    names = [ROUGH, name] if name in _BY_FUSED else [name]
    states = judged_states(dataset, part, read, photos, *of_part(scans, fused, visual, part), progress, names)
    only = evaluation.evaluate(
        states,
        config,
        held_out=blank_photos(photos, part.images),
        entropies=entropies_of(names, scans, fused),
        brief={ROUGH} & set(names),
        images=core,
        progress=progress,
    )
    if name in _BY_FUSED:
        compared = evaluation.compared_over(scores[ROUGH], only[ROUGH])
        return scores | {ROUGH: compared, name: only[name]}
    return scores | {name: evaluation.completed(scores[name], only[name])}


def merge_scores(
    parts: Sequence[Mapping[str, Scores]], scans: ScanPoses, fused: ScanPoses
) -> dict[str, Scores]:
    """The scores over the images of all parts."""
    names = {name for scores in parts for name in scores}
    return together(parts, entropies_of(names, scans, fused))


def of_part(
    scans: ScanPoses, fused: ScanPoses, visual: VisualStage, part: Part
) -> tuple[ScanPoses, ScanPoses, VisualStage]:
    """What was found, for the frames of one part only."""
    visual = VisualStage(
        _of_images(visual.result, part), visual.problem, over_fused=_of_images(visual.over_fused, part)
    )
    own, with_cameras = (
        dataclasses.replace(poses, world_from_scan=poses.world_from_scan[slice(*part.scans)])
        for poses in (scans, fused)
    )
    return own, with_cameras, visual


def _of_images(result: VisualResult | None, part: Part) -> VisualResult | None:
    """Poses and exposures of a part's images only."""
    if result is None:
        return None
    mine = slice(*part.images)
    return dataclasses.replace(
        result,
        world_from_camera=result.world_from_camera[mine],
        log_exposure=result.log_exposure[mine],
        turns=None if result.turns is None else result.turns[mine],
    )


def _judged(images: int, part: Part, config: EvaluateConfig) -> np.ndarray:
    """The images of a part's core that are judged, numbered as in the whole recording of so many images."""
    if not images:
        return np.zeros(0, np.int32)
    return in_core(evaluation.judged_images(images, np.zeros(0, np.int32), config.max_images), part)


def _brief(states: Collection[str]) -> set[str]:
    """The states that are neither input nor expected to be the result."""
    if not states:
        return set()
    expected = next(name for name in (FUSED, VISUAL, CARRIED) if name in states)
    return set(states) - {ROUGH, expected}


def entropies_of(states: Iterable[str], scans: ScanPoses, fused: ScanPoses) -> dict[str, float]:
    """Mean map entropy of the judged states, nats, by name."""
    special = {ROUGH: scans.entropy_rough} | dict.fromkeys(_OVER_FUSED, fused.entropy)
    return {name: special.get(name, scans.entropy) for name in states}


def judged_states(
    dataset: Dataset,
    part: Part,
    read: ScanReader,
    photos: Pieces[np.ndarray],
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    progress: Progress = silent,
    names: Sequence[str] | None = None,
) -> dict[str, State]:
    """Cloud and views of some states by name; None: of all that are judged beside each other.

    read: gives points of the dataset; photos: raw images
    """
    known = camera_states(dataset, scans, fused, visual)
    if names is not None:
        every = known | over_fused(dataset, fused, known)
        known = {name: every[name] for name in names}
    by_scans = {name: _scan_poses(dataset, name, scans, fused) for name in known}
    each = {id(poses): poses for poses in by_scans.values()}
    clouds = {key: cloud_of(dataset, poses, progress, read) for key, poses in each.items()}
    views: dict[tuple[Camera, int], Views] = {}
    pictures, states = PhotoReader(photos, dataset.camera, part.images[0]), {}
    for name, cameras in known.items():
        seen = cameras.camera, id(cameras.turns)
        if seen not in views:
            views[seen] = views_by(dataset, pictures, cameras)
        states[name] = State(clouds[id(by_scans[name])], views_at(views[seen], cameras))
    return states


def _scan_poses(dataset: Dataset, name: str, scans: ScanPoses, fused: ScanPoses) -> Poses:
    """(S, 4, 4): the scan poses of a state."""
    if name in _OVER_FUSED:
        return fused.world_from_scan
    kept = name != ROUGH and scans.verdict.accepted
    return scans.world_from_scan if kept else dataset.scans.world_from_sensor


def views_by(dataset: Dataset, pictures: PhotoReader, cameras: Cameras) -> Views:
    """The images of a dataset as these cameras took them, where the input has their poses. pictures: of the dataset"""
    return views_of(dataset.with_camera(cameras.camera), pictures.seen_by(cameras.camera, cameras.turns))


def views_at(views: Views, cameras: Cameras) -> Views:
    """The views of a recording where these cameras have them. views: with the same camera"""
    return dataclasses.replace(
        views,
        world_from_camera=cameras.world_from_camera,
        log_exposure=cameras.log_exposure,
        light=recorded_images.light_in(cameras.radiometry, judging_size.judging(cameras.camera)),
        curve=cameras.radiometry.response,
    )


def camera_states(
    dataset: Dataset, scans: ScanPoses, fused: ScanPoses, visual: VisualStage
) -> dict[str, Cameras]:
    """The cameras of each state that is judged, by name."""
    equal, camera = np.zeros(len(dataset.image_paths)), dataset.camera
    rough = dataset.images.world_from_sensor
    carried = carry_cameras(dataset, scans.world_from_scan) if scans.verdict.accepted else rough
    states = {ROUGH: Cameras(rough, equal, camera), CARRIED: Cameras(carried, equal, camera)}
    if visual.result is None:
        return states
    refined = refined_cameras(camera, visual.result)
    states |= {
        EXPOSED: dataclasses.replace(refined, world_from_camera=carried, camera=camera, turns=None),
        POSED: dataclasses.replace(refined, log_exposure=equal, radiometry=NONE),
        VISUAL: refined,
    }
    if fused.verdict.accepted:
        moved = refined if visual.over_fused is None else refined_cameras(camera, visual.over_fused)
        states |= {FUSED_POSED: dataclasses.replace(moved, log_exposure=equal, radiometry=NONE), FUSED: moved}
    return states


def over_fused(dataset: Dataset, fused: ScanPoses, states: Mapping[str, Cameras]) -> dict[str, Cameras]:
    """The cameras of the states that are judged only where they become the result. states: of `camera_states`"""
    carried = carry_cameras(dataset, fused.world_from_scan)
    return {
        name: dataclasses.replace(states[before], world_from_camera=carried)
        for name, before in _BY_FUSED.items()
        if before in states
    }


def refined_cameras(camera: Camera, result: VisualResult) -> Cameras:
    """The cameras as the visual stage has them. camera: of the raw images, as calibrated"""
    refined = self_calibration.corrected(camera, result.calibration)
    return Cameras(result.world_from_camera, result.log_exposure, refined, result.radiometry, result.turns)


def choose(
    scores: Mapping[str, Scores],
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    config: GateConfig,
    apart: Apart | None = None,
) -> Choice:
    """Each part that the visual stage and the fusion found, judged by itself: all else is equal on both sides.

    Exposures at the camera poses found, and once more at the carried ones where those are not used; cameras with the
    exposures that are used; fused scans with the cameras and exposures that are used, or the refined ones that confirm
    these. Without scores nothing is used.
    apart: how far refined cameras are from the carried ones; None: not known
    """
    if visual.result is None:
        nothing = Verdict(False, "input kept", f"{visual.problem}")
        return Choice(CARRIED, nothing, nothing, fused.verdict)
    if not scores:
        return _unjudged(fused, config)
    exposures = acceptance.judge_exposures(scores[POSED], scores[VISUAL], config)
    before, after = (EXPOSED, VISUAL) if exposures.accepted else (CARRIED, POSED)
    extrinsic = visual.result.extrinsic_change
    cameras = acceptance.judge_cameras(scores[before], scores[after], config, extrinsic, apart)
    fusion = fused.verdict
    if fusion.accepted and (cameras.accepted or cameras.confirmed):
        images = acceptance.image_figures(scores[after], scores[_WITH_FUSED[after]], config)
        gained = scan_acceptance.rough_gain(scans)
        entropy = [each for each in fusion.figures if each.name in (acceptance.ENTROPY, acceptance.DRAWN)]
        fusion = acceptance.judge_fusion(gained, entropy, images, config, cameras.figures)
    state = after
    if not cameras.accepted:
        exposures = acceptance.judge_exposures(scores[CARRIED], scores[EXPOSED], config)
        state = EXPOSED if exposures.accepted else CARRIED
        fusion = fusion if cameras.confirmed else _without_cameras(fusion)
    return Choice(_WITH_FUSED[state] if fusion.accepted else state, cameras, exposures, fusion)


def _unjudged(fused: ScanPoses, config: GateConfig) -> Choice:
    """What is used where every image that could be judged shows nothing: the input, unless the gate is off."""
    if config.enabled:
        kept = Verdict(False, "input kept", "no image can be judged (black or clipped)")
        return Choice(CARRIED, kept, kept, _without_cameras(fused.verdict))
    unjudged = Verdict(True, "accepted unjudged (gate.enabled is false)")
    return Choice(FUSED if fused.verdict.accepted else VISUAL, unjudged, unjudged, fused.verdict)


def _without_cameras(fusion: Verdict) -> Verdict:
    """The verdict on fused scans where the cameras are not used."""
    if not fusion.accepted:
        return fusion
    return Verdict(False, "scans keep the LiDAR result", "the cameras were not accepted", fusion.figures)


def is_clear(
    scores: Mapping[str, Scores], scans: ScanPoses, fused: ScanPoses, visual: VisualStage, config: GateConfig
) -> bool:
    """Whether more images could hardly change what is chosen: every part gains by CLEAR times what it must exceed, and no
    figure loses more than contradicts nothing."""
    if visual.result is None or not config.enabled:
        return True
    twice = min(CLEAR * max(config.confidence, LEAST_CONFIDENCE), 100.0)
    chosen = choose(scores, scans, fused, visual, dataclasses.replace(config, confidence=twice))
    verdicts = [chosen.cameras, chosen.exposures, *([chosen.fusion] if fused.verdict.accepted else [])]
    if not all(verdict.accepted for verdict in verdicts):
        return False
    figures = [figure for verdict in verdicts for figure in verdict.figures]
    return all(-figure.gain <= acceptance.LOSSES.get(figure.name, np.inf) for figure in figures)


def decide(
    dataset: Dataset,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    scores: Mapping[str, Scores],
    config: GateConfig,
) -> Accepted:
    """The state that holds every part that was accepted, and the input's where one was not."""
    states = camera_states(dataset, scans, fused, visual)
    chosen = choose(scores, scans, fused, visual, config, _apart(states[CARRIED], scans, visual))
    used = fused if chosen.fusion.accepted else scans
    cameras = (states | over_fused(dataset, fused, states))[chosen.state]
    balance = None if visual.result is None or not chosen.exposures.accepted else visual.result.white_balance
    return Accepted(
        world_from_scan=used.world_from_scan,
        world_from_camera=cameras.world_from_camera,
        log_exposure=cameras.log_exposure,
        camera=cameras.camera if dataset.image_paths else None,
        turns=cameras.turns,
        radiometry=cameras.radiometry,
        scans=scans.verdict,
        cameras=chosen.cameras,
        exposures=chosen.exposures,
        fusion=chosen.fusion,
        state=chosen.state,
        white_balance=balance,
        remark=_remark(scores, _BY_FUSED.get(chosen.state, chosen.state)),
    )


def _apart(carried: Cameras, scans: ScanPoses, visual: VisualStage) -> Apart | None:
    """How far refined cameras are from those carried along with refined scans; None: there are none of either."""
    result = visual.result
    if result is None or not scans.verdict.accepted:
        return None
    return camera_agreement.apart(result.world_from_camera, result.covariance, carried.world_from_camera)


def _remark(scores: Mapping[str, Scores], state: str) -> str:
    """What is to be said of images that are predicted no better from the result; empty: nothing."""
    if not scores:
        return ""
    rough, final = (scores[name].psnr_leave_one_out for name in (ROUGH, state))
    if not final < rough:
        return ""
    return f"images are predicted no better, within chance (leave-one-out PSNR {rough:.3f} -> {final:.3f} dB)"
