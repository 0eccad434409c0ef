"""The steps that make the map and the pictures of the result."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from lvba.blocks.decoded_images import PhotoReader
from lvba.blocks.decoded_scans import ScanPieces, ScanReader
from lvba.blocks.lidar_block import Regions
from lvba.blocks.pieces import Pieces
from lvba.blocks.regions import in_region, regions
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.products import colorize, judging_size, map_error, map_file, pictures
from lvba.products.cloud import Cloud, thin
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_file import MapConfig, PointMap
from lvba.products.pictures import Choice, Pictures, Shown
from lvba.products.recorded_images import light_in, views_of
from lvba.progress import Progress, silent
from lvba.steps.acceptance import ROUGH
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import Accepted
from lvba.steps.uncertainty import Expected


def color_map(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    whole: Dataset,
    cores: Sequence[Part],
    accepted: Accepted,
    expected: Expected,
    survey: Survey,
    config: MapConfig,
    progress: Progress = silent,
) -> PointMap:
    """A part's piece of the map that users keep, in the dataset's world frame, with the expected error of each point: its
    region of space, as its own scans and images show it.

    dataset: of the part's frames, points, photos: of these; whole: the recording
    """
    state = _of_part(accepted, part)
    if len(cores) > 1 and config.voxel_m < 0:
        # all pieces alike, whatever each part sees
        voxel = 2 * survey.range_m / max(whole.camera.fx, whole.camera.fy) if whole.image_paths else 0.0
        config = dataclasses.replace(config, voxel_m=voxel)
    gain = colorize.display_gain(accepted.log_exposure)
    read = ScanReader(points, part.scans[0], all_points=True)
    piece = colored_map(
        _seen_by(dataset, accepted), read, _photos(photos, accepted, part), state, config, gain, progress
    )
    if len(cores) > 1:
        piece = _in_region(piece, part, regions(whole, cores, accepted.world_from_scan))
    return map_error.with_error(piece, accepted.world_from_scan, expected.scans)


def _seen_by(dataset: Dataset, accepted: Accepted) -> Dataset:
    """The recording with the camera that the result supposes."""
    return dataset if accepted.camera is None else dataset.with_camera(accepted.camera)


def _photos(photos: Pieces[np.ndarray], accepted: Accepted, part: Part) -> PhotoReader | None:
    """A part's images without distortion, as the result has it; None where there are none."""
    if accepted.camera is None:
        return None
    return PhotoReader(photos, accepted.camera, part.images[0], _of_part(accepted, part).turns)


def _of_part(accepted: Accepted, part: Part) -> Accepted:
    """The result, for the frames of one part only."""
    mine = slice(*part.images)
    return dataclasses.replace(
        accepted,
        world_from_scan=accepted.world_from_scan[slice(*part.scans)],
        world_from_camera=accepted.world_from_camera[mine],
        log_exposure=accepted.log_exposure[mine],
        white_balance=None if accepted.white_balance is None else accepted.white_balance[mine],
        turns=None if accepted.turns is None else accepted.turns[mine],
    )


def _in_region(piece: PointMap, part: Part, owned: Regions) -> PointMap:
    """The points of a part's map that lie in its region, with scans numbered as in the whole recording."""
    kept = in_region(piece.points_world, owned, part.number)
    scan = None if piece.scan is None else piece.scan[kept] + np.int32(part.scans[0])
    columns = {name: getattr(piece, name)[kept] for name in ("points_world", "rgb", "views", "spread")}
    return PointMap(**columns, voxel_m=piece.voxel_m, scan=scan)


def colored_map(
    dataset: Dataset,
    read: ScanReader,
    load: PhotoReader | None,
    accepted: Accepted,
    config: MapConfig,
    gain: float,
    progress: Progress = silent,
) -> PointMap:
    """The map without errors, in the dataset's world frame; without images it shows intensity.

    read, load: give points and images of the dataset; gain: the exposure it is shown at
    """
    if not dataset.image_paths:
        intensity = read.intensities(range(len(dataset.scans)))
        return _map_of_intensity(
            cloud_of(dataset, accepted.world_from_scan, progress, read), intensity, config
        )
    views = dataclasses.replace(
        views_of(dataset, load, accepted.radiometry),
        world_from_camera=accepted.world_from_camera,
        log_exposure=accepted.log_exposure,
        white_balance=accepted.white_balance,
    )
    return map_file.build(
        cloud_of(dataset, accepted.world_from_scan, progress, read),
        views,
        config,
        progress,
        gain,
        dataset.camera,
    )


def _map_of_intensity(cloud: Cloud, intensity: np.ndarray, config: MapConfig) -> PointMap:
    """The thinned cloud, gray by intensity (1st to 99th percentile), all one gray where the scans have none.

    intensity: (M,) of the points of the cloud, NaN where not known
    """
    voxel = max(config.voxel_m, 0.0)
    kept = thin(cloud.points_world, voxel)
    shown = intensity[kept]
    known = shown[np.isfinite(shown)]
    low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 0.0)
    gray = np.full(len(kept), map_file.UNCOLORED, np.uint8)
    if high > low:
        scaled = np.nan_to_num((shown - low) / (high - low), nan=0.5)
        gray = np.rint(255 * np.clip(scaled, 0, 1)).astype(np.uint8)
    none = np.zeros(len(kept))
    return PointMap(
        points_world=cloud.points_world[kept],
        rgb=np.repeat(gray[:, None], 3, axis=1),
        views=none.astype(np.uint8),
        spread=none.astype(np.float32),
        voxel_m=voxel,
        scan=cloud.scan_of(kept),
    )


def show_images(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    photos: Pieces[np.ndarray],
    accepted: Accepted,
    scores: Mapping[str, Scores],
    config: EvaluateConfig,
    progress: Progress = silent,
) -> Shown | None:
    """Photographs beside renderings from the input and from the result, of the images in a part's core that the report
    shows; None where there are none. dataset: of the part's frames; scores: of all images
    """
    low, high = part.core_images
    choice = _choice(scores, accepted)
    if choice is None:
        return None
    mine = Choice(choice.whole, tuple(image for image in choice.crops if low <= image < high))
    if not mine.crops:
        return None
    # both as the camera is in the result: the same photograph belongs to both
    views, state = (
        views_of(_seen_by(dataset, accepted), _photos(photos, accepted, part)),
        _of_part(accepted, part),
    )
    read = ScanReader(points, part.scans[0])
    final = dataclasses.replace(
        views,
        world_from_camera=state.world_from_camera,
        log_exposure=state.log_exposure,
        light=light_in(accepted.radiometry, judging_size.judging(_seen_by(dataset, accepted).camera)),
        curve=accepted.radiometry.response,
    )
    return pictures.show(
        State(cloud_of(dataset, dataset.scans.world_from_sensor, progress, read), views),
        State(cloud_of(dataset, state.world_from_scan, progress, read), final),
        mine,
        config.render,
        part.images[0],
    )


def collect_pictures(
    scores: Mapping[str, Scores], accepted: Accepted, shown: Sequence[Shown | None]
) -> Pictures | None:
    """The pictures of all parts; None where there are no images."""
    choice = _choice(scores, accepted)
    return None if choice is None else pictures.collect(choice, [each for each in shown if each is not None])


def _choice(scores: Mapping[str, Scores], accepted: Accepted) -> Choice | None:
    """Which images the report shows; None where there are no images."""
    if not scores:
        return None
    return pictures.choose({"rough": scores[ROUGH], "refined": scores[accepted.state]})
