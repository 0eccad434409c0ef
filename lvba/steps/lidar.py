"""The step that refines the scans of one part, and what follows from scan poses: clouds, cameras carried along."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Poses
from lvba.blocks.decoded_scans import ScanPoints, ScanReader
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.carried import carry
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.inertial.readings import Imu
from lvba.io import dataset as recordings
from lvba.io import imu as imu_files
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar import range_errors
from lvba.lidar.bundle_adjustment import LidarConfig, LidarResult
from lvba.lidar.odometry_factor import with_pauses
from lvba.lidar.range_errors import RangeErrors
from lvba.lidar.scan import gather
from lvba.lidar.scan_errors import ScanErrors
from lvba.lidar.scan_evidence import View
from lvba.loop_closure import rough_motions, rough_poses
from lvba.loop_closure.rough_poses import RoughError, StartPoses
from lvba.loop_closure.submap import Patch
from lvba.products.cloud import Cloud, assemble
from lvba.progress import Progress, silent
from lvba.steps import jumps_by_images, motions_by_images, trajectory_jumps
from lvba.steps.motions_by_images import LaidOut
from lvba.steps.outcomes import LidarStage
from lvba.trajectory import Trajectory

_TIMES_LAID_OUT = 2
"""Scans that are where images have them place features better."""


def solve_lidar(
    dataset: Dataset,
    part: Part,
    points: Pieces[ScanPoints],
    config: LidarConfig,
    enabled: bool = True,
    errors: ScanErrors | None = None,
    progress: Progress = silent,
) -> LidarStage:
    """Scan poses of a part, planes and what is known about them, from the scans and their rough poses.

    dataset: of the part's frames; points: of its scans; errors: of the scans of the recording, taken out of the points:
        covariances grow by what their uncertainty makes of the poses
    """
    if not enabled:
        return LidarStage(None, "LiDAR bundle adjustment is switched off (refine_scans)")
    reader, sensor = ScanReader(points), dataset.sensor_position_scan
    scans = reader.load(part.scan_numbers)
    surfels = rough_poses.surfels_of(scans, sensor)
    rough = dataset.scans.world_from_sensor
    begin = rough_poses.start_if_contradicted(
        scans, surfels, rough, sensor_position=sensor, config=config, progress=progress
    )
    begin = _jumps_by_images(dataset, surfels, begin, config)
    cosines = partial(reader.cosines, part.scan_numbers)
    refine = partial(_refined, dataset, scans, cosines, errors, config, progress)
    try:
        result = refine(begin)
    except DegenerateProblemError as error:
        return LidarStage(None, str(error))
    # where another start leads nowhere, the result that is there stays
    with suppress(DegenerateProblemError):
        most = rough_motions.WRONG_MINIMUM_M
        if begin is None and rough_motions.typically_off(surfels, result.world_from_scan) > most:
            start = rough_poses.start(
                scans, surfels, rough, sensor_position=sensor, config=config, progress=progress
            )
            begin, result = start, refine(start)
    with suppress(DegenerateProblemError):
        for _ in range(_TIMES_LAID_OUT):
            laid_out = _laid_out_by_images(dataset, surfels, result, begin, config)
            if laid_out is None:
                break
            again = refine(laid_out.start)
            if not laid_out.fits_better(dataset, again.world_from_scan, result.world_from_scan):
                break
            begin, result = laid_out.start, again
    poses = result.world_from_scan
    return LidarStage(
        with_errors(result, errors, part.scan_numbers),
        rough_error=None
        if begin is None
        else begin.judged(surfels, rough, poses, result.odometry_dependence),
        confirmed=_confirmed(surfels, dataset.scans, Trajectory(dataset.scans.times, poses)),
        planes_off=None if errors is None else errors.planes_off,
    )


def _refined(
    dataset: Dataset,
    scans: Sequence[np.ndarray],
    cosines: Callable[[], np.ndarray | None],
    errors: ScanErrors | None,
    config: LidarConfig,
    progress: Progress,
    begin: StartPoses | None,
) -> LidarResult:
    """Scans (N, 3) m with the poses that the LiDAR bundle adjustment gives them.

    cosines: give (M,) float64, of the angles of incidence that points were moved by; None: they were not. Asked late, for
        they take memory
    begin: instead of the rough poses; None: at these
    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    rough = dataset.scans.world_from_sensor
    refine = partial(
        lidar_ba.refine,
        sensor_position=dataset.sensor_position_scan,
        config=config,
        imu=_imu(dataset),
        progress=progress,
    )
    error, start = (None, rough) if begin is None else (begin.error, begin.world_from_scan)
    odometry = with_pauses(rough_poses.odometry_of(rough, error, start, config), dataset.scans.times)
    result = refine(scans, start, odometry=odometry)
    cosine = cosines()
    if errors is None or errors.ranges is None or cosine is None:
        return result
    scans = _met_at_planes(scans, cosine, result, errors.ranges)
    return refine(scans, result.world_from_scan, odometry=odometry)


