"""Scores, map and pictures of a recording in parts: each part makes its own, and they are put together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba.blocks import split
from lvba.blocks.regions import in_region, regions
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.products import colorize, evaluate, map_error, map_quality, pictures
from lvba.products.cloud import Cloud
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_file import MapConfig, PointMap
from lvba.products.pictures import Choice, Pictures, Shown
from lvba.products.recorded_images import views_of
from lvba.progress import Progress, silent
from lvba.steps import scan_acceptance
from lvba.steps.acceptance import CARRIED, ROUGH, GateConfig
from lvba.steps.evaluate import entropies_of, judged_states
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import Accepted, LidarStage, ScanPoses, VisualStage
from lvba.steps.products import colored_map
from lvba.steps.uncertainty import Expected


def of_part(
    scans: ScanPoses, fused: ScanPoses, visual: VisualStage, part: Part
) -> tuple[ScanPoses, ScanPoses, VisualStage]:
    """What was found, for the frames of one part only."""
    mine = slice(*part.images)
    if visual.result is not None:
        visual = VisualStage(
            replace(
                visual.result,
                world_from_camera=visual.result.world_from_camera[mine],
                log_exposure=visual.result.log_exposure[mine],
            )
        )
    own, with_cameras = (
        replace(poses, world_from_scan=poses.world_from_scan[slice(*part.scans)]) for poses in (scans, fused)
    )
    return own, with_cameras, visual


def evaluate_part(
    dataset: Dataset,
    part: Part,
    images: int,
    scans: ScanPoses,
    fused: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores over the images in the part's core, numbered as in the whole; empty where none is judged.

    dataset: of the part's frames; images: of the whole
    """
    if not images:
        return {}
    core = _in_core(evaluate.judged_images(images, np.zeros(0, np.int32), config.max_images), part)
    if not len(core):
        return {}
    states = judged_states(dataset, *of_part(scans, fused, visual, part), progress)
    unknown = dict.fromkeys(states, float("nan"))
    found = evaluate.evaluate(
        states, config, entropies=unknown, images=core - part.images[0], progress=progress
    )
    return _as_in_whole(found, part)


