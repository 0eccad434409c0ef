import os
import subprocess
import sys

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
