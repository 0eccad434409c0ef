"""The process of a job: `lvba run`, alone in its folder, for as long as a service answers for it; then the page's files.

python -m service.server.job_process LOCK run DATASET --out=OUT ...
"""

import sys
from pathlib import Path

from service import cli
from service.server import lifeline

_OUT = "--out="


def main(lock: str, *words: str) -> int:
    """Exit code of `lvba WORDS`; lifeline.BUSY: another process is at it."""
    lifeline.hold()
    try:
        with lifeline.alone(Path(lock)):
            code = cli.main(words)
            if code == 0:
                _add_cloud(*(word.removeprefix(_OUT) for word in words if word.startswith(_OUT)))
            return code
    except BlockingIOError:
        sys.stderr.write("lvba: the attempt before has not let go of the job yet\n")
        return lifeline.BUSY


def _add_cloud(out: str) -> None:
    """The map with levels of detail and its pictures; the result stands without them: errors only go to the log."""
    cli.main(["export", out, "lod"])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