def compare_part(
    dataset: Dataset,
    part: Part,
    images: int,
    lidar: LidarStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """What images in the part's core say of refined scans, as `scan_acceptance.compare`; empty where none is asked.

    dataset: of the part's frames; images: of the whole
    """
    core = _in_core(scan_acceptance.asked_images(images), part)
    if lidar.result is None or not gates.enabled or not len(core):
        return {}
    refined = lidar.result.world_from_scan[slice(*part.scans)]
    before = cloud_of(dataset, dataset.scans.world_from_sensor, progress)
    after = cloud_of(dataset, refined, progress)
    mine = core - part.images[0]
    return _as_in_whole(
        scan_acceptance.compare(dataset, refined, before, after, mine, config, progress), part
    )


def merge_compared(found: Sequence[Mapping[str, Scores]]) -> dict[str, Scores]:
    """What the images of all parts say of refined scans."""
    return _together(found, {ROUGH: float("nan"), CARRIED: float("nan")})


def merge_scores(
    found: Sequence[Mapping[str, Scores]], scans: ScanPoses, fused: ScanPoses
) -> dict[str, Scores]:
    """The scores over all images."""
    names = {name for scores in found for name in scores}
    return _together(found, entropies_of(names, scans, fused))


def _in_core(images: np.ndarray, part: Part) -> np.ndarray:
    return images[(images >= part.core_images[0]) & (images < part.core_images[1])]


def _as_in_whole(found: Mapping[str, Scores], part: Part) -> dict[str, Scores]:
    """The same, images numbered as in the whole recording."""
    first = np.int32(part.images[0])
    return {name: replace(scores, images=scores.images + first) for name, scores in found.items()}


def _together(found: Sequence[Mapping[str, Scores]], entropy: Mapping[str, float]) -> dict[str, Scores]:
    known = [scores for scores in found if scores]
    if not known:
        return {}
    return {name: evaluate.together([scores[name] for scores in known], entropy[name]) for name in known[0]}


def color_part(
    dataset: Dataset,
    part: Part,
    whole: Dataset,
    cores: Sequence[Part],
    accepted: Accepted,
    expected: Expected,
    survey: Survey,
    config: MapConfig,
    progress: Progress = silent,
) -> PointMap:
    """The part's piece of the map: its region of space, as its own scans and images show it.

    dataset: of the part's frames; whole: the recording
    """
    mine = slice(*part.images)
    state = replace(
        accepted,
        world_from_scan=accepted.world_from_scan[slice(*part.scans)],
        world_from_camera=accepted.world_from_camera[mine],
        log_exposure=accepted.log_exposure[mine],
    )
    voxel = config.voxel_m
    if voxel < 0:
        voxel = 2 * survey.range_m / max(whole.camera.fx, whole.camera.fy) if whole.image_paths else 0.0
    gain = colorize.display_gain(accepted.log_exposure)
    found = colored_map(dataset, state, replace(config, voxel_m=voxel), progress, gain)
    owned = regions(whole, cores, accepted.world_from_scan)
    kept = in_region(found.points_world, owned, part.number)
    scan = None if found.scan is None else found.scan[kept] + np.int32(part.scans[0])
    piece = PointMap(
        found.points_world[kept], found.rgb[kept], found.views[kept], found.spread[kept], found.voxel_m, scan
    )
    return map_error.with_error(piece, accepted.world_from_scan, expected.scans)


def choose_pictures(scores: dict[str, Scores], accepted: Accepted) -> Choice | None:
    """Which images the report shows; none where there are no images."""
    if not scores:
        return None
    return pictures.choose({"rough": scores[ROUGH], "refined": scores[accepted.state]})


def show_part(
    dataset: Dataset, part: Part, accepted: Accepted, choice: Choice | None, config: EvaluateConfig
) -> Shown | None:
    """The chosen images in the part's core, from its map before and after; dataset: of the part's frames."""
    if choice is None:
        return None
    low, high = part.core_images
    mine = Choice(choice.whole, tuple(image for image in choice.crops if low <= image < high))
    if not mine.crops:
        return None
    views = views_of(dataset)
    images = slice(*part.images)
    final = replace(
        views,
        world_from_camera=accepted.world_from_camera[images],
        log_exposure=accepted.log_exposure[images],
    )
    refined = accepted.world_from_scan[slice(*part.scans)]
    return pictures.show(
        State(cloud_of(dataset, dataset.scans.world_from_sensor), views),
        State(cloud_of(dataset, refined), final),
        mine,
        config.render,
        part.images[0],
    )


def collect_pictures(choice: Choice | None, found: Sequence[Shown | None]) -> Pictures | None:
    """The pictures of all parts."""
    return None if choice is None else pictures.collect(choice, [each for each in found if each is not None])


@dataclass(frozen=True)
class SeamWalls:
    """How thick walls are across a seam, m, standard deviations over what the scans on both sides see as planes.

    rough, refined: both sides together, at the rough and at the refined poses; single: of either side by itself, refined,
    the thinner they can be; NaN where there is no wall
    """

    first: int
    second: int
    rough: float
    refined: float
    single: float


_SCANS_BY_SEAM = 8


def seam_frames(dataset: Dataset, left: Part, right: Part) -> Dataset:
    """The scans on both sides of a seam, as many on either."""
    border = right.core_scans[0]
    low = max(border - _SCANS_BY_SEAM, left.core_scans[0])
    high = min(border + _SCANS_BY_SEAM, right.core_scans[1])
    return split.subset(dataset, np.arange(low, high), np.zeros(0, np.int64))


def measure_seam(
    frames: Dataset, left: Part, right: Part, accepted: Accepted, progress: Progress = silent
) -> SeamWalls:
    """The walls across one seam. frames: of `seam_frames`."""
    border = right.core_scans[0]
    low = max(border - _SCANS_BY_SEAM, left.core_scans[0])
    poses = accepted.world_from_scan[low : low + len(frames.scans)]
    rough = cloud_of(frames, frames.scans.world_from_sensor, progress)
    refined = cloud_of(frames, poses, progress)
    sides = [_scans_of(refined, slice(0, border - low)), _scans_of(refined, slice(border - low, len(poses)))]
    rows = map_quality.plane_thickness({"rough": rough, "refined": refined, "a": sides[0], "b": sides[1]})
    single = [rows[name]["in_refined"] for name in ("a", "b")]
    return SeamWalls(
        left.number,
        right.number,
        rows["rough"]["in_refined"],
        rows["refined"]["own"],
        float(np.mean(single)),
    )


def _scans_of(cloud: Cloud, which: slice) -> Cloud:
    bounds = cloud.scan_offsets[which.start : which.stop + 1]
    return Cloud(cloud.points_world[bounds[0] : bounds[-1]], bounds - bounds[0], cloud.scan_times[which])
