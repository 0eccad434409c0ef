"""The process of a job: `lvba run`, alone in its folder, for as long as a service answers for it.

python -m service.server.job_process LOCK run DATASET --out=OUT ...
"""

import sys
from pathlib import Path

from service import cli
from service.server import lifeline


def main(lock: str, *words: str) -> int:
    """Exit code of `lvba WORDS`; lifeline.BUSY: another process is at it."""
    lifeline.hold()
    try:
        with lifeline.alone(Path(lock)):
            return cli.main(words)
    except BlockingIOError:
        sys.stderr.write("lvba: the attempt before has not let go of the job yet\n")
        return lifeline.BUSY


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
