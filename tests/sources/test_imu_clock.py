"""An IMU whose axes, units or clock are not what is said: by when and how poses turn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.sources.importing import imu_clock
from lvba.sources.importing.imu_clock import ImuRead
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track

IMU_FROM_LIDAR = geometry.exp(np.array([0.4, -1.1, 2.0, 0.1, 0.0, 0.0]))
OFFSETS = {"+0": 0.0, "+0.1": 0.1, "-0.1": -0.1}


def world_from_imu(times: np.ndarray) -> np.ndarray:
    """A hand that looks around and moves."""
    angles = 0.4 * np.sin(times[:, None] * [0.9, 1.7, 1.3] + np.arange(3))
    positions = 0.4 * np.sin(times[:, None] * [1.6, 2.1, 2.9] + np.arange(3))
    return geometry.from_rotation_translation(Rotation.from_euler("ZYX", angles).as_matrix(), positions)


@pytest.fixture(scope="module")
def poses() -> Track:
    """Of the LiDAR, with the noise of an odometry."""
    rng, times = np.random.default_rng(0), np.arange(0.5, 12.0, 0.1)
    noise = rng.normal(size=(len(times), 6)) * np.repeat([np.radians(0.03), 0.003], 3)
    return Track(times, world_from_imu(times) @ IMU_FROM_LIDAR @ geometry.exp(noise))


@pytest.fixture(scope="module")
def imu() -> ImuReadings:
    """As it should be, with noise and a bias."""
    rng, times, step = np.random.default_rng(1), np.arange(0.0, 12.5, 5e-3), 1e-4
    turned = geometry.log(geometry.inverse(world_from_imu(times - step)) @ world_from_imu(times + step))
    rates = turned[:, :3] / (2 * step) + 5e-3 + rng.normal(0, 2e-3, (len(times), 3))
    before, at, after = (world_from_imu(times + late) for late in (-1e-3, 0.0, 1e-3))
    accelerations = (before - 2 * at + after)[:, :3, 3] / 1e-3**2 + [0, 0, 9.81]
    forces = np.einsum("nji,nj->ni", at[:, :3, :3], accelerations)
    return ImuReadings(times, rates, forces)


def found(poses: Track, imu: ImuReadings, extrinsic: np.ndarray = IMU_FROM_LIDAR) -> ImuRead:
    return imu_clock.find(poses, imu, extrinsic, OFFSETS, {}, "source")


def turned_by(degrees: float) -> np.ndarray:
    return np.asarray(geometry.exp(np.radians([0.0, degrees, 0.0, 0.0, 0.0, 0.0])))


def test_an_imu_that_is_what_is_said_is_no_warning(poses: Track, imu: ImuReadings) -> None:
    assert found(poses, imu).warnings == ()
    # what the bundle adjustment finds by itself
    assert found(poses, imu, turned_by(1.0) @ IMU_FROM_LIDAR).warnings == ()
    assert found(poses, replace(imu, times=imu.times + 0.02)).warnings == ()
    assert found(poses, replace(imu, forces=imu.forces / 9.81)).warnings == ()


@pytest.mark.parametrize("order", [[1, 2, 0], [0, 1, 2]])
def test_other_axes_are_a_warning_with_how_far_they_are_turned(
    poses: Track, imu: ImuReadings, order: list[int]
) -> None:
    signs = [1, -1, -1] if order == [0, 1, 2] else [1, 1, 1]
    [words] = found(poses, replace(imu, rates=imu.rates[:, order] * signs)).warnings
    degrees = int(words.split("rotated by ")[1].split()[0])
    assert abs(degrees - (180 if order == [0, 1, 2] else 120)) < 5


def test_an_extrinsic_the_wrong_way_round_is_a_warning(poses: Track, imu: ImuReadings) -> None:
    [words] = found(poses, imu, geometry.inverse(IMU_FROM_LIDAR)).warnings
    assert "axes are rotated by" in words
    [words] = found(poses, imu, turned_by(6.0) @ IMU_FROM_LIDAR).warnings
    assert "axes are rotated by 6 degrees" in words


def test_units_are_checked(poses: Track, imu: ImuReadings) -> None:
    [words] = found(poses, replace(imu, rates=np.degrees(imu.rates))).warnings
    assert "57 times as fast as the poses, as one that counts degrees would" in words
    [words] = found(poses, replace(imu, forces=1000 * imu.forces / 9.81)).warnings
    assert "is neither 9.81 m/s^2 nor 1 g" in words


@pytest.mark.parametrize("late", [0.25, -0.65])
def test_a_clock_that_no_convention_explains_is_measured(poses: Track, imu: ImuReadings, late: float) -> None:
    read = found(poses, replace(imu, times=imu.times + late))
    assert read.offset == pytest.approx(-late, abs=5e-3)
    [words] = read.warnings
    assert "after its stamps: applied" in words


@pytest.mark.parametrize(("turned", "taken"), [(0.01, False), (0.2, True)])
def test_where_poses_hardly_turn_their_noise_is_no_clock(turned: float, taken: bool) -> None:
    """Poses that err by turns of their own, as an odometry's do, seem to be late."""
    times, at = np.arange(0.0, 12.5, 5e-3), np.arange(0.5, 12.0, 0.1)

    def angles(when: np.ndarray) -> np.ndarray:
        return turned * np.sin(when[:, None] * [0.9, 1.7, 1.3] + np.arange(3))

    turns = Rotation.from_rotvec(angles(times - 5e-3)).inv() * Rotation.from_rotvec(angles(times + 5e-3))
    forces = Rotation.from_rotvec(angles(times)).inv().apply([0.0, 0.0, 9.81])
    imu = ImuReadings(times, turns.as_rotvec() / 0.01, forces)
    rough = geometry.from_rotation_translation(
        Rotation.from_rotvec(angles(at - 0.04)).as_matrix(), np.stack([at, 0 * at, 0 * at], axis=1)
    )
    read = found(Track(at, rough), imu, np.eye(4))
    assert (read.offset != 0.0) == taken
    assert any("after its stamps: applied" in words for words in read.warnings) == taken


def test_a_clock_of_another_epoch_is_a_warning(poses: Track, imu: ImuReadings) -> None:
    [words] = found(poses, replace(imu, times=imu.times + 3600.0)).warnings
    assert "its clock is another one" in words
