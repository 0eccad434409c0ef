"""The process of a job: `lvba run`, alone in its folder, for as long as a service answers for it.

python -m service.server.job_process TASK run DATASET --out=OUT ...
TASK is JSON: {"lock": FILE, "without_links": [FOLDER, ...], "out": OUT, "notes": FILE}: the folders that others than the
server may write into, and where sizes and digests of the results go
"""

import json
import sys
from pathlib import Path

from lvba.errors import InputError
from lvba.io import no_links
from service import cli
from service.server import durable, lifeline, results


def main(task: str, *words: str) -> int:
    """Exit code of `lvba WORDS`; lifeline.BUSY: another process is at it."""
    lifeline.hold()
    wanted = json.loads(task)
    no_links.refuse_below(wanted["without_links"])
    try:
        with lifeline.alone(Path(wanted["lock"])):
            code = cli.main(words)
            return code or _keep(wanted)
    except BlockingIOError:
        sys.stderr.write("lvba: the attempt before has not let go of the job yet\n")
        return lifeline.BUSY


def _keep(wanted: dict[str, str]) -> int:
    """Have the result on the disk, with its digests: the job is about to be called done."""
    try:
        results.note(Path(wanted["out"]), Path(wanted["notes"]))
        durable.sync_all(Path(wanted["lock"]).parent)
    except (InputError, OSError) as error:
        sys.stderr.write(f"lvba: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
