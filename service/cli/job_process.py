"""The process of a job: `lvba run`, alone in its folder, for as long as a service answers for it.

python -m service.cli.job_process TASK run DATASET --out=OUT ...
TASK is JSON: {"lock": FILE, "without_links": [FOLDER, ...], "out": OUT, "notes": FILE}: the folders that others than the
server may write into, and where sizes and digests of the results go
"""

import contextlib
import json
import sys
from pathlib import Path

from lvba.errors import InputError
from lvba.io import no_links
from service.cli import main as command_line
from service.jobs import results
from service.system import deadline, disk_space, durable, file_lock


def main(task: str, *words: str) -> int:
    """Exit code of `lvba WORDS`; file_lock.EXIT_LOCKED: another process is at it; disk_space.EXIT_DISK_FULL.

    On a full disk neither events nor the log take what happened, and by the time that somebody looks there may be room.
    """
    deadline.watch()
    wanted = json.loads(task)
    no_links.refuse_below(wanted["without_links"])
    try:
        with file_lock.exclusive(Path(wanted["lock"])):
            code = command_line.main(words)
            return code or _keep(wanted)
    except BlockingIOError:
        sys.stderr.write("lvba: the previous attempt still holds the job's lock\n")
        return file_lock.EXIT_LOCKED
    except Exception as error:
        if not disk_space.is_full(error):
            raise
        with contextlib.suppress(OSError):
            sys.stderr.write("lvba: the disk is full\n")
        return disk_space.EXIT_DISK_FULL


def _keep(wanted: dict[str, str]) -> int:
    """Have the result on the disk, with its digests: the job is about to be called done."""
    try:
        results.note(Path(wanted["out"]), Path(wanted["notes"]))
        durable.sync_all(Path(wanted["lock"]).parent)
    except (InputError, OSError) as error:
        if disk_space.is_full(error):
            raise
        sys.stderr.write(f"lvba: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
