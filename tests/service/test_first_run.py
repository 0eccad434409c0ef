"""Who waits for kernels to be compiled sees that they are, and how far it is."""

import importlib.util
import os

from service.cli import first_run, kernel_cache

SPREAD = """
from lvba.kernels import morton
from service.cli import first_run, progress

class Lines(progress.Display):
    def progress(self, what, done, total):
        self.note(f"{what} {done} of {total}")

with first_run.shown(Lines()):
    morton.spread(1)
"""
KERNELS = "from numba import njit\n\n\n@njit(cache=True)\ndef next_of(x):\n    return x + 1\n"


def test_notice_and_count_appear_once_and_only_where_something_is_compiled(lvba, tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first = lvba(program=("-c", SPREAD), env=environment).stderr.splitlines()
    assert first[0] == first_run.NOTICE
    assert [line.rpartition(" of ")[0] for line in first[1:]] == [
        f"kernels compiled {number}" for number in range(1, len(first))
    ]
    assert len(first) > 1
    assert lvba(program=("-c", SPREAD), env=environment).stderr == ""


def test_code_older_than_its_source_does_not_count(tmp_path):
    source = tmp_path / "kernels.py"
    source.write_text(KERNELS)
    spec = importlib.util.spec_from_file_location("kernels", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert not kernel_cache.is_compiled(module.next_of, module)
    assert module.next_of(1) == 2
    assert kernel_cache.is_compiled(module.next_of, module)
    later = source.stat().st_mtime + 10
    os.utime(source, (later, later))
    assert not kernel_cache.is_compiled(module.next_of, module)
