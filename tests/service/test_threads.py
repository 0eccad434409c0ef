import json
import os
import subprocess
import sys

import pytest

_USED = """
import ctypes, os, threading
from service.system.threads import limit_threads
limit_threads(2)
together = threading.Barrier(8)
def use():
    held = [bytearray(64) for _ in range(20000)]
    together.wait()
    return len(held)
threads = [threading.Thread(target=use) for _ in range(8)]
for each in threads: each.start()
for each in threads: each.join()
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
stream = ctypes.c_void_p(libc.fdopen(os.dup(1), b"w"))
libc.malloc_info(0, stream)
libc.fflush(stream)
print("limit", os.environ["MALLOC_ARENA_MAX"])
"""
"""Eight threads that hold memory at a time, and what the C library says of its heaps then."""


def _heaps(**environment):
    known = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}
    run = subprocess.run(
        [sys.executable, "-c", _USED], env=known | environment, capture_output=True, text=True, check=True
    )
    return run.stdout.count("<heap "), run.stdout.rsplit("limit ", 1)[1].strip()


def test_threads_share_as_many_heaps_as_compute():
    heaps, limit = _heaps()
    assert limit == "2"
    assert 1 <= heaps <= 2


def test_a_limit_of_the_user_holds():
    heaps, limit = _heaps(MALLOC_ARENA_MAX="5")
    assert limit == "5"
    assert 2 < heaps <= 5


_LIBRARIES = """
import json, sys
from service.cli import {module}
{call}
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
print(json.dumps([each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]))
"""
"""Threads of each BLAS after a command: with several, sums depend on how many cores a machine has."""


@pytest.mark.parametrize(
    ("module", "call"),
    [
        (
            "main",
            "try: main.main(['run', '/nowhere', '--out', '/nowhere/out', '--quiet'])\nexcept SystemExit: pass",
        ),
        ("demo", "import service.system.threads as threads; threads.limit_threads(None)"),
    ],
)
@pytest.mark.parametrize("of_the_user", [{}, {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "3"}])
def test_commands_give_blas_one_thread(module, call, of_the_user):
    told = {
        name: value for name, value in os.environ.items() if not name.endswith("NUM_THREADS")
    } | of_the_user
    script = _LIBRARIES.format(module=module, call=call)
    run = subprocess.run([sys.executable, "-c", script], env=told, capture_output=True, text=True, check=True)
    threads = json.loads(run.stdout.splitlines()[-1])
    assert len(threads) >= 2
    assert set(threads) == {1}


def test_numba_s_own_threads_give_the_same_bytes(lvba, tiny_recording, tiny_result, tmp_path, monkeypatch):
    """Machines without OpenMP have only these, and two threads that enter them at once end the process."""
    monkeypatch.setenv("NUMBA_THREADING_LAYER", "workqueue")
    lvba("run", tiny_recording, "--out", tmp_path, "--threads", 2)
    for name in ("lidar_poses.txt", "image_poses.txt", "map.ply"):
        assert (tmp_path / name).read_bytes() == (tiny_result / name).read_bytes()
