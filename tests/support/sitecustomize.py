"""Imported by every Python process that a test starts with this folder on its PYTHONPATH: stages wait at gates.

While the file LVBA_TEST_GATES/<stage> exists, a run that comes to the stage stays in it, reporting progress, so that a
test finds it there however fast the machine is (see gates.py).
"""

import os
import sys
import time
from importlib.machinery import PathFinder
from pathlib import Path

PLAN = "lvba.plan"


class Finder:
    """Puts gates into the module that computes stages, when that is imported; processes that do not, pay nothing."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        spec = PathFinder.find_spec(name, path, target) if name == PLAN else None
        if spec is not None:
            load = spec.loader.exec_module
            spec.loader.exec_module = lambda module: (load(module), add_gates(module))
        return spec


def add_gates(module):
    compute = module.compute

    def held(step, store, progress=module.silent):
        gate = Path(os.environ["LVBA_TEST_GATES"]) / step.name
        while gate.exists():
            progress("held by a test", 0, 0)
            time.sleep(0.02)
        return compute(step, store, progress)

    module.compute = held


if os.environ.get("LVBA_TEST_GATES"):
    sys.meta_path.insert(0, Finder)
