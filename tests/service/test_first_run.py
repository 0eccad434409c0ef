"""Who starts a run on a machine that has compiled nothing yet is told why it takes long."""

import importlib.util
import os

from service.cli import first_run

NOTICE = "the first run on this machine compiles the numerical kernels"
ANNOUNCE = "from service.cli import first_run, progress; first_run.announce(progress.Display(), images=True)"
KERNELS = "from numba import njit\n\n\n@njit(cache=True)\ndef next_of(x):\n    return x + 1\n"


def test_notice_appears_only_where_nothing_is_compiled(lvba, tiny_result, tmp_path):
    announce = ("-c", ANNOUNCE)
    assert NOTICE in lvba(program=announce, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}).stderr
    # the run of the fixture has compiled everything that this one needs
    assert NOTICE not in lvba(program=announce).stderr


def test_code_older_than_its_source_does_not_count(tmp_path):
    source = tmp_path / "kernels.py"
    source.write_text(KERNELS)
    spec = importlib.util.spec_from_file_location("kernels", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert not first_run.is_compiled(module)
    assert module.next_of(1) == 2
    assert first_run.is_compiled(module)
    later = source.stat().st_mtime + 10
    os.utime(source, (later, later))
    assert not first_run.is_compiled(module)
