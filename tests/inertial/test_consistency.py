"""An IMU beside scans of a room of which some see one wall: what it adds, and that a wrong one is not used."""

from dataclasses import replace

import numpy as np
import pytest
from felt_motion import DOWNWARD, measured

from lvba import geometry, trajectory
from lvba.inertial import consistency
from lvba.inertial.factor import DOWN, OFFSET, factor
from lvba.inertial.readings import Imu, ImuReadings
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import Stage

BLIND = (3, 4)
"""Scans that see one wall only."""
NOISE = np.sqrt(400.0) * np.array([1.5e-4, 1.5e-3])


STAGES = (Stage(sizes=(0.5, 1.0, 2.0, 4.0), rounds=12),)


def refine(scans, rough, imu=None):
    return bundle_adjustment.refine(scans, rough, imu=imu, stages=STAGES)


def scan(pose: np.ndarray, walls, rng) -> np.ndarray:
    """Points (N, 3) float32 on walls (axis, side) of a room of 12 x 12 x 12 m, scan frame."""
    points = []
    for axis, side in walls:
        across = rng.uniform(-6, 6, (250, 2))
        points.append(np.insert(across, axis, 6.0 * side, axis=1))
    points = np.concatenate(points) + rng.normal(0, 0.01, (250 * len(walls), 3))
    return geometry.transform_points(geometry.inverse(pose), points).astype(np.float32)


@pytest.fixture(scope="module")
def room():
    readings, times, truth = measured(bias=(0.01, -0.005, 0.002, 0.05, 0.1, -0.1), noise=NOISE)
    rng = np.random.default_rng(0)
    every = [(axis, side) for axis in range(3) for side in (-1, 1)]
    scans = [scan(pose, every[:1] if k in BLIND else every, rng) for k, pose in enumerate(truth)]
    off = np.concatenate(
        [np.zeros((1, 6)), rng.normal(0, 1, (len(truth) - 1, 6)) * np.repeat([0.003, 0.03], 3)]
    )
    rough = truth @ geometry.exp(np.cumsum(off, axis=0))
    return scans, truth, rough, readings, times, refine(scans, rough)


@pytest.fixture(scope="module")
def found(room):
    scans, _, rough, readings, times, _ = room
    return refine(scans, rough, imu=Imu(readings, times))


def furthest(result, truth) -> float:
    """m, of the scans before one wall, where all others lie on the truth."""
    others = np.delete(np.arange(len(truth)), BLIND)
    moved = trajectory.align(result.world_from_scan[others], truth[others]) @ result.world_from_scan
    return float(np.linalg.norm(moved[list(BLIND), :3, 3] - truth[list(BLIND), :3, 3], axis=1).max())


def test_scans_before_one_wall_are_held(room, found):
    _, truth, _, _, _, without = room
    assert found.inertial.used
    assert (without.degenerate_scans[list(BLIND)] > 0).all()
    assert furthest(without, truth) > 0.02
    assert furthest(found, truth) < 0.006
    error = geometry.log(
        geometry.inverse(truth) @ (trajectory.align(found.world_from_scan, truth) @ found.world_from_scan)
    )
    nees = np.einsum("si,sij,sj->s", error, np.linalg.inv(found.covariance + 1e-12 * np.eye(6)), error) / 6
    assert 0.2 < nees.mean() < 3.0


def test_down_is_found_with_its_uncertainty(room, found):
    truth = room[1]
    turn = trajectory.align_for_errors(found.world_from_scan, truth).reference_from_estimate[:3, :3]
    down = turn @ found.inertial.shared[DOWN] / 9.81
    angle = np.linalg.norm(np.cross(down, DOWNWARD / 9.81))
    assert angle < 3 * np.sqrt(2) * found.inertial.tilt_sigma
    assert found.inertial.tilt_sigma < np.radians(0.5)
    facts = found.inertial.facts()
    assert facts["tilt_deg"] == pytest.approx(np.degrees(np.arccos(-facts["down"][2])))


def turned(readings: ImuReadings, matrix) -> ImuReadings:
    return replace(
        readings, rates=readings.rates @ np.transpose(matrix), forces=readings.forces @ np.transpose(matrix)
    )


MOUNT = geometry.exp(np.array([0.3, -0.6, 0.9, 0.0, 0.0, 0.0]))
WRONG = {
    "axes swapped": lambda readings: turned(readings, [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "axes in a circle": lambda readings: turned(readings, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "50 ms late": lambda readings: replace(readings, times=readings.times + 0.05),
    "50 ms early": lambda readings: replace(readings, times=readings.times - 0.05),
    "degrees a second": lambda readings: replace(readings, rates=np.degrees(readings.rates)),
    "rates the other way": lambda readings: replace(readings, rates=-readings.rates),
    "forces the other way": lambda readings: replace(readings, forces=-readings.forces),
    "forces in another unit": lambda readings: replace(readings, forces=100.0 * readings.forces),
    "turned by 20 degrees": lambda readings: turned(
        readings, geometry.exp(np.array([0, 0, 0.35, 0, 0, 0]))[:3, :3]
    ),
    "of another time": lambda readings: replace(readings, times=readings.times + 1e4),
}


@pytest.mark.parametrize("how", WRONG)
def test_a_wrong_imu_is_not_used_and_changes_nothing(room, how):
    scans, _, rough, readings, times, without = room
    found = refine(scans, rough, imu=Imu(WRONG[how](readings), times))
    assert not found.inertial.used
    assert found.inertial.problem
    assert any(found.inertial.problem in warning for warning in found.warnings)
    assert found.world_from_scan.tobytes() == without.world_from_scan.tobytes()
    assert found.covariance.tobytes() == without.covariance.tobytes()
    assert len(found.history) == len(without.history)


def test_an_extrinsic_the_wrong_way_round_is_not_used(room):
    scans, _, rough, readings, times, _ = room
    mounted = turned(readings, MOUNT[:3, :3].T)
    assert refine(scans, rough, imu=Imu(mounted, times, MOUNT)).inertial.used
    assert not refine(scans, rough, imu=Imu(mounted, times, geometry.inverse(MOUNT))).inertial.used


def test_what_can_be_mended_is(room):
    scans, truth, rough, readings, times, _ = room
    in_g = refine(scans, rough, imu=Imu(replace(readings, forces=readings.forces / 9.81), times))
    late = refine(scans, rough, imu=Imu(replace(readings, times=readings.times + 0.015), times))
    assert furthest(in_g, truth) < 0.006
    assert furthest(late, truth) < 0.006
    assert late.inertial.shared[OFFSET] == pytest.approx(0.015, abs=2e-3)


def test_a_worse_imu_counts_less(room):
    _, truth, _, readings, times, _ = room

    def judged(noise: float):
        rng = np.random.default_rng(1)
        shaken = replace(readings, forces=readings.forces + rng.normal(0, noise, readings.forces.shape))
        return consistency.after(consistency.Judged(factor(shaken, times, truth)), truth)

    assert (judged(0.0).rotation, judged(0.0).force) == (1.0, 1.0)
    worse = judged(0.4)
    assert 1.5 < worse.force < 4.0
    assert worse.factor.solve(truth).squares[:, 1:].mean() / 3 < 1.1
    assert judged(1.2).factor is None


def test_many_scans_are_solved_without(room, monkeypatch):
    scans, _, rough, readings, times, without = room
    monkeypatch.setattr(consistency, "MOST_SCANS", len(scans) - 1)
    found = refine(scans, rough, imu=Imu(readings, times))
    assert "more than" in found.inertial.problem
    assert found.world_from_scan.tobytes() == without.world_from_scan.tobytes()
