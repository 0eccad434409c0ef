"""A real cluster on this machine: a scheduler and workers as processes of their own."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from distributed.security import Security
from forked import ForkedProcess
from gates import Gates
from ports import free_port

ROOT = Path(__file__).resolve().parents[2]


def tls_files(folder):
    """PEM files of an authority, a certificate and its key."""
    made = Security.temporary()
    texts = {"ca": made.tls_ca_file, "cert": made.tls_client_cert, "key": made.tls_client_key}
    for name, text in texts.items():
        (folder / name).write_text(text)
    return [folder / name for name in texts]


class Cluster:
    """`dask scheduler` and `lvba worker` processes; the workers are forked from one that has imported them."""

    def __init__(self, folder, tls=()):
        self.folder, self.tls = folder, tls
        self.gates = Gates(folder / "gates")
        self.port = free_port()
        self.address = f"{'tls' if tls else 'tcp'}://127.0.0.1:{self.port}"
        self.processes = []
        self.start_scheduler()

    def start_scheduler(self):
        words = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", self.port]
        words += ["--dashboard-address", "127.0.0.1:0", "--protocol", self.address[:3]]
        if self.tls:
            words += ["--tls-ca-file", self.tls[0], "--tls-cert", self.tls[1], "--tls-key", self.tls[2]]
        self.scheduler = self._start("-m", *words)

    def start_worker(self, *options):
        words = ["worker", self.address, "--threads", 1, *self.tls_options, *options]
        self.processes.append(ForkedProcess(words, self._log(), self._environment()))
        return self.processes[-1]

    @property
    def tls_options(self):
        return [w for pair in zip(("--tls-ca", "--tls-cert", "--tls-key"), self.tls) for w in pair]

    def kill_scheduler(self):
        self.scheduler.send_signal(signal.SIGKILL)
        self.scheduler.wait()

    def on(self):
        """The options by which `lvba run` finds it."""
        return ["--scheduler", self.address, *self.tls_options]

    def kill_all(self):
        """SIGKILL of the scheduler and all workers at the same moment."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()

    def _start(self, *words):
        with self._log().open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, *map(str, words)], stdout=log, stderr=log, env=self._environment()
            )
        self.processes.append(process)
        return process

    def _log(self):
        return self.folder / f"{len(self.processes)}.log"

    def _environment(self):
        environment = {**os.environ, **self.gates.environment}
        environment["PYTHONPATH"] += f"{os.pathsep}{Path(__file__).parent}"
        return environment

    def end(self):
        """Stops everything; what each process said is shown with a test that failed."""
        for process in reversed(self.processes):
            process.terminate()
        for process in reversed(self.processes):
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for log in sorted(self.folder.glob("*.log")):
            print(f"{log.name}:", log.read_text(errors="replace")[-3000:])
