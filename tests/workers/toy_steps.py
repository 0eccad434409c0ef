"""Steps that say what they do in a file, and misbehave when asked to: importable by worker processes."""

import os
import time
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.plan import Plan
from workers import versions

PAUSE = 0.02


def say(folder, what):
    with (Path(folder) / "log").open("a") as log:
        log.write(what + "\n")


def said(folder, start=""):
    log = Path(folder) / "log"
    return [line for line in (log.read_text().splitlines() if log.exists() else []) if line.startswith(start)]


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(PAUSE)
    return found


def make(folder, name, *inputs, progress):
    """Random numbers that depend on the name and the inputs; held up while `folder/hold-NAME` exists."""
    say(folder, f"began {name} {os.getpid()}")
    try:
        done = 0
        while (Path(folder) / f"hold-{name}").exists():
            progress("holding", done, 0)
            done += 1
            time.sleep(PAUSE)
        progress("making", 1, 1)
    except Exception as error:
        say(folder, f"stopped {name} {type(error).__name__}")
        raise
    say(folder, f"ended {name}")
    total = sum(float(np.sum(array)) for array in inputs)
    # large enough to be a zarr array, in Fortran order on purpose
    return np.asfortranarray(np.random.default_rng(len(name)).normal(size=(40, 30)) + total)


def fail(folder, kind):
    say(folder, f"began fail {os.getpid()}")
    if kind == "input":
        raise InputError("scan.pcd", "is cut short", "copy it again")
    if kind == "disk":
        raise OSError(5, "Input/output error")
    hungry = []
    while True:
        hungry.append(np.ones(20_000_000))


def hungry(folder, times):
    """Takes more memory than there is, so many times."""
    say(folder, f"began hungry {os.getpid()}")
    taken = []
    while len(said(folder, "began hungry")) <= times:
        taken.append(np.ones(20_000_000))
    return np.arange(1000.0)


def stay(folder):
    """Reports nothing while `folder/hold-stay` exists."""
    say(folder, f"began stay {os.getpid()}")
    while (Path(folder) / "hold-stay").exists():
        time.sleep(PAUSE)


def spoil(folder, store, value):
    """Damages an artifact of an earlier step, once."""
    say(folder, f"began spoil {os.getpid()}")
    if len(said(folder, "began spoil")) == 1:
        chunk = next(p for p in Path(store).glob("a-*/0/c/0/0"))
        chunk.write_bytes(b"\0" * chunk.stat().st_size)
    return value + 1


def ask(folder, read, wants, _):
    """Looks at an artifact only if it wants to."""
    say(folder, f"began ask {os.getpid()}")
    return read() + 1 if wants else 0


def chain(folder, version=None):
    """a -> bb -> ccc, and dddd from nothing."""
    work = Plan(versions.key_version() if version is None else version)
    a = work.add("a", make, str(folder), "a")
    bb = work.add("bb", make, str(folder), "bb", a)
    work.add("ccc", make, str(folder), "ccc", a, [bb])
    work.add("dddd", make, str(folder), "dddd")
    return work
