"""Maps of 1, 10 and 50 million points in the page: what their levels of detail take to make, to load and to draw.

Each map is made here: blocks of houses with noise, as large as it takes at 4 cm between points. The page is that of a
real `lvba serve`, in a real Chromium; where there is no graphics card, as on test machines, WebGL runs in software, and
the milliseconds of a frame say only how frames of large maps compare with those of small ones. `overview` is the whole
map on the screen, `close` a dozen steps nearer; frames are timed while the map turns.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from lvba import simulate
from lvba.io import ply

ROOT = Path(__file__).resolve().parent.parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_SPACING = 0.04
"""m between neighboring points."""
_BLOCK = 40.0
"""m, edge of a block: a street with a house of half that edge."""
_HOUSE, _HEIGHT = 20.0, 10.0
_OCTREE = """
import json, sys, time
from pathlib import Path
from lvba.products import lod
from workers.local import peak_memory_mb
lod.write(Path(sys.argv[1]), Path(sys.argv[2]))
json.dump([time.process_time(), peak_memory_mb()], sys.stdout)
"""
_FRAMES = """async () => {
  const canvas = document.querySelector('canvas[role=application]');
  const next = () => new Promise((done) => requestAnimationFrame(done));
  const times = [];
  for (let turn = 0; turn < 20; turn++) {
    const start = performance.now();
    canvas.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}));
    await next(); await next();
    times.push(performance.now() - start);
  }
  return times.sort((a, b) => a - b)[10];
}"""


def run(millions: tuple[int, ...] = (1, 10, 50)) -> dict[str, Any]:
    """A row per map."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        octrees = [_octree(work / f"map{count}", count * 1_000_000) for count in millions]
        rows = _in_the_page(work, octrees)
    return {"name": "viewer", "rows": rows}


