"""Holding a run of another process in a stage, for tests that need it there: never hope to see it pass."""

import os
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).parent


class Gates:
    """One folder of gates, for every process that is started with `environment`."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        paths = os.pathsep.join(map(str, (HERE, HERE.parents[1])))
        self.environment = {"LVBA_TEST_GATES": str(self.folder), "PYTHONPATH": paths}

    @contextmanager
    def held(self, stage):
        """Runs that come to this stage stay in it until the block ends."""
        gate = self.folder / stage
        gate.touch()
        try:
            yield
        finally:
            gate.unlink()
