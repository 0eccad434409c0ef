"""Any method's poses and exposures, evaluated as this package evaluates its own."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lvba import config as settings
from lvba.blocks import scan_errors, survey
from lvba.blocks.decoded_images import shows_nothing
from lvba.blocks.decoded_scans import placed
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import image_poses as kinds
from lvba.io import timestamps
from lvba.io.dataset import load_image, load_scan
from lvba.io.exposures import Exposures, read_exposures
from lvba.io.image_poses import Statement
from lvba.io.reference import Reference, of_cameras
from lvba.io.tum import read_pose_file, read_trajectory
from lvba.lidar import moving_points
from lvba.lidar.scan_errors import ScanErrors
from lvba.parallel import in_order
from lvba.pipeline import Config
from lvba.products import evaluate as evaluation
from lvba.products import map_quality
from lvba.products import reference as references
from lvba.products.evaluate import State
from lvba.products.recorded_images import Undistorted, views_of
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.steps import report_data
from lvba.steps.acceptance import ROUGH, VISUAL, Verdict
from lvba.steps.lidar import cloud_of
from lvba.steps.outcomes import ScanPoses
from lvba.trajectory import Trajectory
from lvba.visual import radiometry
from lvba.visual.radiometry import Radiometry
from lvba.visual.trajectory_rates import turns_of


@dataclass(frozen=True)
class Given:
    """The frames that are judged, and what is claimed about them.

    recording: as it is; dataset: without the frames that the files say nothing about
    scan_numbers: (S,) int64, of the dataset's scans in the recording
    camera, radiometry: that the poses go with, of the raw images
    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4), in the dataset's frame; log_exposure: (I,)
    readout: s, from the first to the last row of an image
    """

    recording: Dataset
    dataset: Dataset
    scan_numbers: np.ndarray
    world_from_scan: np.ndarray
    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    camera: Camera
    radiometry: Radiometry
    warnings: tuple[str, ...]
    readout: float = 0.0


def read_given(
    dataset: Dataset,
    scan_poses: Path | None = None,
    image_poses: Path | None = None,
    exposures: Path | None = None,
    camera: Camera | None = None,
    supposed: Radiometry = radiometry.NONE,
    readout: float = 0.0,
) -> Given:
    """Poses and exposures from files; where no file is given, those of the dataset (all equally exposed).

    camera: of the raw images, that the poses were found with; None: the dataset's; supposed: its radiometry
    readout: s, from the first to the last row of its images, while it turns

    Raises InputError: a file is malformed, or its times are of another clock.
    """
    scans, scan_index = _poses(dataset.scans, scan_poses, dataset.origin)
    images, image_index, more = _cameras(
        dataset, image_poses, Trajectory(dataset.scans.times[scan_index], scans)
    )
    log_exposure = np.zeros(len(dataset.images))
    if exposures is not None:
        known = read_exposures(exposures)
        log_exposure = np.interp(dataset.images.times, known.times, np.log(known.relative))
    missing = (len(dataset.scans) - len(scan_index), len(dataset.images) - len(image_index))
    warnings = tuple(
        f"{count} {kind} are left out: the poses given say nothing about them."
        for count, kind in zip(missing, ("scans", "images"), strict=True)
        if count
    )
    return Given(
        recording=dataset,
        dataset=_subset(dataset, scan_index, image_index),
        scan_numbers=scan_index,
        world_from_scan=scans,
        world_from_camera=images,
        log_exposure=log_exposure[image_index],
        camera=camera or dataset.camera,
        radiometry=supposed,
        warnings=more + warnings,
        readout=readout,
    )


def report(
    given: Given, config: Config, reference: Reference | None, progress: Progress = silent
) -> dict[str, Any]:
    """report.json of the judgement: `rough` is the dataset, `refined` is what is given.

    What is systematically wrong with the scans is measured and corrected as in a run, before both are judged: else poses
    that fit a distorted room would count as better than true ones. Images are compared with what does not move.
    Raises InputError: a scan or an image cannot be read.
    """
    dataset = given.dataset
    errors = scan_errors.measure(given.recording, config.lidar, config.refine_scans, progress)
    read = _reader(given, errors)
    rough = cloud_of(dataset, dataset.scans.world_from_sensor, progress, read)
    refined = cloud_of(dataset, given.world_from_scan, progress, read)
    before, after = (map_quality.entropy_blocks(cloud, config.evaluate.entropy) for cloud in (rough, refined))
    scores = {}
    if dataset.image_paths:
        views = views_of(dataset)
        claimed = _claimed(given)
        none = np.zeros(len(rough), bool)
        moving = _moving(given, read, progress) if config.remove_moving_points else none
        states = {
            ROUGH: State(rough.without(moving), views),
            VISUAL: State(refined.without(moving), claimed),
        }
        blank = _blank(dataset)
        judged = _judged(len(views), blank, config.evaluate.max_images)
        if len(judged):
            scores = evaluation.evaluate(
                states, config.evaluate, held_out=blank, images=judged, progress=progress
            )
    given_verdict = Verdict(True, "given")
    scans = ScanPoses(given.world_from_scan, given_verdict, before.mean, after.mean, after)
    facts: dict[str, Any] = {
        "schema": 1,
        "dataset": {"path": dataset.root, **report_data.of_dataset(dataset)},
        "config": settings.to_dict(config),
        "evaluation": report_data.of_evaluation(dataset, scans, scores, VISUAL),
        "warnings": [
            *dataset.warnings,
            *given.warnings,
            *report_data.warnings_of_errors(errors, dataset.deskewed_by),
        ],
    }
    if errors is not None:
        facts["lidar"] = report_data.of_scan_errors(errors)
    if reference is not None:
        facts["reference"] = _against(given, of_cameras(reference, dataset))
    return dict(report_data.plain(facts))


def _claimed(given: Given) -> Views:
    """The images as the cameras given took them."""
    seen = given.dataset.with_camera(given.camera)
    turns = turns_of(Trajectory(seen.images.times, given.world_from_camera), given.readout)
    return dataclasses.replace(
        views_of(seen, Undistorted(seen, full=False, turns=turns), given.radiometry),
        world_from_camera=given.world_from_camera,
        log_exposure=given.log_exposure,
    )


def _judged(count: int, blank: np.ndarray, most: int) -> np.ndarray:
    """The images (J,) int32 that are judged, of so many: at most `most`, none of the blank ones (b,)."""
    asked = evaluation.judged_images(count, np.zeros(0, np.int32), most)
    return evaluation.instead_of_blank(asked, blank, (0, count))


def _blank(dataset: Dataset) -> np.ndarray:
    """The images that show nothing, (b,) int32: they judge nothing and color nothing."""
    nothing = in_order(lambda image: shows_nothing(load_image(dataset, image)), range(len(dataset.images)))
    return np.flatnonzero(list(nothing)).astype(np.int32)


def _reader(given: Given, errors: ScanErrors | None) -> Callable[[int], np.ndarray]:
    """The points (N, 3) float32, m, of a scan of the dataset where they belong, as many as a run judges by."""
    every = survey.load_of(given.recording).every

    def read(index: int) -> np.ndarray:
        number = int(given.scan_numbers[index])
        return placed(given.recording, number, load_scan(given.recording, number), errors)[::every]

    return read


def _moving(given: Given, read: Callable[[int], np.ndarray], progress: Progress) -> np.ndarray:
    """Which points of all scans, one after another, move, at the dataset's poses and at those given, (M,) bool."""
    scans, sensor = given.dataset.scans, given.dataset.sensor_position_scan
    poses = [scans.world_from_sensor, given.world_from_scan]
    masks = moving_points.moving_points(read, poses, scans.times, sensor, range(len(scans)), progress)
    return np.concatenate(masks)


