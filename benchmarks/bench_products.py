"""Speed of the products: coloring, rendering, judging, map quality, files, report.

A room of 10 x 8 x 3 m, 100 scans of 30,000 points and 100 images of 640 x 480 unless said otherwise, made here from
random numbers: no recording is needed. Compilation is left out; the best of several runs counts, with all threads.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.io import ply
from lvba.lidar import moving_points
from lvba.products import cloud as clouds
from lvba.products import colorize, evaluate, map_file, map_quality, pictures, render, report
from lvba.products.evaluate import State
from lvba.products.views import Views
from lvba.visual.image import Undistorter

HALF = np.array([5.0, 4.0, 1.5])
CAMERA = Camera(640, 480, 460.0, 460.0, 319.5, 239.5)


def scene(
    scans: int = 100, points: int = 30_000, images: int = 100, seed: int = 0
) -> tuple[list[np.ndarray], Views]:
    """Scans (scan frame = camera frame) of a room and as many views that turn in it; pictures are coarse noise."""
    rng = np.random.default_rng(seed)
    delta = np.zeros((images, 6))
    delta[:, 1] = np.linspace(0, 2 * np.pi * 0.95, images)
    delta[:, 3:] = rng.uniform(-1, 1, (images, 3)) * [3, 2, 0.4]
    turn = geometry.exp(np.array([-np.pi / 2, 0, 0, 0, 0, 0.0]))
    poses = geometry.exp(delta * [0, 0, 0, 1, 1, 1]) @ turn @ geometry.exp(delta * [1, 1, 1, 0, 0, 0])
    coarse = rng.integers(20, 230, (8, 60, 80, 3)).astype(np.uint8)
    stack = np.repeat(np.repeat(coarse, 8, axis=1), 8, axis=2)
    clouds_scan = []
    for s in range(scans):
        pose = poses[s * images // scans]
        rays = rng.normal(size=(points, 3))
        with np.errstate(divide="ignore"):
            reach = (np.where(rays > 0, HALF - pose[:3, 3], -HALF - pose[:3, 3]) / rays).min(1)
        world = pose[:3, 3] + rays * reach[:, None] + rng.normal(0, 0.01, (points, 3))
        clouds_scan.append(geometry.transform_points(geometry.inverse(pose), world).astype(np.float32))
    times = np.arange(images, dtype=float)
    views = Views(lambda i: stack[i % 8], CAMERA, times, poses, rng.normal(0, 0.2, images))
    return clouds_scan, views


def best_seconds(work: Callable[[], Any], repeats: int = 3) -> float:
    """The least time of some runs; the first, which compiles, is not timed."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def run(scans: int = 100, points: int = 30_000, images: int = 100, repeats: int = 3) -> dict[str, Any]:
    """Seconds of each product."""
    loaded, views = scene(scans, points, images)
    poses = views.world_from_camera[np.arange(scans) * images // scans]
    rough = geometry.retract(poses, np.random.default_rng(1).normal(0, 0.01, (scans, 6)))
    cloud, bad = (clouds.assemble(lambda s: loaded[s], p, np.arange(float(scans))) for p in (poses, rough))
    states = {"rough": State(bad, views), "refined": State(cloud, views)}
    colors = colorize.paper(cloud, views)
    colored = render.colored_cloud(cloud.points_world, colors)
    scores = evaluate.evaluate(states)
    made = pictures.make(states["rough"], states["refined"], scores)
    facts = {"evaluation": {name: score.facts() for name, score in scores.items()}}
    kept = map_file.build(cloud, views)
    undistort, picture = Undistorter(replace(views.camera, distortion=(-0.1, 0.03, 0.0, 0.0))), views.load(0)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        works: dict[str, Callable[[], Any]] = {
            "assemble cloud": lambda: clouds.assemble(lambda s: loaded[s], poses, np.arange(float(scans))),
            "moving points, of scans 1 s apart": lambda: moving_points.moving_points(
                loaded.__getitem__, [poses], np.arange(float(scans)), np.zeros(3), range(scans)
            ),
            "image without distortion": lambda: undistort(picture),
            "the same, read row by row": lambda: undistort(picture, np.array([0.01, 0.02, -0.01])),
            "color by the paper": lambda: colorize.paper(cloud, views),
            "sort colored cloud": lambda: render.colored_cloud(cloud.points_world, colors),
            "render one image, one thread": lambda: render.render(colored, views, 0),
            "mean map entropy": lambda: map_quality.mean_map_entropy(cloud),
            "evaluate rough and refined": lambda: evaluate.evaluate(states),
            "pictures": lambda: pictures.make(states["rough"], states["refined"], scores),
            "report": lambda: report.write(out, facts, made),
            "thin and blend map": lambda: map_file.build(cloud, views),
            "write map.ply": lambda: ply.write_ply(out / "map.ply", map_file.columns(kept, np.zeros(3))),
        }
        rows = [{"work": name, "seconds": best_seconds(work, repeats)} for name, work in works.items()]
    return {
        "name": "products",
        "threads": numba.get_num_threads(),
        "points": len(cloud),
        "images": images,
        "map_points": len(kept),
        "rows": rows,
    }


if __name__ == "__main__":
    import json

    print(json.dumps(run(), indent=1))
