"""`lvba simulate --bag`: a simulated recording as drivers would have recorded it, and the true poses beside it."""

import argparse
from pathlib import Path

from lvba.errors import InputError
from service.cli.progress import Display

_IMAGES_HZ = 10.0
_FRAMES = 100
_NOT_IN_BAGS = ("scans", "length", "closing", "disturb", "vignetting", "motion_blur", "shot_noise")


def write(arguments: argparse.Namespace, display: Display) -> None:
    """Write the bag, and OUT.truth.txt: TUM poses of the body at the start of each sweep.

    Raises InputError: OUT exists, or an option does not go with bags.
    """
    from lvba.io import tum
    from lvba.simulate import raw
    from lvba.sources.bags.point_layouts import PointLayout
    from lvba.sources.bags.writing import BagForm, write_bag
    from lvba.trajectory import Trajectory

    for name in _NOT_IN_BAGS:
        if getattr(arguments, name):
            option = name.replace("_", "-")
            raise InputError(f"--{option}", "does not go with --bag", "simulate a recording folder")
    out: Path = arguments.out
    if out.exists():
        raise InputError(out, "exists", "remove it, or choose another path")
    sensors = raw.Sensors(
        lidar=arguments.lidar or "spinning",
        points=arguments.points,
        width=arguments.width,
        height=arguments.height,
        image_hz=_IMAGES_HZ,
    )
    frames = arguments.frames or _FRAMES
    source, truth = raw.simulate_raw(
        arguments.scene, seconds=frames / _IMAGES_HZ, seed=arguments.seed, frames=frames, sensors=sensors
    )
    display.stage(f"write {out}", 0, 1)
    write_bag(source, out, BagForm(arguments.bag), PointLayout(arguments.bag_points))
    known = Trajectory(truth.scans * 1e-9, truth.scene_from_body(truth.scans))
    tum.write_trajectory(Path(f"{out}.truth.txt"), known)