def _against(given: Given, reference: Reference) -> dict[str, Any]:
    dataset = given.dataset
    comparison = references.compare(
        reference,
        Trajectory(dataset.scans.times, given.world_from_scan),
        Trajectory(dataset.images.times, given.world_from_camera),
        Exposures(dataset.images.times, np.exp(given.log_exposure)),
    )
    equal = Exposures(dataset.images.times, np.ones(len(dataset.images)))
    rough = references.compare(reference, dataset.scans, dataset.images, equal)
    return {**comparison, "rough": rough}


def _cameras(
    dataset: Dataset, path: Path | None, scans: Trajectory
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """world_from_camera (M, 4, 4) of the images that the file says something about, their indices (M,), and warnings.

    scans: in whose world the file's poses are
    """
    if path is None or not len(dataset.images):
        return dataset.images.world_from_sensor, np.arange(len(dataset.images)), ()
    file = read_pose_file(path)
    match = timestamps.match(dataset.images.times, file.trajectory, path)
    poses = match.poses.world_from_sensor.copy()
    poses[:, :3, 3] -= dataset.origin
    extrinsic = dataset.camera_from_scan
    said = Statement(kinds.stated(file.comments), "the file")
    given = Trajectory(match.poses.times, poses)
    reading = kinds.decide(given, scans, extrinsic, said, path, dataset.image_poses, kinds.FOREIGN_EXTRINSIC)
    return kinds.to_camera(poses, reading.kind, extrinsic), match.files, file.warnings + reading.warnings


def _poses(frames: Trajectory, path: Path | None, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (M, 4, 4) of the frames that the file says something about, and their indices (M,)."""
    if path is None or not len(frames):
        return frames.world_from_sensor, np.arange(len(frames))
    match = timestamps.match(frames.times, read_trajectory(path), path)
    poses = match.poses.world_from_sensor.copy()
    poses[:, :3, 3] -= origin
    return poses, match.files


def _subset(dataset: Dataset, scans: np.ndarray, images: np.ndarray) -> Dataset:
    return dataclasses.replace(
        dataset,
        scan_paths=tuple(dataset.scan_paths[i] for i in scans),
        scans=Trajectory(dataset.scans.times[scans], dataset.scans.world_from_sensor[scans]),
        image_paths=tuple(dataset.image_paths[i] for i in images),
        images=Trajectory(dataset.images.times[images], dataset.images.world_from_sensor[images]),
        scan_stamps=(),
        image_stamps=(),
    )
