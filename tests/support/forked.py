"""`lvba` in a process of its own, forked from one that has imported it: imports are most of what a short run takes."""

import importlib.util
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    [
        "service.cli.run_command",
        "service.cli.view_command",
        "service.cli.worker_command",
        "service.cli.serve_command",
        "service.api.serving",
        "workers.cluster",
    ]
)


def run_forked(*arguments, code=0, cwd=None, environment=None):
    """The finished process of `lvba ARGUMENTS`, after checking its exit code.

    environment: in a session of its own with these variables; numba has its threads by then, whatever they say
    """
    words = list(map(str, arguments))
    with tempfile.TemporaryDirectory() as folder:
        outputs = [str(Path(folder) / name) for name in ("stdout", "stderr")]
        process = _CONTEXT.Process(target=_lvba, args=(words, outputs, cwd, environment))
        process.start()
        process.join(300)
        stdout, stderr = (Path(each).read_text() for each in outputs)
    assert process.exitcode == code, f"exit code {process.exitcode}\n{stdout}\n{stderr}"
    return subprocess.CompletedProcess(words, code, stdout, stderr)


class ForkedProcess:
    """`lvba WORDS` that goes on, in a session of its own; what tests need of `subprocess.Popen`."""

    def __init__(self, words, log, environment):
        arguments = (list(map(str, words)), [str(log)] * 2, os.getcwd(), dict(environment))
        # ended with the tests, should one of them leave it running
        self._process = _CONTEXT.Process(target=_lvba, args=arguments, daemon=True)
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self):
        return self._process.exitcode

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("lvba", timeout)
        return self._process.exitcode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)


def _lvba(words, outputs, cwd, environment=None):
    for stream, path in zip((1, 2), outputs):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
    if cwd:
        os.chdir(cwd)
    if environment is not None:
        os.setsid()
        os.environ.clear()
        os.environ.update(environment)
        _put_gates()
    sys.argv = ["lvba", *words]
    from service.cli import main

    sys.exit(main.main(words))


def _put_gates():
    """What sitecustomize.py does in a process that begins: here, some of the modules are imported already."""
    spec = importlib.util.spec_from_file_location(
        "gates_of_tests", Path(__file__).with_name("sitecustomize.py")
    )
    gates = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gates)
    if os.environ.get("LVBA_TEST_GATES"):
        for name, add in gates.GATED.items():
            if name in sys.modules:
                add(sys.modules[name])
