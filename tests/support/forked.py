"""`lvba` in a process of its own, forked from one that has imported it: imports are most of what a refusal takes."""

import multiprocessing
import os
import subprocess
import sys
import tempfile
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    ["service.cli.run_command", "service.cli.view_command", "service.cli.worker_command", "workers.cluster"]
)


def run_forked(*arguments, code=0, cwd=None):
    """The finished process of `lvba ARGUMENTS`, after checking its exit code."""
    words = list(map(str, arguments))
    with tempfile.TemporaryDirectory() as folder:
        process = _CONTEXT.Process(target=_lvba, args=(words, cwd, folder))
        process.start()
        process.join(300)
        stdout, stderr = ((Path(folder) / name).read_text() for name in ("stdout", "stderr"))
    assert process.exitcode == code, f"exit code {process.exitcode}\n{stdout}\n{stderr}"
    return subprocess.CompletedProcess(words, code, stdout, stderr)


def _lvba(words, cwd, folder):
    for stream, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(folder) / name, os.O_WRONLY | os.O_CREAT), stream)
    if cwd:
        os.chdir(cwd)
    sys.argv = ["lvba", *words]
    from service.cli import main

    sys.exit(main.main(words))
