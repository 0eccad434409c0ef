"""`lvba evaluate`: poses and exposures made by any method, judged as `lvba run` judges its own."""

import argparse

from lvba import evaluation
from lvba.io import result_folder
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.products import report as page
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
    given = evaluation.read_given(dataset, arguments.lidar_poses, arguments.image_poses, arguments.exposures)
    result_folder.prepare(arguments.out)
    first_run.announce(display, images=bool(dataset.image_paths))
    display.stage("evaluate", 1, 2)
    report = evaluation.report(given, config, reference, display.progress)
    report["versions"] = versions.versions()
    page.write(arguments.out, report)
    display.clear()
    result_table.show(report, arguments.out)
