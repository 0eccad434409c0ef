"""Imported by every Python process that a test starts with this folder on its PYTHONPATH: stages wait at gates.

While the file LVBA_TEST_GATES/<stage> exists, a run that comes to the stage stays in it, reporting progress, so that a
test finds it there however fast the machine is (see gates.py). LVBA_TEST_CLOCK names a file by which the clock is off.
"""

import os
import sys
import time
from importlib.machinery import PathFinder
from pathlib import Path


class Finder:
    """Puts gates into the modules that compute, when they are imported; processes that do not, pay nothing."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        add = GATED.get(name)
        spec = PathFinder.find_spec(name, path, target) if add else None
        if spec is not None:
            load = spec.loader.exec_module
            spec.loader.exec_module = lambda module: (load(module), add(module))
        return spec


def wait_at(name, progress):
    gate = Path(os.environ["LVBA_TEST_GATES"]) / name
    while gate.exists():
        progress("held by a test", 0, 0)
        time.sleep(0.02)


def add_gates(module):
    compute = module.compute

    def held(step, store, progress=module.silent):
        wait_at(step.name, progress)
        return compute(step, store, progress)

    module.compute = held


def add_viewer_gate(module):
    export = module.export

    def held(result, form, out=None, progress=module.silent):
        wait_at("viewer", progress)
        return export(result, form, out, progress)

    module.export = held


def add_import_gate(module):
    import_source = module.import_source

    def held(source, out, options, progress, announce):
        wait_at("import", progress)
        return import_source(source, out, options, progress, announce)

    module.import_source = held


def add_digest_gate(module):
    sha256 = module.sha256

    def held(file):
        wait_at("digest", lambda *_: None)
        return sha256(file)

    module.sha256 = held


def shift_clock(file):
    """The clock of the wall, as Python asks it, is off by as many seconds as the file says."""
    true = time.time

    def shifted():
        try:
            return true() + float(Path(file).read_text())
        except (OSError, ValueError):  # there is none, or it is being written
            return true()

    time.time = shifted


GATED = {
    "lvba.plan": add_gates,
    "lvba.products.export": add_viewer_gate,
    "lvba.sources.importing.importer": add_import_gate,
    "service.datasets.file_upload": add_digest_gate,
}
if os.environ.get("LVBA_TEST_CLOCK"):
    shift_clock(os.environ["LVBA_TEST_CLOCK"])
if os.environ.get("LVBA_TEST_GATES"):
    sys.meta_path.insert(0, Finder)
