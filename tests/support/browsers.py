"""A real browser, and what axe says about the page it shows."""

import json
from pathlib import Path

import pytest
from programs import program_or_skip

_NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL by a renderer in software: test machines have no graphics card
_OPTIONS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def browser_or_skip():
    """Yields a browser without a window, and closes it."""
    # before the driver starts: it needs libraries that a browser brings along
    program = program_or_skip(*_NAMES)
    sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=program, args=[*_OPTIONS, "--disable-dev-shm-usage"], timeout=60_000
        )
        yield browser
        browser.close()


def check_accessible(page):
    """No violation that axe finds (WCAG 2.2 A and AA, and its best practices)."""
    import axe_playwright_python

    page.evaluate((Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text())
    found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    told = [
        {"rule": one["id"], "where": [node["target"] for node in one["nodes"]][:4], "help": one["help"]}
        for one in found["violations"]
    ]
    assert told == [], json.dumps(told, indent=1)
