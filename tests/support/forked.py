"""`lvba` in a process of its own, forked from one that has imported it: imports are most of what a short run takes."""

import importlib
import importlib.util
import multiprocessing
import multiprocessing.forkserver
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    [
        "service.cli.run_command",
        "service.cli.import_command",
        "service.cli.view_command",
        "service.cli.worker_command",
        "service.cli.serve_command",
        "service.api.serving",
        "service.cli.job_process",
        "workers.cluster",
        "zarr",
        "tests.support.loaded_kernels",
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
    """`lvba WORDS` that continues, in a session of its own; what tests need of `subprocess.Popen`.

    forks_jobs: processes of its jobs are forked, too
    """

    def __init__(self, words, log, environment, forks_jobs=False):
        outputs = [str(log)] * 2
        self._start(_lvba, list(map(str, words)), outputs, os.getcwd(), dict(environment), forks_jobs)

    def _start(self, target, *arguments):
        # ended with the tests, should one of them leave it running
        self._process = _CONTEXT.Process(target=target, args=arguments, daemon=True)
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
            with suppress(ProcessLookupError):  # gone since, and not told of yet
                os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class _ForkedJob(ForkedProcess):
    """The process of a job, for `service.system.child_process`: forked, with a pipe to its stdin."""

    def __init__(self, module, words, log, environment):
        reading, writing = _CONTEXT.Pipe(duplex=False)
        with reading, writing:
            self._start(_job, module, list(words), str(log), dict(environment), reading)
            self.stdin = os.fdopen(os.dup(writing.fileno()), "wb")


def _fork_jobs():
    """From now on, this process, which was forked itself, forks its jobs. Unlike those that it would start, they know
    of its death by their pipe alone: their parent is the server of forks."""
    from service.system import child_process

    def start(command, *, stdout, env, **options):
        module, *words = command[2:]
        if module != "service.cli.job_process":
            return subprocess.Popen(command, stdout=stdout, env=env, **options)
        return _ForkedJob(module, words, stdout.name, env)

    child_process.subprocess = SimpleNamespace(Popen=start, PIPE=subprocess.PIPE)


def fork_workers(put=setattr):
    """From now on, this process forks the workers that Dask would start for it. put: sets an attribute of a module"""
    from distributed import nanny, process

    for module in (nanny, process):
        put(module, "get_mp_context", _WorkersContext)


class _WorkersContext:
    """Of the multiprocessing module, what Dask needs: its processes have the environment of who starts them."""

    Queue, Pipe = _CONTEXT.Queue, _CONTEXT.Pipe

    @staticmethod
    def Process(target, args, name):  # noqa: N802 - as it is called there
        return _CONTEXT.Process(target=_in_environment, args=(dict(os.environ), target, args), name=name)


def _in_environment(environment, target, arguments):
    _set_environment(environment)
    target(*arguments)


def _job(module, words, log, environment, stdin):
    os.dup2(stdin.fileno(), 0)
    stdin.close()
    _settle([log] * 2, environment)
    sys.exit(importlib.import_module(module).main(*words))


def _settle(outputs, environment):
    for stream, path in zip((1, 2), outputs):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
    if environment is not None:
        os.setsid()
        _set_environment(environment)
    # the server of the tests forks for this process, too: it has no other to start or to look after
    multiprocessing.forkserver._forkserver.ensure_running = lambda: None
    multiprocessing.current_process()._config["daemon"] = False  # which may not have children
    fork_workers()


def _set_environment(environment):
    os.environ.clear()
    os.environ.update(environment)
    _put_gates()


def _lvba(words, outputs, cwd, environment=None, forks_jobs=False):
    _settle(outputs, environment)
    if cwd:
        os.chdir(cwd)
    if forks_jobs:
        _fork_jobs()
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
                before = dict(vars(sys.modules[name]))
                add(sys.modules[name])
                _replace({before[key]: value for key, value in _changed(before, vars(sys.modules[name]))})


def _changed(before, now):
    return [(key, value) for key, value in now.items() if before.get(key) is not value]


def _replace(functions):
    """Also where other modules have imported them by name."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("lvba", "workers", "service"):
            for key, value in list(vars(module).items()):
                if callable(value) and value.__hash__ and value in functions:
                    setattr(module, key, functions[value])
