"""A real browser in front of a real service, and what must hold whenever a page is looked at."""

import os
import re
import subprocess
import sys
import time

from browsers import check_accessible
from forked import ForkedProcess
from gates import Gates
from ports import free_port

from service.db import keys
from service.db.database import Database

NAME = "small yard"
PATIENCE_MS = 400_000  # the first run on a machine compiles the kernels


class Served:
    """`lvba serve` over a data folder, on a port of its own that it keeps.

    The first one is started as users start it, with its jobs. Later ones are forked from a process that has imported it,
    and so are their jobs: imports are most of what a start takes.
    """

    def __init__(self, data, *options, forked=True):
        self.data, self.options, self.port = data, options, free_port()
        self.log = data.with_suffix(".log")
        self.gates = Gates(data.with_name(f"{data.name}-gates"))
        self.environment = {**os.environ, **self.gates.environment}
        self.start(forked)

    def start(self, forked=True):
        words = ["serve", "--data", str(self.data), "--port", str(self.port), *self.options]
        self.log.write_text("")
        if forked:
            self.process = ForkedProcess(words, self.log, self.environment, forks_jobs=True)
        else:
            with self.log.open("ab") as log:
                command = [sys.executable, "-m", "service.cli", *words]
                self.process = subprocess.Popen(command, stdout=log, stderr=log, env=self.environment)
        end = time.monotonic() + 120
        while (found := re.search(r"serving (http://[^ ]+:(\d+))", self.log.read_text())) is None:
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < end
            time.sleep(0.05)
        self.url, self.port = found[1], int(found[2])

    def stop(self):
        self.process.terminate()
        self.process.wait(60)

    def key(self, owner):
        """A new key."""
        database = Database(f"sqlite:///{self.data / 'lvba.sqlite'}")
        try:
            return keys.create(database, owner, ("read", "submit"), days=None)
        finally:
            database.close()


class Watched:
    """A page of a browser; `check` fails if anything went wrong that nobody would see."""

    def __init__(self, browser, url, **options):
        self.context = browser.new_context(
            viewport={"width": 1280, "height": 860}, accept_downloads=True, **options
        )
        self.context.set_default_timeout(PATIENCE_MS)
        self.page = self.context.new_page()
        self.url, self.problems, self.allowed = url, [], []
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.problems.append(f"error: {error}"))
        self.context.on("request", self._asked)
        self.page.on("response", self._answered)

    def _said(self, message):
        if message.type in ("error", "warning"):
            self.problems.append(f"console: {message.text}")

    def _asked(self, request):
        if not request.url.startswith((self.url, "data:", "blob:")):
            self.problems.append(f"asked elsewhere: {request.url}")

    def _answered(self, response):
        if response.status >= 400:
            self.problems.append(f"status {response.status}: {response.url}")

    def go(self, place):
        self.page.goto(f"{self.url}/#/{place}")
        self.page.get_by_role("heading", level=1).first.wait_for()

    def check(self):
        strange = [one for one in self.problems if not any(re.search(known, one) for known in self.allowed)]
        assert strange == [], "\n".join(strange)

    def accessible(self):
        """No violation that axe finds (WCAG 2.2 A and AA, and its best practices)."""
        check_accessible(self.page)


def _pixels(png):
    import cv2
    import numpy as np

    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


def colors_of(png):
    """How many different colors a picture has."""
    import numpy as np

    # as numbers: rows of a table are sorted many times slower
    return len(np.unique(_pixels(png) @ np.array([1, 256, 65536])))


def alike(png, other, *, right=1.0):
    """Whether two pictures are the same, or this part of them: letters over the map come out one gray value off at
    times."""
    import cv2

    one, two = (picture[:, round((1 - right) * picture.shape[1]) :] for picture in map(_pixels, (png, other)))
    return one.shape == two.shape and cv2.absdiff(one, two).max() <= 2


def choose_folder(page, folder):
    page.get_by_label("Choose folder").set_input_files(folder)


def show_map(watched, job):
    """Opens the result and waits until the map is there; the canvas."""
    watched.go(f"jobs/{job}/result")
    watched.page.wait_for_function(
        "() => /^[1-9]/.test(document.querySelector('.cloud-status')?.textContent ?? '')"
    )
    return watched.page.get_by_role("application", name="Map in 3D")


def hide_lines(page):
    page.get_by_label("Cameras").uncheck()
    page.get_by_label("Paths").uncheck()


def at_rest(canvas):
    """A picture of the map that is followed by the same one."""
    picture, end = canvas.screenshot(), time.monotonic() + PATIENCE_MS / 1000
    while True:
        canvas.page.wait_for_timeout(300)
        before, picture = picture, canvas.screenshot()
        if alike(before, picture):
            return picture
        assert time.monotonic() < end, "the map keeps changing"


def new_picture(canvas, seen):
    """Waits until the map looks like none of these."""
    end = time.monotonic() + PATIENCE_MS / 1000
    picture = at_rest(canvas)
    while any(alike(picture, one) for one in seen):
        assert time.monotonic() < end, "the map looks as before"
        picture = at_rest(canvas)
    return picture
