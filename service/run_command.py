"""`lvba run`: a recording to a result folder, going on from the stages that are finished."""

import argparse
import time
from pathlib import Path

from lvba import pipeline, result
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import result_folder
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.plan import Plan, Step
from lvba.result import Result
from service import outcome, settings_files
from service.checks import check_out
from service.progress import Display
from workers import local, versions
from workers.local import StageRecord
from workers.store import ZarrStore, lock


def run(arguments: argparse.Namespace, display: Display) -> None:
    """Refine the recording and write OUT."""
    if arguments.workers is not None or arguments.scheduler is not None:
        raise InputError(
            "--workers, --scheduler",
            "running on a cluster is not available in this version",
            "leave them away",
        )
    config = settings_files.load(arguments)
    check_out(arguments.out, arguments.dataset)
    started = time.perf_counter()
    display.stage("input", 0, 1)
    dataset = open_dataset(arguments.dataset)
    reference = read_reference(arguments.reference) if arguments.reference else None
    work = pipeline.refine(dataset, config, reference, versions.key_version())
    opened = StageRecord(
        "input", round(time.perf_counter() - started, 3), round(local.peak_memory_mb(), 1), 1, False
    )
    refined = _refine(arguments.out, dataset, config, work, opened, display)
    outcome.show(refined.report, arguments.out)


def _refine(
    out: Path, dataset: Dataset, config: Config, work: Plan, opened: StageRecord, display: Display
) -> Result:
    result_folder.prepare(out)
    with lock(out / "stages", out):
        store = ZarrStore(out / "stages")
        store.tidy(work.version)

        def announce(step: Step, index: int, total: int) -> None:
            display.stage(step.name, index, total)

        records = local.run(work, store, display.progress, announce)
        display.stage("write", len(records), len(records) + 1)
        refined = result.collect(dataset, config, work, store)
        refined = result.with_run(refined, [opened, *records], versions.versions())
        refined.write(out)
    display.clear()
    return refined
