"""Parts of recordings with known truth, as submaps: places seen twice, places that only look alike."""

import numpy as np
import plane_world
from plane_world import World, look

from lvba import geometry
from lvba.lidar.bundle_adjustment import find_planes
from lvba.loop_closure import submap
from lvba.loop_closure.candidates import Candidate


def part(world, poses, first, points=6000, seed=0, moved_by=0.0, covariance=1e-10):
    """The submap of scans at true poses, numbered from `first`, in a world frame of its own."""
    scans = plane_world.scan_all(world, poses, points, 0.02, "spinning", seed)
    own = geometry.exp(moved_by + np.zeros(6)) @ poses
    planes, on_planes = find_planes(scans, own)
    numbers = np.arange(first, first + len(poses))
    return submap.build(
        planes, on_planes, own, numbers, covariance=np.tile(covariance * np.eye(6), (len(poses), 1, 1))
    )


def candidate(poses, others, one, other, off=0.0, sigma_m=1.0, sigma_deg=1.5):
    """Scans of two parts by their number in each, with a rough relative pose that is off by a tangent."""
    rough = geometry.inverse(poses[one]) @ others[other] @ geometry.exp(off + np.zeros(6))
    return Candidate(0, 1, one, 1000 + other, rough, 0.0, 100.0, sigma_m, sigma_deg)


def along(start, end, count, yaw=None):
    """Poses on a straight walk, swaying a little."""
    s = np.linspace(0, 1, count)
    start, end = np.asarray(start, float), np.asarray(end, float)
    heading = np.arctan2(*(end - start)[1::-1]) if yaw is None else yaw
    return np.stack(
        [look(start + t * (end - start), heading + 0.05 * np.sin(9 * t), 0.03 * np.sin(7 * t)) for t in s]
    )


def terrace(length=120.0, period=6.0, streets=1, gap=14.0, ends=False, relief=0.5) -> World:
    """Parallel streets of houses that are all alike, at equal spacing; ends: with a wall across where they begin."""
    world = World()
    world.rectangle([length / 2, gap * (streets - 1) / 2, 0], [length, 0, 0], [0, 20 + gap * streets, 0])
    for street in range(streets):
        middle = street * gap
        for side in (-1, 1):
            face = middle + side * 4
            for x in np.arange(0, length, period):
                low, high = sorted((face, face + side * 3))
                world.box([x, low, 0], [x + period, high, 7])
                for bottom, top in ((0.0, 2.2), (3.5, 5.0)):
                    low, high = sorted((face, face - side * relief))
                    world.box([x + 1, low, bottom], [x + 2.5, high, top])
    if ends:
        world.box([-1, -20, 0], [-0.5, 20 + gap * streets, 9])
        world.box([2, -3.5, 0], [3.5, -1.5, 2.5])
    return world


def corridor() -> World:
    """A bare corridor without end in sight."""
    world = World()
    world.box([-60, -1.2, 0], [60, 1.2, 2.6])
    return world
