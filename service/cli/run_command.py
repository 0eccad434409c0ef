"""`lvba run`: a recording to a result folder, continuing from the stages that are finished."""

import argparse
import dataclasses
import logging
import os
import time
from pathlib import Path
from typing import Any

from lvba import pipeline, result
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import result_folder
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.plan import Plan, Step
from lvba.products.export import export
from lvba.result import Result
from service.cli import (
    clusters,
    compile_ahead,
    first_run,
    import_command,
    memory_estimate,
    removed_stages,
    result_table,
    settings_files,
    stopping,
)
from service.cli.out_check import check_out
from service.cli.progress import Display
from service.jobs.run_events import IMPORT, VIEWER
from workers import local, versions
from workers.local import StageRecord
from workers.store import ZarrStore
from workers.url_store import open_store

_log = logging.getLogger(__name__)


def run(arguments: argparse.Namespace, display: Display) -> None:
    """Refine the recording, write OUT and show what has become of it."""
    with first_run.shown(display):
        report = refine(arguments, display)
    result_table.show(report, arguments.out)


def refine(arguments: argparse.Namespace, display: Display) -> dict[str, Any]:
    """The report, after refining the recording and writing OUT."""
    config = settings_files.load(arguments)
    clusters.check(arguments)
    check_out(arguments.out, arguments.dataset)
    started = time.perf_counter()
    imported = import_command.of_run(arguments, display)
    folder = imported or arguments.dataset
    display.stage("input", 0, 1)
    dataset = open_dataset(folder)
    reference = read_reference(arguments.reference) if arguments.reference else None
    load = memory_estimate.announce(arguments, dataset, config, display)
    if arguments.scheduler is None:
        compile_ahead.run(display, arguments.threads)
    if arguments.workers is not None:
        first_run.announce_in_workers(display)
    work = pipeline.refine(_for_workers(dataset), config, reference, versions.key_version(), load=load)
    opened = StageRecord(
        "input", round(time.perf_counter() - started, 3), round(local.peak_memory_mb(), 1), 1, False
    )
    report = _refine(arguments, dataset, config, work, opened, display, imported=imported is not None).report
    if arguments.viewer:
        _add_viewer(arguments.out, len(report["stages"]), display)
    return report


def _add_viewer(out: Path, index: int, display: Display) -> None:
    """The map with levels of detail and its pictures. The result stands without them: errors are lines in the log."""
    display.stage(VIEWER, index, index + 1)
    try:
        export(out, "lod", None, display.progress)
    except Exception as error:
        display.note(f"warning: there is nothing for a viewer: {error or type(error).__name__}")
        _log.debug("export of lod", exc_info=True)
    display.clear()


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
    *,
    imported: bool,
) -> Result:
    out = result_folder.prepare(arguments.out)
    store = open_store(_place(arguments.store or str(out / "stages")))
    with store.lock(out), removed_stages.explained(out, work.steps):
        store.tidy(work.version)
        if arguments.redo:
            _forget(work, store, arguments.redo)
        last = ["write", VIEWER] if arguments.viewer else ["write"]
        display.stages(
            [*([IMPORT] if imported else []), "input", *(step.name for step in work.steps.values()), *last]
        )
        records = _execute(arguments, work, store, display)
        display.stage("write", len(records), len(records) + len(last))
        refined = result.collect(dataset, config, work, store)
        refined = result.with_run(refined, [opened, *records], versions.versions(), arguments.name or "")
        refined.write(out)
    for record in [opened, *records]:
        display.record(record.name, record.seconds, record.peak_memory_mb, record.reused)
    display.clear()
    return refined


def _forget(work: Plan, store: ZarrStore, name: str) -> None:
    """Remove what a stage made, and all that depends on it.

    Raises InputError: there is no such stage.
    """
    names = [step.name for step in work.steps.values()]
    if name not in names:
        raise InputError(f"--redo {name}", "there is no such stage", f"one of these: {', '.join(names)}")
    doomed: set[str] = set()
    for key, step in work.steps.items():
        if step.name == name or doomed.intersection(step.needs):
            doomed.add(key)
            if key in store:
                del store[key]


def _place(store: str) -> str:
    """The folder or URL of a store as it holds in any working folder."""
    return store if "://" in store else os.path.abspath(store)


def _execute(
    arguments: argparse.Namespace, work: Plan, store: ZarrStore, display: Display
) -> list[StageRecord]:
    """A record per step, after running the plan in this process or on a cluster."""

    def announce(step: Step, index: int, total: int) -> None:
        # on a cluster, only what is not there is announced
        display.stage(step.name, index, total, step.key in store if in_process else False)

    in_process = arguments.workers is None and arguments.scheduler is None
    if in_process:
        return local.run(work, store, display.progress, announce)
    with clusters.scheduler(arguments) as scheduler:
        # Dask takes a moment to import, and is not needed by who runs in one process
        from workers import cluster

        return cluster.run(work, store.place, scheduler, display.progress, announce, stopping.check)
