"""What a run will take of memory, said before it begins."""

import argparse
import os

from lvba.blocks import memory, split, survey
from lvba.blocks.memory import Peaks
from lvba.blocks.split import Load
from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.pipeline import Config
from service.cli import clusters
from service.cli.progress import Display

_LEAST_PART_GB = 0.5
"""What split.memory_gb may be at least."""


def announce(arguments: argparse.Namespace, dataset: Dataset, config: Config, display: Display) -> Load:
    """Say in one line what a part will take, and of what; what the recording asks of memory comes back.

    Raises InputError: more than --memory-limit gives.
    """
    load = survey.load_of(dataset)
    cores = split.parts(dataset, config.split, load)
    peaks = memory.peaks(dataset, cores, load, config.visual.keyframes)
    needed = peaks.largest
    given = clusters.memory_bytes(arguments)
    if given is not None and needed > given:
        raise _too_little(peaks, given, len(cores))
    what = "memory" if len(cores) == 1 else f"memory for each of {len(cores)} parts"
    limit = _limit(arguments, given)
    display.tell(f"{what}: about {needed / 1e9:.1f} GB{limit}")
    return load


def machine_bytes() -> int:
    """Memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _limit(arguments: argparse.Namespace, given: int | None) -> str:
    if arguments.scheduler is not None:
        return ", on workers whose limit is their own"
    if arguments.workers is None:
        return f", of {machine_bytes() / 1e9:.1f} GB"
    # Dask takes a moment to import, and is not needed by who runs in one process
    from workers import limits

    return f", of {(given or limits.memory_per_process(arguments.workers)) / 1e9:.1f} GB for each worker"


def _too_little(peaks: Peaks, given: int, parts: int) -> InputError:
    needed = peaks.largest
    what = "the recording" if parts == 1 else f"the largest of {parts} parts"
    if peaks.part <= given:
        rounds = {peaks.joint: "a joint round of all scans", peaks.cameras: "a joint round of all cameras"}
        what = rounds.get(needed, "the map of a region")
    mend = f"give each worker {needed / 1e9 + 0.05:.1f} GB or more"
    smaller = given / 1e9
    if smaller >= _LEAST_PART_GB and peaks.part > given:
        mend += f", or make the parts smaller (--set split.by=memory --set split.memory_gb={smaller:.3g})"
    return InputError(
        f"--memory-limit {given / 1e9:.3g}GB", f"{what} takes about {needed / 1e9:.2f} GB", mend
    )
