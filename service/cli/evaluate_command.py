"""`lvba evaluate`: poses and exposures made by any method, judged as `lvba run` judges its own."""

import argparse
from pathlib import Path

from lvba import evaluation
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import calibration, result_folder
from lvba.io.dataset import open_dataset
from lvba.io.image_header import ImageSize
from lvba.io.reference import read_reference
from lvba.products import report as page
from lvba.products.recorded_images import radiometry_of
from lvba.sources import calibrations
from lvba.visual.radiometry import NONE, Radiometry
from service.cli import first_run, result_table, settings_files
from service.cli.out_check import check_out
from service.cli.progress import Display
from workers import versions


def evaluate(arguments: argparse.Namespace, display: Display) -> None:
    """Judge and write OUT/report.json."""
    config = settings_files.load(arguments)
    check_out(arguments.out, arguments.dataset)
    display.stage("input", 0, 2)
    dataset = open_dataset(arguments.dataset)
    reference = read_reference(arguments.reference) if arguments.reference else None
    camera, radiometry, readout = _camera(dataset, arguments.calibration)
    given = evaluation.read_given(
        dataset,
        arguments.lidar_poses,
        arguments.image_poses,
        arguments.exposures,
        camera,
        radiometry,
        readout,
    )
    result_folder.prepare(arguments.out)
    display.stage("evaluate", 1, 2)
    with first_run.shown(display):
        report = evaluation.report(given, config, reference, display.progress)
    report["versions"] = versions.versions()
    page.write(arguments.out, report)
    display.clear()
    result_table.show(report, arguments.out)


def _camera(dataset: Dataset, file: Path | None) -> tuple[Camera | None, Radiometry, float]:
    """Of a calibration file, for the images of a recording, and how long their rows are read, s; None: no file is given.

    Raises InputError: it cannot be read, or is of images of another shape.
    """
    if file is None or not dataset.image_paths:
        return None, NONE, 0.0
    size = ImageSize(dataset.camera.width, dataset.camera.height)
    camera = calibrations.read([file]).camera_for(size)
    if camera is None:
        raise InputError(file, "holds no camera", "give the file that has the intrinsics")
    if file.name != calibration.NAME:
        return camera, NONE, 0.0
    return camera, radiometry_of(file.parent), calibration.read_readout(file.parent)
