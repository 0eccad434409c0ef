"""What several processes of one run of the tests need: the first that asks makes it, the others wait for it."""

import fcntl
import os
import pickle
import shutil


def made_once(tmp_path_factory, name, make):
    """The folder `make(folder)` filled, and what it returned. Nobody may change the folder.

    The processes of xdist have folders of their own, in one that is new in each run of the tests.
    """
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made-once"
    shared.mkdir(exist_ok=True)
    folder, returned = shared / name, shared / f"{name}.pickle"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not returned.exists():
            shutil.rmtree(folder, ignore_errors=True)
            returned.write_bytes(pickle.dumps(make(folder)))
    return folder, pickle.loads(returned.read_bytes())
