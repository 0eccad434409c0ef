"""`lvba run`: a recording to a result folder, going on from the stages that are finished."""

import argparse
import dataclasses
import os
import time

from lvba import pipeline, result
from lvba.dataset import Dataset
from lvba.io import result_folder
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.plan import Plan, Step
from lvba.result import Result
from service import clusters, outcome, settings_files, stopping
from service.checks import check_out
from service.progress import Display
from workers import local, versions
from workers.local import StageRecord
from workers.store import ZarrStore
from workers.url_store import open_store


def run(arguments: argparse.Namespace, display: Display) -> None:
    """Refine the recording and write OUT."""
    config = settings_files.load(arguments)
    clusters.check(arguments)
    check_out(arguments.out, arguments.dataset)
    started = time.perf_counter()
    display.stage("input", 0, 1)
    dataset = open_dataset(arguments.dataset)
    reference = read_reference(arguments.reference) if arguments.reference else None
    work = pipeline.refine(_for_workers(dataset), config, reference, versions.key_version())
    opened = StageRecord(
        "input", round(time.perf_counter() - started, 3), round(local.peak_memory_mb(), 1), 1, False
    )
    refined = _refine(arguments, dataset, config, work, opened, display)
    outcome.show(refined.report, arguments.out)


def _for_workers(dataset: Dataset) -> Dataset:
    """The recording with paths that hold in any working folder; its digest stays."""

    def absolute(paths: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(os.path.abspath(path) for path in paths)

    return dataclasses.replace(
        dataset,
        root=os.path.abspath(dataset.root),
        scan_paths=absolute(dataset.scan_paths),
        image_paths=absolute(dataset.image_paths),
    )


def _refine(
    arguments: argparse.Namespace,
    dataset: Dataset,
    config: Config,
    work: Plan,
    opened: StageRecord,
    display: Display,
) -> Result:
    out = result_folder.prepare(arguments.out)
    store = open_store(_place(arguments.store or str(out / "stages")))
    with store.lock(out):
        store.tidy(work.version)
        records = _execute(arguments, work, store, display)
        display.stage("write", len(records), len(records) + 1)
        refined = result.collect(dataset, config, work, store)
        refined = result.with_run(refined, [opened, *records], versions.versions())
        refined.write(out)
    display.clear()
    return refined


def _place(store: str) -> str:
    """The folder or URL of a store as it holds in any working folder."""
    return store if "://" in store else os.path.abspath(store)


def _execute(
    arguments: argparse.Namespace, work: Plan, store: ZarrStore, display: Display
) -> list[StageRecord]:
    """A record per step, after running the plan in this process or on a cluster."""

    def announce(step: Step, index: int, total: int) -> None:
        display.stage(step.name, index, total)

    if arguments.workers is None and arguments.scheduler is None:
        return local.run(work, store, display.progress, announce)
    with clusters.scheduler(arguments) as scheduler:
        # Dask takes a moment to import, and is not needed by who runs in one process
        from workers import cluster

        return cluster.run(work, store.place, scheduler, display.progress, announce, stopping.check)
