"""What is said of the memory of a run against the arrays that it makes."""

from itertools import combinations_with_replacement

import numpy as np
import pytest

from lvba.blocks import lidar_joint, memory, split
from lvba.blocks.split import Load, Part
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.kernels.lidar import TILE
from lvba.optim import linear_solver, two_level
from lvba.optim.normal_equations import NormalEquations
from lvba.trajectory import Trajectory
from lvba.visual.keyframes import KeyframeConfig


def poses_at(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return poses


def street(scans, spacing=2.0):
    return poses_at(np.outer(np.arange(scans), [spacing, 0.0, 0.0]))


def site(scans):
    return poses_at(np.random.default_rng(0).uniform(0, 30, (scans, 3)))


def equations(poses, reach):
    """Of all pairs of scans within twice the reach, of which each is held by itself."""
    position = poses[:, :3, 3]
    pairs = [
        (a, b)
        for a, b in combinations_with_replacement(range(len(poses)), 2)
        if np.linalg.norm(position[a] - position[b]) <= 2 * reach
    ]
    rows, columns = np.array(pairs, np.int32).T
    blocks = np.where((rows == columns)[:, None, None], 1e3 * np.eye(6), 0.1 * np.ones((6, 6)))
    return NormalEquations(
        rows=rows, columns=columns, blocks=blocks, gradient=np.zeros((len(poses), 6)), cost=0.0
    )


@pytest.mark.parametrize(("poses", "reach", "within"), [(site(100), 50.0, 1.25), (street(600), 30.0, 1.6)])
def test_a_joint_round_of_all_pairs_takes_what_is_said(poses, reach, within):
    """Of a street a band is said as wide as it may become, and its order is not known before."""
    whole = equations(poses, reach)
    factors = linear_solver.factorize(whole, 1e-9).poses
    held = max(3 * whole.blocks.nbytes, 2 * whole.blocks.nbytes + factors.lower.nbytes)
    assert held <= memory.joint_bytes(poses, reach) <= within * held


def test_a_joint_round_at_two_levels_takes_what_is_said(monkeypatch):
    poses, reach = site(20 * TILE), 50.0
    every = memory.joint_bytes(poses, reach)
    monkeypatch.setattr(lidar_joint, "MOST_PAIRS", 1000)
    both = two_level.split(equations(poses, reach), two_level.groups_of(poses, TILE))
    factors = two_level.factorize(both, 1e-9)
    blocks = both.inner.blocks.nbytes + both.bodies.blocks.nbytes
    made = factors.bodies.poses.lower.nbytes + sum(each.nbytes for each in factors.within)
    held = max(3 * blocks, 2 * blocks + made)
    assert held <= memory.joint_bytes(poses, reach) <= 1.25 * held
    assert memory.joint_bytes(poses, reach) < 0.2 * every


def test_memory_grows_no_faster_than_the_scans():
    first, last = (memory.joint_bytes(site(scans), 50.0) for scans in (7_200, 14_400))
    assert last < 2.1 * first
    assert last < 0.5e9
    assert memory.joint_bytes(street(2_000), 30.0) == pytest.approx(
        memory.joint_bytes(street(1_000), 30.0) * 2, rel=0.1
    )


@pytest.mark.parametrize(("places", "within"), [(street(500), 1.1), (site(500), 1.05), (site(100), 1.05)])
def test_a_joint_round_of_cameras_takes_what_is_said(places, within):
    """Of keyframes that are tied as far away as they may be: all pairs within 16 m of each other."""
    few = equations(places, 8.0)
    tied = NormalEquations(
        rows=few.rows,
        columns=few.columns,
        blocks=np.where((few.rows == few.columns)[:, None, None], 1e3 * np.eye(7), 0.1 * np.ones((7, 7))),
        gradient=np.zeros((len(places), 7)),
        cost=0.0,
    )
    factor = linear_solver.factorize(tied, 1e-9).poses
    held = 3 * tied.blocks.nbytes + factor.lower.nbytes
    assert held <= memory.camera_bytes(places) <= within * held


def test_a_joint_round_of_cameras_grows_with_a_street_and_faster_in_a_site():
    def ratio(place):
        return memory.camera_bytes(place(2_000)) / memory.camera_bytes(place(1_000))

    assert ratio(street) == pytest.approx(2.0, rel=0.05)
    assert 3.5 < ratio(site) < 4.5
    assert memory.camera_bytes(site(0)) == 0.0


def recording(scans, load, size=10):
    """So many scans of a site, each with an image, in parts without overlap: dataset, parts, load and settings."""
    path = Trajectory(np.arange(float(scans)), site(scans))
    names = tuple(map(str, range(scans)))
    camera = RigCamera(Camera(640, 480, 500, 500, 320, 240), np.eye(4))
    dataset = Dataset("site", names, path, names, path, (camera,))
    bounds = [(begin, begin + size) for begin in range(0, scans, size)]
    parts = [Part(n, each, each, each, each) for n, each in enumerate(bounds)]
    return dataset, parts, load, KeyframeConfig()


def test_the_largest_of_part_region_and_joint_rounds_counts():
    load = Load(3_000, 640 * 480, 50.0)
    dataset, parts, *rest = recording(600, load)
    found = memory.peaks(dataset, parts, *rest)
    # a part is looked at with half as many frames that others took at the same place
    assert found.part == split.visual_bytes(load, 15, 15) > split.memory_bytes(load, 10, 10)
    assert found.region == split.BASE_BYTES + split.BYTES_PER_POINT * 3_000 * 40
    assert found.joint == split.BASE_BYTES + memory.joint_bytes(dataset.scans.world_from_sensor, 50.0)
    assert found.cameras == split.BASE_BYTES + memory.camera_bytes(dataset.images.world_from_sensor)
    assert found.largest == found.cameras > found.joint
    whole = (0, 600)
    alone = memory.peaks(dataset, [Part(0, whole, whole, whole, whole)], *rest)
    assert (alone.largest, alone.region) == (split.memory_bytes(load, 600, 600), 0.0)
    assert (alone.joint, alone.cameras) == (0.0, 0.0)
