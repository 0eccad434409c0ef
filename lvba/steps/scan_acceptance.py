"""The steps that judge scan poses: refined ones against the rough ones, and those refined with the cameras.

How sharp the map is, each part says of its region of space; what images say, of the images in its core.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import trajectory
from lvba.arrays import Indices, Poses
from lvba.blocks.decoded_images import PhotoReader, blank_photos
from lvba.blocks.decoded_scans import ScanPieces, ScanPoints, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.regions import region_cloud
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.products import brightness, evaluate, map_quality
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_quality import EntropyBlocks, EntropyConfig
from lvba.products.recorded_images import views_of
from lvba.progress import Progress, silent
from lvba.steps import acceptance, expected_error, other_calibrations, scan_gate
from lvba.steps.acceptance import CARRIED, ROUGH, GateConfig, Verdict
from lvba.steps.lidar import carry_cameras, cloud_of
from lvba.steps.outcomes import FusionStage, LidarStage, ScanPoses
from lvba.steps.part_scores import as_in_whole, in_core, leave_one_out, together
from lvba.visual.prior_config import PriorConfig


@dataclass(frozen=True)
class RegionEntropy:
    """The entropies of map points in one region, at the rough and at the refined poses.

    shift: of all scans; None: not known, or they are held by something else than planes
    """

    rough: EntropyBlocks
    refined: EntropyBlocks
    shift: scan_gate.Shift | None = None


@dataclass(frozen=True)
class FusedEntropy:
    """The same at scans that cameras moved, and where these only slid along what planes leave open; None: nothing is.

    drawn: at poses that are as likely as those before by what planes say; None: not asked
    """

    fused: EntropyBlocks
    slid: EntropyBlocks | None = None
    drawn: EntropyBlocks | None = None


def measure_entropy(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    points: Pieces[ScanPoints],
    lidar: LidarStage,
    survey: Survey,
    config: EntropyConfig,
    progress: Progress = silent,
) -> RegionEntropy:
    """How sharp the map is in a part's region, before and after."""
    rough = dataset.scans.world_from_sensor
    before = map_quality.entropy_blocks(
        region_cloud(dataset, cores, part, points, rough, survey.reach_m, progress), config
    )
    if lidar.result is None:
        return RegionEntropy(before, before)
    refined = lidar.result.world_from_scan
    after = region_cloud(dataset, cores, part, points, refined, survey.reach_m, progress)
    return RegionEntropy(before, map_quality.entropy_blocks(after, config), shift_of(rough, lidar))


def shift_of(rough: Poses, lidar: LidarStage) -> scan_gate.Shift | None:
    """How far refined scans are from the input's (S, 4, 4), where planes determine them, and the rounds converged."""
    result = lidar.result
    if (
        result is None
        or not result.converged
        or result.degenerate_directions
        or lidar.rough_error is not None
    ):
        return None
    expected = expected_error.of_poses(expected_error.where_known(expected_error.of_lidar(result)))
    if expected is None:
        return None
    return scan_gate.Shift(trajectory.pose_error(result.world_from_scan, rough).ate_m, expected["position_m"])


def measure_fused_entropy(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    points: Pieces[ScanPoints],
    fused: FusionStage,
    survey: Survey,
    config: EntropyConfig,
    before: RegionEntropy,
    progress: Progress = silent,
) -> FusedEntropy | None:
    """How sharp the map is in a part's region, at the scans that cameras moved; None: there are none.

    before: of the same region. Only where the map is not as sharp as that, other poses as likely are asked.
    """
    result = fused.result
    if result is None:
        return None

    def blocks(poses: Poses) -> EntropyBlocks:
        cloud = region_cloud(dataset, cores, part, points, poses, survey.reach_m, progress)
        return map_quality.entropy_blocks(cloud, config)

    own = blocks(result.world_from_scan)
    return FusedEntropy(
        own,
        None if result.slid is None else blocks(result.slid.world_from_scan),
        blocks(result.drawn) if len(result.drawn) and own.mean > before.refined.mean else None,
    )


