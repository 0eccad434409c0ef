"""What the files in deploy/ say, read so that the same commands can be run here without containers."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
PATIENCE = 300.0


def read_settings(file):
    """The assignments of an environment file, as Docker Compose and systemd read those that both understand."""
    found = {}
    for line in file.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            name, value = re.fullmatch(r"([A-Z][A-Z0-9_]*)=(\"[^\"$\\]*\"|[^\s\"'$\\]*)", line).groups()
            found[name] = value.strip('"')
    return found


def filled_in(value, settings):
    """A value of a compose file with ${NAME:-default} replaced, everywhere below it."""
    if isinstance(value, dict):
        return {name: filled_in(item, settings) for name, item in value.items()}
    if isinstance(value, list):
        return [filled_in(item, settings) for item in value]
    if not isinstance(value, str):
        return value
    return re.sub(r"\$\{(\w+):-([^}]*)\}", lambda found: settings.get(found[1], found[2]), value)


def compose(settings=None):
    """compose.yaml as Docker Compose understands it with these settings (default: those of the example)."""
    settings = read_settings(DEPLOY / "lvba.env.example") if settings is None else settings
    return filled_in(yaml.safe_load((DEPLOY / "compose.yaml").read_text()), settings)


class Host:
    """A machine of one's own: an address of the loopback network for each container, folders in place of volumes."""

    def __init__(self, folder):
        self.folder = folder
        # all of 127.0.0.0/8 is here, so that everybody has every port
        self.net = f"127.{random.randrange(1, 255)}.{random.randrange(1, 255)}"
        self.names = []
        self.processes = []
        self.replaced = {}

    def address(self, name):
        """The address of a container."""
        if name not in self.names:
            self.names.append(name)
        return f"{self.net}.{self.names.index(name) + 1}"

    def here(self, text, name=""):
        """The text of a container with the paths and names of this host."""
        for there, here in self.replaced.items():
            text = re.sub(rf"(?<![\w.-]){re.escape(there)}(?![\w-])", str(here), text)
        return text.replace("0.0.0.0", self.address(name)).replace("127.0.0.1", self.address(name))

    def start(self, name, words, environment):
        """A process whose output is in a file; returns it and the file."""
        log = self.folder / f"{name}-{len(self.processes)}.log"
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [self.here(word, name) for word in words],
                stdout=stream,
                stderr=stream,
                env=self.environment(environment, name),
                cwd=self.folder,
            )
        self.processes.append(process)
        return process, log

    def run(self, name, words, environment, code=0):
        """What a process says that ends by itself."""
        done = subprocess.run(
            [self.here(word, name) for word in words],
            capture_output=True, text=True, env=self.environment(environment, name), cwd=self.folder,
        )  # fmt: skip
        assert code is None or done.returncode == code, done.stdout + done.stderr
        return done

    def environment(self, given, name):
        """Of a process: little more than what it is given."""
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"], "/usr/sbin"])
        base = {"PATH": path, "HOME": str(self.folder), "PYTHONPATH": str(ROOT)}
        # results are compared with those of this process: BLAS of other processors sums in another order
        base |= {key: value for key, value in os.environ.items() if key == "OPENBLAS_CORETYPE"}
        return base | {key: self.here(str(value), name) for key, value in given.items()}

    def end(self):
        """End all of them, the youngest first."""
        for process in reversed(self.processes):
            process.send_signal(signal.SIGTERM)
        for process in reversed(self.processes):
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def wait_for(condition, process=None, log=None):
    """Until it holds; at once an error if the process ends before."""
    end = time.monotonic() + PATIENCE
    while not condition():
        said = log.read_text(errors="replace") if log else ""
        assert process is None or process.poll() is None, said
        assert time.monotonic() < end, said
        time.sleep(0.1)
