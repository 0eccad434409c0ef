"""`lvba warm`: all kernels that runs need are compiled beforehand, by short runs of a made-up recording."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.kernels import mixed_cells
from lvba.kernels.plane_refit import CellPoints
from lvba.simulate import simulate
from lvba.simulate.disturbances import Disturbances
from lvba.simulate.world import PlainCaster
from lvba.visual.image import Undistorter
from service.cli import compile_ahead, first_run, kernel_cache, run_command
from service.cli.progress import Display

_RUNS: tuple[tuple[str, ...], ...] = (
    ("--viewer",),
    ("--set", "split.by=count", "--set", "split.size=12"),
)
"""Options of each run: one as usual, with the map for the page; one in parts."""


def warm(arguments: argparse.Namespace, display: Display) -> None:
    """Fill the cache of compiled kernels, and say how many were compiled and where they lie."""
    place = kernel_cache.folder()
    started, compiled = time.perf_counter(), 0
    if not kernel_cache.is_warm(place):
        compiled = fill(display, arguments.threads)
        kernel_cache.note_warm(place)
    display.clear()
    seconds = time.perf_counter() - started
    said = f"{compiled} kernels compiled in {seconds:.0f} s" if compiled else "nothing to compile"
    sys.stdout.write(f"{said}; {len(kernel_cache.compiled(place))} files in {place}\n")


def fill(display: Display, threads: int | None = None) -> int:
    """Compile what runs need and the cache does not hold; how many kernels that were.

    threads: how many processes compile at most; None: as many as the machine has cores
    """
    with tempfile.TemporaryDirectory(prefix="lvba-warm-") as name, first_run.shown(display, "") as seen:
        recording = Path(name) / "recording"
        display.stage("compile", 0, 1)
        ahead = compile_ahead.run(display, threads)
        display.stage("simulate", 0, 1)
        simulate_recording(recording, display)
        own = () if threads is None else ("--threads", str(threads))
        for number, options in enumerate(_RUNS):
            result = Path(name) / f"result-{number}"
            run_command.refine(_arguments(recording, result, (*options, *own)), display)
        _see_rows_at_once()
        _look_into_mixed_cells()
    return ahead + seen.done


def _see_rows_at_once() -> None:
    """What only images that are read row by row need: those of the recording are too small to tell that they are."""
    camera = Camera(16, 12, 12.0, 12.0, 7.5, 5.5)
    Undistorter(camera)(np.zeros((12, 16, 3), np.uint8), np.array([0.01, 0.0, 0.0]))


def _look_into_mixed_cells() -> None:
    """What only scans need that planes leave open: planes hold those of the recording."""
    none, one = np.zeros(0, np.int32), np.zeros(1, np.int32)
    near = CellPoints(np.zeros(1, np.int64), np.array([0, 1]), one, np.zeros(2, np.int64), none)
    points, poses = np.zeros((1, 3), np.float32), np.eye(4)[None]
    limits = mixed_cells.MixedTest(sigma=0.02, size=0.25, min_points=16, ratio=0.1, max_tilt=0.02)
    labels = mixed_cells.label(near, points, poses, np.zeros((1, 3)), limits)
    mixed_cells.observations(near, points, labels)


def simulate_recording(recording: Path, display: Display) -> None:
    """A small recording with all that a recording may have: readings of an IMU, times of points, intensities, images
    with vignetting and colors that drift, and exposures that differ.
    """
    simulate(
        "cabinet",
        recording,
        seed=1,
        frames=24,
        scans=24,
        width=160,
        height=120,
        points_per_scan=4000,
        vignetting=True,
        imu=True,
        disturb=Disturbances(motion_left=0.1, white_balance=0.05),
        caster=PlainCaster,
        progress=display.progress,
    )


def _arguments(recording: Path, out: Path, options: tuple[str, ...]) -> argparse.Namespace:
    from service.cli import main

    return main.parser().parse_args(["run", str(recording), "--out", str(out), *options])