def _jumps_by_images(
    dataset: Dataset, surfels: Sequence[Patch | None], begin: StartPoses | None, config: LidarConfig
) -> StartPoses | None:
    """Where the bundle adjustment begins, with jumps that surfaces do not tell of as images have them."""
    if not dataset.image_paths:
        return begin
    poses = dataset.scans.world_from_sensor if begin is None else begin.world_from_scan
    error = RoughError.of_jumps(config) if begin is None else begin.error
    jumps = trajectory_jumps.find(dataset.scans).after
    expected = trajectory_jumps.expected(Trajectory(dataset.scans.times, poses))
    jumps = np.setdiff1d(jumps, rough_motions.confirmed(surfels, poses, jumps, expected))
    unsure = np.union1d(jumps, np.intersect1d(error.open_after, error.wrong_after)).astype(np.int64)
    if not len(unsure):
        return begin
    poses, moved = jumps_by_images.mended(dataset, surfels, poses, unsure)
    if not len(moved):
        return begin
    return StartPoses(poses, error.with_open(moved))


def _laid_out_by_images(
    dataset: Dataset,
    surfels: Sequence[Patch | None],
    result: LidarResult,
    begin: StartPoses | None,
    config: LidarConfig,
) -> LaidOut | None:
    """Where the bundle adjustment begins once more; None: images have nothing against what it came to."""
    if not dataset.image_paths or not len(result.odometry_dependence):
        return None
    poses, dependence = result.world_from_scan, result.odometry_dependence
    return motions_by_images.laid_out(dataset, surfels, poses, dependence, begin, config)


def _met_at_planes(
    scans: Sequence[np.ndarray], cosine: np.ndarray, result: LidarResult, ranges: RangeErrors
) -> list[np.ndarray]:
    """The points of each scan where they belong, now that it is known on which planes of the map they are.

    A single scan shows too little of small surfaces far away to tell at what angle its beams meet them. Those that hold
    scans along a street were moved by a quarter of a centimeter of three that only grazing beams are too long.
    cosine: (M,) float64, of the angles of incidence that points were moved by
    """
    points = gather(scans)
    view = View.of(points, result.world_from_scan, result.planes, result.plane_points, ranges.beams.position)
    on_plane = result.plane_points.plane >= 0
    known = np.where(on_plane, range_errors.cosines_on_planes(view, ranges.beams), cosine)
    return np.split(ranges.met_at(points.points, cosine, known), points.offsets[1:-1])


def with_errors(result: LidarResult, errors: ScanErrors | None, scans: Indices) -> LidarResult:
    """The result of some scans (n,) that knows what errors that stay in their points, or are known too little, make of
    their poses.

    errors: of the scans of the recording
    """
    if errors is None:
        return result
    # expected errors are those of `shared_factor` times the covariance
    return replace(
        result,
        covariance=result.covariance + errors.shared_covariance / result.shared_factor,
        own_covariance=errors.own_covariance(scans),
    )


def _imu(dataset: Dataset) -> Imu | None:
    """What the IMU of a recording felt; None: it has none."""
    if not dataset.imu_path:
        return None
    return Imu(imu_files.read(dataset.imu_path), dataset.scans.times, dataset.scan_from_imu)


def _confirmed(surfels: Sequence[Patch | None], rough: Trajectory, refined: Trajectory) -> np.ndarray:
    """Of the scans after which one of the trajectories jumps, those whose refined motion surfaces confirm, (K,) int64."""
    after = np.union1d(*(trajectory_jumps.find(each).after for each in (rough, refined)))
    expected = trajectory_jumps.expected(refined)
    return rough_motions.confirmed(surfels, refined.world_from_sensor, after, expected)


def carry_cameras(dataset: Dataset, world_from_scan: Poses) -> np.ndarray:
    """Rough camera poses moved along with the scans, (I, 4, 4). Source: Li et al., eq. (1)."""
    extrinsic = geometry.inverse(dataset.camera_from_scan)
    return geometry.orthonormalize(
        carry(dataset.scans, world_from_scan, dataset.images, extrinsic).world_from_sensor
    )


def cloud_of(
    dataset: Dataset,
    world_from_scan: Poses,
    progress: Progress = silent,
    read: Callable[[int], np.ndarray] | None = None,
) -> Cloud:
    """All scans in the world frame. read: gives the points of a scan; None: from its file."""
    return assemble(
        read or (lambda index: recordings.load_scan(dataset, index).points),
        world_from_scan,
        dataset.scans.times,
        progress,
        dataset.sensor_position_scan,
    )
