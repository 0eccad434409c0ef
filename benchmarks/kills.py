"""A long run in parts that is killed or canceled at random steps, and continued: the same bytes as without.

    python benchmarks/kills.py --frames 1000 --kills 10 --seed 1

A simulated street is refined by two worker processes, once left alone and once with kills: a worker, all processes at
once (SIGKILL, as when the power fails), or Ctrl-C, each a moment after a step that is drawn by chance: as many in each
part of the steps. Where the run has ended by that, the same command continues it. Printed: what was killed in which
step, the seconds of both runs, and the files whose bytes differ. Exit code 1 where one does, or where the run ended
before all kills.
"""

import argparse
import hashlib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bench_length
import psutil

ROOT = Path(__file__).resolve().parent.parent
KINDS = ("a worker", "all processes", "Ctrl-C")
RESULTS = ("lidar_poses.txt", "image_poses.txt", "exposures.csv", "calibration.yaml", "map.ply")
_STEP = re.compile(r"^\[(\d+)/(\d+)\]", re.MULTILINE)
_THIN = ("--points", "3000", "--width", "320", "--height", "240")
_CANCELED = 130
_PATIENCE_S = 120.0
"""Seconds in which a canceled run must have ended."""
_LOOK_S = 0.05
"""How often the log is asked which step the run is at."""
_MOMENT_S = 1.0
"""At most so long after a step has begun a run is killed: most steps of a part take less."""


@dataclass(frozen=True)
class Killed:
    """One kill. step: the last one that the run told of."""

    kind: str
    step: str


def main() -> int:
    """Exit code: 0 where all kills were made and the bytes are the same."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1, help="of the steps, moments and kinds")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        return compare(Path(folder), arguments.frames, arguments.kills, random.Random(arguments.seed))


def compare(work: Path, frames: int, kills: int, chance: random.Random) -> int:
    """Exit code, as `main`; prints what happened."""
    bench_length.simulate(work / "street", "street", frames, _THIN)
    started = time.perf_counter()
    if run(work, "alone").wait():
        sys.exit("the run that is left alone failed")
    alone = time.perf_counter() - started
    killed = disturb(work, kills, chance)
    seconds = time.perf_counter() - started - alone
    for each in killed:
        print(f"{each.kind} in {each.step}")
    different = [name for name in RESULTS if digest(work / "alone" / name) != digest(work / "killed" / name)]
    print(f"{len(killed)} kills; {alone:.0f} s left alone, {seconds:.0f} s with kills")
    print(f"files with other bytes: {', '.join(different) or 'none'}")
    return int(bool(different) or len(killed) < kills)


def disturb(work: Path, kills: int, chance: random.Random) -> list[Killed]:
    """A run with kills, continued until it is done; one falls into each piece of its steps."""
    killed: list[Killed] = []
    process, log = run(work, "killed"), work / "killed.log"
    for number in range(kills):
        wait_until(process, log, chance.uniform(number, number + 1) / kills)
        time.sleep(chance.uniform(0.0, _MOMENT_S))
        if process.poll() is not None:
            break
        kind = chance.choice(KINDS)
        killed.append(Killed(kind, last_step(log)))
        if kill(process, kind, chance):
            process = run(work, "killed")
    if code := process.wait():
        sys.exit(f"a run that nobody killed ended with {code}")
    return killed


def wait_until(process: subprocess.Popen[bytes], log: Path, part: float) -> None:
    """Until a run is at that part of its steps, or has ended. A run that is continued tells of the steps anew."""
    begun = log.stat().st_size
    while process.poll() is None:
        steps = _STEP.findall(log.read_bytes()[begun:].decode(errors="replace"))
        if steps and int(steps[-1][0]) >= part * int(steps[-1][1]):
            return
        time.sleep(_LOOK_S)


def kill(process: subprocess.Popen[bytes], kind: str, chance: random.Random) -> bool:
    """Whether the run has ended by it. A worker is one of those processes that the run has started."""
    children = psutil.Process(process.pid).children(recursive=True)
    if kind == "a worker":
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        if workers:
            chance.choice(workers).kill()
        return False
    if kind == "Ctrl-C":
        process.send_signal(signal.SIGINT)
        if (code := process.wait(_PATIENCE_S)) != _CANCELED:
            sys.exit(f"a canceled run ended with {code}")
        return True
    for each in (process, *children):
        with suppress(ProcessLookupError, psutil.NoSuchProcess):
            os.kill(each.pid, signal.SIGKILL)
    process.wait()
    return True


def run(work: Path, name: str) -> subprocess.Popen[bytes]:
    """The refinement of the street, begun or continued; what it tells is in a log beside the result."""
    command = [sys.executable, "-m", "service.cli", "run", str(work / "street"), "--out", str(work / name)]
    with (work / f"{name}.log").open("ab") as log:
        return subprocess.Popen(
            [*command, "--workers", "2", *bench_length.CUT], cwd=ROOT, stdout=log, stderr=log
        )


def last_step(log: Path) -> str:
    """The last line of a log that names a step as `[3/30] lidar` does."""
    steps = [line for line in log.read_text().splitlines() if line.startswith("[")]
    return steps[-1] if steps else "nothing yet"


def digest(path: Path) -> str:
    """Of a file's bytes, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
