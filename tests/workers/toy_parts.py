"""A plan of the shape that a recording in parts has, of steps that take a moment: importable by worker processes.

Every way in which a step of a run depends on others is in it: many from one, one from many, rounds, artifacts that are
read only when looked at, and artifacts that are looked at one after another.
"""

import os
import time
from pathlib import Path

import numpy as np
from toy_steps import PAUSE, say

from lvba.plan import LazyRef, Plan, StreamedRef
from workers import versions

TICKS = 10
"""Reports of progress of a step, so that it can be met while it runs; one where the file `QUICK` is in the folder."""
QUICK = "quick"


def work_on(folder, name, *inputs, progress):
    """Random numbers that depend on the name and on all inputs."""
    say(folder, f"began {name} {os.getpid()}")
    ticks = 1 if (Path(folder) / QUICK).exists() else TICKS
    for tick in range(ticks):
        progress("working", tick, ticks)
        time.sleep(PAUSE)
    total = sum(total_of(each) for each in inputs)
    say(folder, f"ended {name}")
    return {"name": name, "values": np.random.default_rng(len(name)).normal(size=(60, 30)) + total}


def total_of(value):
    """The sum of an artifact, of those in a list, or of one that is read by a call."""
    if isinstance(value, list):
        return sum(map(total_of, value))
    return float(np.sum((value() if callable(value) else value)["values"]))


def parts(folder, count=2, rounds=2):
    """The plan: see the module."""
    plan = Plan(versions.key_version())

    def add(name, *inputs):
        return plan.add(name, work_on, str(folder), name, *inputs)

    survey = add("survey")
    solved = [add(f"part-{n}", survey) for n in range(count)]
    state = add("merge", solved, add("loop-0-1", *solved[:2]))
    clusters = [add(f"clusters-{n}", state, survey) for n in range(count)]
    for turn in range(rounds):
        sums = [add(f"sums-{turn}-{n}", LazyRef(own.key), state) for n, own in enumerate(clusters)]
        state = add(f"step-{turn}", state, [StreamedRef(each.key) for each in sums])
    pieces = [add(f"map-{n}", LazyRef(own.key), state) for n, own in enumerate(clusters)]
    add("facts", state, [StreamedRef(each.key) for each in pieces])
    return plan
