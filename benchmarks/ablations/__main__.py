"""One recording by the method with a part of it left out: a result folder as `lvba run` writes it.

python -m benchmarks.ablations "without exposures" RECORDING --out RESULT [--reference TRUTH] [--set name=value ...]

The name of a model of what sensors do, such as "white balance", is the method without it.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.ablations import ABLATIONS, MODELS
from lvba import config as settings
from lvba import pipeline, result
from lvba.io import result_folder
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from workers import local, versions
from workers.url_store import open_store

_EVERY = ABLATIONS | MODELS


def run(name: str, recording: Path, out: Path, reference: Path | None, options: list[str]) -> None:
    """Writes the result folder; finished stages are kept in it and used again."""
    ablation = _EVERY[name]
    config = settings.override(Config(), [*ablation.settings, *options])
    dataset = open_dataset(recording)
    truth = None if reference is None else read_reference(reference)
    work = pipeline.refine(
        dataset, config, truth, versions.key_version(),
        variant=ablation.variant, align_parts=ablation.align_parts,
    )  # fmt: skip
    store = open_store(str(result_folder.prepare(out) / "stages"))
    records = local.run(work, store)
    outcome = result.collect(dataset, config, work, store)
    result.with_run(outcome, records, versions.versions(), name).write(out)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=_EVERY, metavar="NAME", help=f"one of: {'; '.join(_EVERY)}")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    given = parser.parse_args()
    run(given.name, given.recording, given.out, given.reference, given.set)


if __name__ == "__main__":
    sys.exit(main())
