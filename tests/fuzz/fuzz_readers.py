"""Fuzzing of all readers: `python tests/fuzz/fuzz_readers.py --minutes 60`.

Each case is read in a child process that may take 1 GB of address space and 300 MB of memory more than before, and 5 s of
processor time. A reader may refuse (InputError) or give back something sound; whatever else it does is kept below --found
with its input, once for each place in the code. Inputs that are refused for a new reason become starting points too.
"""

import argparse
import contextlib
import faulthandler
import hashlib
import json
import logging
import mmap
import os
import pickle
import random
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import fuzz_mutations
from fuzz_mutations import Files
from fuzz_targets import TARGETS, Target

from lvba.errors import InputError

CASE_S = 5.0
_STUCK_S = 120
"""Seconds of the clock without a new case after which a child is ended: it waits for something."""
_ADDRESS_SPACE, _RESIDENT = 1 << 30, 300 << 20
_CORPUS = 300
_KIND = re.compile(r"[\d.]+|'[^']*'|\"[^\"]*\"")


@dataclass
class IntakeBudget:
    """What became of the cases of one reader."""

    cases: int = 0
    accepted: int = 0
    corpus: list[Files] = field(default_factory=list)
    seeds: int = 0
    """The first ones of the corpus."""
    reasons: set[str] = field(default_factory=set)
    found: list[str] = field(default_factory=list)


class Fuzzer:
    """Runs batches of cases, each in a child process."""

    def __init__(self, targets: Mapping[str, Target], found: Path, work: Path, seed: int = 0) -> None:
        self.targets, self.found, self.work, self.seed = targets, found, work, seed
        self.tallies = {
            name: IntakeBudget(corpus=found, seeds=len(found))
            for name in targets
            if (found := self._seeds(name))
        }
        self._shared = mmap.mmap(-1, 16)
        self._batches = 0

    def _seeds(self, name: str) -> list[Files]:
        folder = self.work / f"seeds-{name}"
        folder.mkdir(parents=True)
        seeds = self.targets[name].seeds(folder)
        for seed in seeds:  # also compiles what is compiled at first use
            self.targets[name].read(_written(self.work / f"first-{name}", seed))
        return seeds

    def batch(self, name: str, cases: int) -> None:
        """So many cases of one reader, or fewer if one of them is bad enough."""
        self._batches += 1
        report, case = self.work / "report", self.work / "case"
        report.unlink(missing_ok=True)
        self._shared[:] = bytes(16)
        child = os.fork()
        if child == 0:
            os._exit(self._in_child(name, cases, report, case))
        code = self._wait(child)
        budget = self.tallies[name]
        done, accepted = struct.unpack("qq", self._shared[:])
        budget.cases, budget.accepted = budget.cases + done, budget.accepted + accepted
        if code:
            what = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            self._keep(name, f"{name}: {what}", f"{what}\n", case)
        if report.exists():
            fresh, failures = pickle.loads(report.read_bytes())  # our own child's
            budget.reasons |= fresh.keys()
            budget.corpus = (budget.corpus + list(fresh.values()))[:_CORPUS]
            for title in failures:
                if title not in budget.found:
                    budget.found.append(title)

    def _wait(self, child: int) -> int:
        """The child's exit code, negative for a signal."""
        seen, since = b"", time.monotonic()
        while True:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            if self._shared[:] != seen:
                seen, since = self._shared[:], time.monotonic()
            if time.monotonic() > since + _STUCK_S:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.005)

    def _in_child(self, name: str, cases: int, report: Path, case: Path) -> int:
        _limit()
        rng = random.Random(f"{self.seed}/{name}/{self._batches}")
        target, budget = self.targets[name], self.tallies[name]
        fresh: dict[str, Files] = {}
        failures: list[str] = []
        before = _resident()
        seeds, accepted = budget.corpus[: budget.seeds], 0
        for number in range(cases):
            start = rng.choice(seeds if rng.random() < 0.6 else budget.corpus + list(fresh.values()))
            tokens = [*fuzz_mutations.NUMBERS[:4], *target.tokens]
            files = target.mend(rng, fuzz_mutations.mutate(rng, start, budget.corpus[:30], tokens))
            folder = _written(case, files)
            signal.setitimer(signal.ITIMER_PROF, CASE_S)
            try:
                target.read(folder)
                accepted += 1
            except InputError as error:
                if len(str(error).splitlines()) != 1 or len(str(error)) > 2000:
                    failures.append(self._keep(name, f"{name}: a message too long", str(error), case))
                reason = _KIND.sub("", error.problem)[:80]
                if reason not in budget.reasons and reason not in fresh:
                    fresh[reason] = files
            except BaseException as error:
                failures.append(self._keep(name, _title(name, error), traceback.format_exc(), case))
            signal.setitimer(signal.ITIMER_PROF, 0)
            self._shared[:] = struct.pack("qq", number + 1, accepted)
            if _resident() > before + _RESIDENT:
                size = sum(map(len, files.values()))
                text = f"{(_resident() - before) >> 20} MB for {size} bytes\n"
                failures.append(self._keep(name, f"{name}: memory", text, case))
                break
        report.write_bytes(pickle.dumps((fresh, failures)))
        return 0

    def _keep(self, name: str, title: str, text: str, case: Path) -> str:
        place = self.found / f"{name}-{hashlib.sha256(title.encode()).hexdigest()[:10]}"
        if not place.exists():
            shutil.copytree(case, place)
            (place / "WHAT.txt").write_text(f"{title}\n\n{text}")
        if title not in self.tallies[name].found:
            self.tallies[name].found.append(title)
        return title