def blocks(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of a map of `count` points: (count,) each."""
    rng = np.random.default_rng(seed)
    walls = 4 * _HOUSE * _HEIGHT
    fraction = walls / (walls + _BLOCK**2)
    side = int(np.ceil(np.sqrt(count * _SPACING**2 / (walls + _BLOCK**2))))
    corner = rng.integers(0, side, (count, 2)).astype(np.float32) * np.float32(_BLOCK)
    on_wall = rng.random(count) < fraction
    along = rng.random(count).astype(np.float32)
    face = rng.integers(0, 4, count)
    flat = rng.random((count, 2)).astype(np.float32) * np.float32(_BLOCK)
    inside = (np.stack([along, (face % 2).astype(np.float32)], 1) - np.float32(0.5)) * np.float32(_HOUSE)
    wall = np.where((face < 2)[:, None], inside, inside[:, ::-1]) + np.float32(_BLOCK / 2)
    plan = corner + np.where(on_wall[:, None], wall, flat)
    height = np.where(on_wall, rng.random(count) * _HEIGHT, 0.0)
    noise = rng.normal(0, 0.01, (count, 3)).astype(np.float32)
    shade = (90 + 60 * np.sin(plan[:, 0] * 0.7) + 40 * np.sin(height * 2.1)).clip(0, 255).astype(np.uint8)
    return {
        "x": plan[:, 0] + noise[:, 0],
        "y": plan[:, 1] + noise[:, 1],
        "z": (height + noise[:, 2]).astype(np.float32),
        "red": shade,
        "green": shade // 2 + 60,
        "blue": 200 - shade // 2,
        "views": np.full(count, 5, np.uint8),
        "spread": np.full(count, 4.0, np.float32),
        "scan": (corner[:, 0] / _BLOCK).astype(np.int32),
    }


def _octree(folder: Path, count: int) -> dict[str, Any]:
    """Makes the map, and in a process of its own its levels of detail; what these took."""
    folder.mkdir()
    ply.write_ply(folder / "map.ply", blocks(count))
    words = [sys.executable, "-c", _OCTREE, str(folder / "map.ply"), str(folder / "cloud")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    seconds, memory = json.loads(done.stdout)
    (folder / "map.ply").unlink()
    size = sum(file.stat().st_size for file in (folder / "cloud").iterdir())
    return {
        "folder": folder / "cloud",
        "million points": count / 1e6,
        "octree processor s": seconds,
        "octree peak MB": memory,
        "octree MB on disk": size / 1e6,
    }


def _in_the_page(work: Path, octrees: list[dict[str, Any]]) -> list[dict[str, Any]]:
    from playwright.sync_api import sync_playwright

    program = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if program is None:
        return [{**row, "folder": "no browser on the path"} for row in octrees]
    service, url = _served(work)
    try:
        job = _job(work, url)
        (place,) = (work / "data" / "jobs" / job / "out").rglob("cloud")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=program, args=SOFTWARE)
            rows = []
            for row in octrees:
                facts = (place / "cloud.json").read_bytes()
                shutil.rmtree(place)
                shutil.move(row.pop("folder"), place)
                (place / "cloud.json").write_bytes(facts)
                rows.append({**row, **_looked_at(browser, f"{url}/#/jobs/{job}/result")})
            browser.close()
            return rows
    finally:
        service.terminate()
        service.wait()


def _served(work: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A service and its address."""
    log = work / "service.log"
    words = [sys.executable, "-m", "service.cli", "serve", "--data", str(work / "data"), "--port", "0"]
    with log.open("wb") as stream:
        process = subprocess.Popen(
            words, stdout=stream, stderr=stream, env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
    while (match := re.search(r"serving (http://\S+)", log.read_text())) is None:
        if process.poll() is not None:
            raise RuntimeError(log.read_text())
        time.sleep(0.1)
    return process, match[1]


def _job(work: Path, url: str) -> str:
    """The id of a job that is done: of a small street, whose map gives way to the large ones."""
    recording = work / "street"
    simulate.simulate(
        "street", recording, frames=8, scans=8, length=6.0, seed=5, width=96, height=72, points_per_scan=1500
    )
    words = [sys.executable, "-m", "service.cli", "submit", str(recording), "--server", url, "--wait"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        words, check=True, stdout=subprocess.PIPE, text=True, env=environment
    ).stdout.split()[0]


def _looked_at(browser: Any, address: str) -> dict[str, Any]:
    """What the page loads and shows of the map, from afar and near."""
    context = browser.new_context(viewport={"width": 1280, "height": 860})
    page = context.new_page()
    sizes: list[int] = []

    def answered(response: Any) -> None:
        if "/cloud/" in response.url:
            sizes.append(int(response.headers.get("content-length", 0)))

    page.on("response", answered)
    start = time.perf_counter()
    page.goto(address)
    figures: dict[str, Any] = {}
    for look in ("overview", "close"):
        if look == "close":
            page.get_by_role("application", name="Map in 3D").focus()
            for _ in range(12):
                page.keyboard.press("+")
                page.wait_for_timeout(50)
        shown = _settled(page)
        figures[f"{look}: million shown"] = shown / 1e6
        figures[f"{look}: MB loaded"] = sum(sizes) / 1e6
        figures[f"{look}: requests"] = len(sizes)
        if look == "overview":
            figures["overview: s until complete"] = time.perf_counter() - start
        figures[f"{look}: ms per frame"] = page.evaluate(_FRAMES)
    context.close()
    return figures


_UNITS = {"": 1.0, "k": 1e3, "M": 1e6}


def _settled(page: Any) -> float:
    """Points on the screen once nothing is loading any more; to the digits that the page shows."""
    page.wait_for_function(
        "() => /^[1-9]/.test(document.querySelector('.cloud-status')?.textContent ?? '')", timeout=300_000
    )
    before = ""
    while True:
        text = page.locator(".cloud-status").inner_text()
        if text == before and "Loading" not in text:
            number, _, unit = text.split(" of ")[0].partition(" ")
            return float(number) * _UNITS[unit]
        before = text
        page.wait_for_timeout(1500)
