"""Speed of the photometric linearization, in samples (pixel pair times channel) per second and core.

A sample is everything: the warp, two bilinear lookups with gradient, residual, robust weight, and its share of the
normal equations. Compilation is left out; the least processor time of several runs counts, on one thread.
"""

import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.visual import photometric
from lvba.visual.photometric import PhotometricState, Problem
from lvba.visual.scene_points import Observations, ScenePoints
from lvba.visual.states import CameraStates


def problem(
    patch: int = 9, channels: int = 1, images: int = 24, points: int = 300, targets: int = 8, seed: int = 0
) -> tuple[Problem, PhotometricState]:
    """A slow pan at 3 m over random texture at 640 x 480; `points` per image, each seen in `targets` neighbors."""
    rng = np.random.default_rng(seed)
    camera = Camera(640, 480, 460.0, 460.0, 319.5, 239.5)
    coarse = rng.uniform(20, 230, (images, 121, 161, channels))
    level = np.repeat(np.repeat(coarse, 4, axis=1), 4, axis=2)[:, :480, :640].astype(np.uint8)
    steps = np.repeat(np.arange(images)[:, None], 6, axis=1) * [0.002, 0.004, 0.001, 0.01, 0.005, 0.004]
    poses = geometry.exp(steps + 0.002 * rng.normal(size=(images, 6)))
    reference = np.repeat(np.arange(images), points).astype(np.int32)
    pixel = np.stack([rng.integers(60, 580, len(reference)), rng.integers(60, 420, len(reference))], axis=1)
    ray = np.column_stack([(pixel - [camera.cx, camera.cy]) / camera.fx, np.ones(len(pixel))])
    position = np.einsum("pij,pj->pi", poses[reference, :3, :3], 3.0 * ray) + poses[reference, :3, 3]
    normal = rng.normal(size=position.shape) * 0.3 + [0, 0, -1.0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scene = ScenePoints(
        position_world=position,
        normal_world=normal,
        sigma_plane=np.zeros(len(pixel)),
        unevenness=np.zeros(len(pixel)),
        reference=reference,
        pixel=pixel.astype(np.int32),
        plane=np.arange(len(pixel), dtype=np.int32),
        is_global=np.zeros(len(pixel), bool),
    )
    offsets = np.concatenate([np.arange(-(targets // 2), 0), np.arange(1, targets - targets // 2 + 1)])
    target = reference[:, None] + offsets
    inside = (target >= 0) & (target < images)
    point = np.broadcast_to(np.arange(len(reference))[:, None], target.shape)[inside]
    pairs = Observations(
        point.astype(np.int32), target[inside].astype(np.int32), np.zeros(inside.sum(), bool)
    )
    states = CameraStates(poses, 0.1 * rng.normal(size=images))
    task = photometric.prepare(level, camera, scene, pairs, patch, offset_sigma=np.full(len(pixel), 0.005))
    return task, PhotometricState(states, np.zeros(len(pixel)))


def best_seconds(work: Callable[[], Any], repeats: int = 7) -> float:
    """The least processor time of some runs (other programs do not count); the first, which compiles, is not timed."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def run(patches: tuple[int, ...] = (7, 9, 11), channels: tuple[int, ...] = (1, 3)) -> dict[str, Any]:
    """Million samples per second on one thread: of the whole linearization, and of the sums over patches alone."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    rows = []
    try:
        for patch in patches:
            for count in channels:
                task, states = problem(patch, count)
                samples = float(photometric.sums(task, states)[:, photometric.COUNT].sum())
                whole = best_seconds(lambda task=task, states=states: photometric.linearize(task, states))
                inner = best_seconds(lambda task=task, states=states: photometric.sums(task, states))
                rows.append(
                    {
                        "patch": patch,
                        "channels": count,
                        "samples": int(samples),
                        "linearize_million_per_second": samples / whole / 1e6,
                        "sums_million_per_second": samples / inner / 1e6,
                    }
                )
    finally:
        numba.set_num_threads(threads)
    return {"name": "photometric", "threads": 1, "rows": rows}


if __name__ == "__main__":
    import json

    print(json.dumps(run(), indent=1))