def _written(folder: Path, files: Files) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def _limit() -> None:
    """Of this process: address space, no dumps, nothing printed, ended by SIGPROF when a case takes too long."""
    with open("/proc/self/statm") as statm:
        limit = int(statm.read().split()[0]) * resource.getpagesize() + _ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    logging.disable()
    faulthandler.disable()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def _resident() -> int:
    """The most bytes that this process has held at a time."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _title(name: str, error: BaseException) -> str:
    """The same for the same mistake: the error and the line of ours that met it."""
    ours = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if re.search(r"/(lvba|service|fuzz)/", frame.filename)
    ]
    last = ours[-1]
    return f"{name}: {type(error).__name__} at {'/'.join(Path(last.filename).parts[-2:])}:{last.lineno}"


def summary(tallies: Mapping[str, IntakeBudget]) -> str:
    """A table with a row for each reader."""
    rows = [f"{'reader':16}{'cases':>10}{'accepted':>10}{'refused':>10}{'reasons':>9}{'found':>7}"]
    for name, budget in tallies.items():
        refused = budget.cases - budget.accepted
        rows.append(
            f"{name:16}{budget.cases:10}{budget.accepted:10}{refused:10}{len(budget.reasons):9}{len(budget.found):7}"
        )
    total = (
        sum(budget.cases for budget in tallies.values()),
        sum(budget.accepted for budget in tallies.values()),
    )
    found = [title for budget in tallies.values() for title in budget.found]
    rows.append(f"{'all':16}{total[0]:10}{total[1]:10}{total[0] - total[1]:10}{'':9}{len(found):7}")
    return "\n".join([*rows, *found])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="of processor time")
    parser.add_argument("--cases", type=int, help="of each reader, instead of minutes")
    parser.add_argument("--only", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--batch", type=int, default=500, help="cases for each child process")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--found", type=Path, default=Path("fuzz-found"), help="where failing inputs are kept"
    )
    parser.add_argument(
        "--replay", type=Path, help="read the input in this folder of --found, and tell what happens"
    )
    given = parser.parse_args()
    cv2.setNumThreads(1)
    logging.disable()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if given.replay:
        return _replay(given.replay)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as work:
        fuzzer = Fuzzer({name: TARGETS[name] for name in given.only}, given.found, Path(work), given.seed)
        with contextlib.suppress(KeyboardInterrupt):  # what was found until then is what there is to say
            _rounds(fuzzer, given.cases, given.batch, given.minutes * 60)
        print(f"{_processor_s() / 60:.1f} minutes of processor time\n{summary(fuzzer.tallies)}")
        return int(any(budget.found for budget in fuzzer.tallies.values()))


def _rounds(fuzzer: Fuzzer, cases: int | None, batch: int, seconds: float) -> None:
    """A batch of each reader, once (cases) or until so much processor time is spent."""
    told = 0.0
    while (spent := _processor_s()) < seconds:
        for name in fuzzer.targets:
            fuzzer.batch(name, cases or batch)
        if cases:
            return
        if spent > told + 60:
            told = spent
            counts = {name: budget.cases for name, budget in fuzzer.tallies.items()}
            print(json.dumps({"minutes": round(spent / 60, 1), **counts}), flush=True)


def _processor_s() -> float:
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def _replay(place: Path) -> int:
    """Reads a kept input in this process, without limits."""
    name = place.name.rpartition("-")[0]
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "case"
        shutil.copytree(place, folder)
        (folder / "WHAT.txt").unlink(missing_ok=True)
        try:
            TARGETS[name].read(folder)
            print("accepted")
        except InputError as error:
            print(f"refused: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
