"""Progress on a terminal and elsewhere."""

import io

import pytest

from service.cli import progress
from service.cli.progress import Display


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize(
    ("done", "total", "seconds", "text"),
    [
        (34, 100, 2.0, "34/100, 17/s, 0:04 left"),
        (0, 100, 2.0, "0/100"),
        (100, 100, 50.0, "100/100, 2/s"),
        (7, 0, 2.0, "7, 3.5/s"),
        (1, 8000, 1.0, "1/8000, 1/s, 2:13:19 left"),
    ],
)
def test_counts(done, total, seconds, text):
    assert progress.counts(done, total, seconds) == text


@pytest.mark.parametrize(("done", "total", "filled"), [(0, 10, 0), (5, 10, 12), (10, 10, 24), (12, 10, 24)])
def test_bar(done, total, filled):
    assert progress.bar(done, total) == "#" * filled + "-" * (24 - filled)


def test_plain_lines_are_few_and_hold_no_control_characters():
    stream, clock = io.StringIO(), Clock()
    display = Display(stream, clock)
    display.stage("lidar", 0, 3)
    for done in range(1, 2001):
        clock.now += 0.01
        display.progress("scans", done, 2000)
    display.note("something")
    display.clear()
    lines = stream.getvalue().splitlines()
    assert lines[0] == "[1/3] lidar"
    assert lines[-1] == "something"
    assert 2 <= len(lines) <= 5
    assert "100/s" in lines[1]
    assert stream.getvalue().isprintable() or set(stream.getvalue()) - {"\n"} == {
        c for c in stream.getvalue() if c.isprintable()
    }


def test_terminal_line_moves_and_leaves_nothing_behind(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    stream, clock = Terminal(), Clock()
    display = Display(stream, clock)
    display.stage("visual", 1, 3)
    clock.now += 1
    display.progress("a very long description of what is being done here", 50, 100)
    assert "[2/3] visual" in stream.getvalue()
    assert all(len(part) < 60 for part in stream.getvalue().split("\r"))
    display.clear()
    *_, blank, end = stream.getvalue().split("\r")
    assert blank.strip() == ""
    assert end == ""
    assert "\n" not in stream.getvalue()


def test_quiet_shows_nothing_but_notes():
    stream = Terminal()
    display = Display(stream, Clock(), quiet=True)
    display.stage("visual", 1, 3)
    display.progress("x", 1, 2)
    assert stream.getvalue() == ""
    display.note("warning")
    assert stream.getvalue() == "warning\n"