def compare(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    images: int,
    lidar: LidarStage,
    entropies: Sequence[RegionEntropy],
    config: EvaluateConfig,
    gates: GateConfig,
    prior: PriorConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """What images in a part's core say of refined scans: scores of ROUGH and CARRIED, with cameras carried along. Where
    they do not speak for these scans, as bright as exposures make each beside the others; where they speak against them
    then, also with other calibrations, by as much as the prior says one may be off.

    dataset: of the part's frames, points, photos: of these; images: how many the whole recording has
    entropies: of all regions
    Only leave-one-out figures are known, and no map entropy; empty where no image is asked.
    """
    blank = blank_photos(photos, part.images)
    core = np.setdiff1d(in_core(asked_images(images), part), blank + np.int32(part.images[0]))
    if lidar.result is None or not len(core) or not asks_images(entropies, gates):
        return {}
    refined = lidar.result.world_from_scan[slice(*part.scans)]
    read = ScanReader(points, part.scans[0])
    before = cloud_of(dataset, dataset.scans.world_from_sensor, progress, read)
    after = cloud_of(dataset, refined, progress, read)
    views = views_of(dataset, PhotoReader(photos, dataset.camera, part.images[0]))
    carried = replace(views, world_from_camera=carry_cameras(dataset, refined))
    states = {ROUGH: State(before, views), CARRIED: State(after, carried)}
    entropy = acceptance.entropy_figure(map_quality.entropy_change(*_of_all_regions(entropies)), gates)

    def agree(scores: Mapping[str, Scores]) -> bool:
        return scan_gate.images_agree(
            entropy, acceptance.image_figures(scores[ROUGH], scores[CARRIED], gates)
        )

    alone = part.core_images == (0, images)
    scores, used = _judged(states, config, blank, core - part.images[0], agree, alone, progress)
    if acceptance.contradicted(acceptance.image_figures(scores[ROUGH], scores[CARRIED], gates)):
        few = evaluate.spread_evenly(scores[ROUGH].images, acceptance.FEW_SCAN_IMAGES)
        scores |= _with_other_calibrations(used, config, prior, few, blank, progress)
    return as_in_whole(scores, part)


def _judged(
    states: Mapping[str, State],
    config: EvaluateConfig,
    blank: Indices,
    images: Indices,
    agree: Callable[[dict[str, Scores]], bool],
    alone: bool,
    progress: Progress,
) -> tuple[dict[str, Scores], Mapping[str, State]]:
    """Scores of the states over some images (J,), and the states as they were judged: where images do not agree, with the
    exposures that their maps show together.

    blank: images that color nothing; alone: no other images are asked, so that few do if they agree
    """
    colored = dict(zip(states, evaluate.color_by_paper(list(states.values()), blank, progress), strict=True))

    def scores_of(states: Mapping[str, State]) -> dict[str, Scores]:
        return leave_one_out(
            *(states, config, images, blank, progress),
            enough=agree if alone else None,
            few=acceptance.FEW_SCAN_IMAGES,
            colored=colored,
        )

    scores = scores_of(states)
    if agree(scores):
        return scores, states
    maps = [(colored[name], state.views) for name, state in states.items()]
    log_exposure = brightness.log_exposures(maps, config.render)
    exposed = {
        name: replace(state, views=replace(state.views, log_exposure=log_exposure))
        for name, state in states.items()
    }
    return scores_of(exposed), exposed


def _with_other_calibrations(
    states: Mapping[str, State],
    config: EvaluateConfig,
    prior: PriorConfig,
    images: Indices,
    blank: Indices,
    progress: Progress,
) -> dict[str, Scores]:
    """Scores of the states over some images (J,), with calibrations as the prior says they may be, by name."""
    scores = dict[str, Scores]()
    for number in range(other_calibrations.COUNT):
        others = {
            other_calibrations.name(name, number): State(
                state.cloud, other_calibrations.views(state.views, number, prior)
            )
            for name, state in states.items()
        }
        scores |= leave_one_out(others, config, images, blank, progress)
    return scores


def judge_lidar(
    dataset: Dataset,
    lidar: LidarStage,
    entropies: Sequence[RegionEntropy],
    compared: Sequence[Mapping[str, Scores]],
    config: GateConfig,
) -> ScanPoses:
    """The refined scan poses where map and images together speak for them, else the input's.

    entropies: of all regions; compared: by the images of all parts (`compare`)
    """
    rough = dataset.scans.world_from_sensor
    before, after = _of_all_regions(entropies)
    if lidar.result is None:
        return keep_rough(rough, before, lidar.problem)
    scores = together(compared, {})
    open_motions = 0 if lidar.rough_error is None else len(lidar.rough_error.open_after)
    shift = entropies[0].shift
    return decide(rough, lidar.result.world_from_scan, before, after, scores, config, open_motions, shift)


def _of_all_regions(entropies: Sequence[RegionEntropy]) -> tuple[EntropyBlocks, EntropyBlocks]:
    return (
        map_quality.blocks_together([each.rough for each in entropies]),
        map_quality.blocks_together([each.refined for each in entropies]),
    )


def choose_fusion(
    scans: ScanPoses, fused: FusionStage, entropies: Sequence[FusedEntropy | None], config: GateConfig
) -> FusionStage:
    """The fused scans; where the map would be less sharp with them, those that only slid along what planes leave open.

    Errors of ranges turn scans to where planes are thinnest, and not where cameras have them; how far scans have slid has
    nothing to do with it. entropies: of all regions
    """
    if fused.result is None or fused.result.slid is None:
        return fused
    if judge_fusion(scans, fused, entropies, config).verdict.accepted:
        return fused
    return FusionStage(fused.result.slid)


def judge_fusion(
    scans: ScanPoses, fused: FusionStage, entropies: Sequence[FusedEntropy | None], config: GateConfig
) -> ScanPoses:
    """The fused scan poses where the map is as sharp with them, else those before; `entropy_rough` is of the latter.

    entropies: of all regions. The images are asked later, with the cameras that are in use.
    """
    if fused.result is None:
        return not_fused(scans, fused)
    known = [each for each in entropies if each is not None]
    drawn = None
    if fused.result.only_slid:
        blocks = [each.slid for each in known if each.slid is not None]
    else:
        blocks = [each.fused for each in known]
        if any(each.drawn is not None for each in known):
            drawn = map_quality.blocks_together([each.drawn or each.fused for each in known])
    after = map_quality.blocks_together(blocks)
    return decide_fusion(scans, fused.result.world_from_scan, after, config, drawn)


def keep_rough(rough: Poses, blocks: EntropyBlocks, problem: str) -> ScanPoses:
    """The rough scan poses, because there are no refined ones."""
    verdict = Verdict(False, "input poses kept", f"{problem}")
    return ScanPoses(rough, verdict, blocks.mean, blocks.mean, blocks)


def asks_images(entropies: Sequence[RegionEntropy], gates: GateConfig) -> bool:
    """Whether it is for the images to say if refined scan poses are accepted."""
    change = map_quality.entropy_change(*_of_all_regions(entropies))
    entropy = acceptance.entropy_figure(change, gates)
    return gates.enabled and scan_gate.may_be_better(entropy)


def asked_images(count: int) -> np.ndarray:
    """The images (J,) int32, of so many, that say whether they contradict refined scans."""
    if not count:
        return np.zeros(0, np.int32)
    return evaluate.judged_images(count, np.zeros(0, np.int32), acceptance.SCAN_IMAGES)


def decide(
    rough: Poses,
    refined: Poses,
    before: EntropyBlocks,
    after: EntropyBlocks,
    scores: Mapping[str, Scores],
    gates: GateConfig,
    open_motions: int = 0,
    shift: scan_gate.Shift | None = None,
) -> ScanPoses:
    """The scan poses in use. rough, refined: (S, 4, 4); scores: of `compare`; the others as of `judge_scans`"""
    entropy = acceptance.entropy_figure(map_quality.entropy_change(before, after), gates)
    images = acceptance.image_figures(scores[ROUGH], scores[CARRIED], gates) if scores else ()
    images = other_calibrations.counted(images, scores, (ROUGH, CARRIED), gates)
    verdict = scan_gate.judge_scans(entropy, images, gates, open_motions, shift)
    poses, blocks = (refined, after) if verdict.accepted else (rough, before)
    return ScanPoses(poses, verdict, before.mean, after.mean, blocks)


def decide_fusion(
    scans: ScanPoses,
    world_from_scan: Poses,
    after: EntropyBlocks,
    config: GateConfig,
    drawn: EntropyBlocks | None = None,
) -> ScanPoses:
    """The scan poses in use, from the map entropy at the fused ones (S, 4, 4), and at those as likely before (None: not
    asked)."""
    change = map_quality.entropy_change(scans.map_blocks, after)
    entropy = [acceptance.entropy_figure(change, config)]
    if drawn is not None:
        entropy.append(acceptance.against_drawn(map_quality.entropy_change(drawn, after), config))
    verdict = acceptance.judge_fusion(rough_gain(scans), entropy, (), config)
    poses, blocks = (
        (world_from_scan, after) if verdict.accepted else (scans.world_from_scan, scans.map_blocks)
    )
    return ScanPoses(poses, verdict, change.before, change.after, blocks)


def rough_gain(scans: ScanPoses) -> float:
    """The map entropy that the scan poses in use have gained over the input, nats."""
    return scans.entropy_rough - scans.entropy


def not_fused(scans: ScanPoses, fused: FusionStage) -> ScanPoses:
    """The scan poses as they were, because there are none that cameras had a part in."""
    verdict = Verdict(False, "scans keep the LiDAR result", f"{fused.problem}")
    return ScanPoses(scans.world_from_scan, verdict, scans.entropy, scans.entropy, scans.map_blocks)
