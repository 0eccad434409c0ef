"""An accelerometer or a gyroscope of another convention, on recordings that turn, and on some that hardly do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.errors import InputError
from lvba.sources.importing import imu_axes, imu_clock
from lvba.sources.importing.imu_clock import ImuRead
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track

IMU_FROM_LIDAR = geometry.exp(np.array([0.4, -1.1, 2.0, 0.1, -0.05, 0.2]))
OFFSETS = {"+0": 0.0, "+0.1": 0.1, "-0.1": -0.1}
TURNING, SWAYING, DRIVING = "turning", "swaying", "driving"
HALF, QUARTER = (Rotation.from_euler("x", degrees, degrees=True).as_matrix() for degrees in (180, 90))


def world_from_imu(motion: str, times: np.ndarray) -> np.ndarray:
    """A hand that looks around; one that is moved but hardly turns; a straight drive at constant speed."""
    turn = {TURNING: 0.4, SWAYING: 0.002, DRIVING: 0.0}[motion]
    angles = turn * np.sin(times[:, None] * [0.9, 1.7, 1.3] + np.arange(3)) + [0.3, -0.2, 0.1]
    if motion == DRIVING:
        positions = times[:, None] * [8.0, 0.5, 0.0]
    else:
        positions = [0.5, 0.4, 0.2] * np.sin(times[:, None] * [1.6, 2.1, 2.9] + np.arange(3))
    return geometry.from_rotation_translation(Rotation.from_euler("ZYX", angles).as_matrix(), positions)


def poses(motion: str, seed: int = 0) -> Track:
    """Of the LiDAR, with the noise of an odometry, in a world whose axes are not upright."""
    rng, times = np.random.default_rng(seed), np.arange(0.5, 16.0, 0.1)
    noise = rng.normal(size=(len(times), 6)) * np.repeat([np.radians(0.03), 0.004], 3)
    world = geometry.exp(np.array([0.7, -0.4, 1.0, 3.0, 2.0, 1.0]))
    return Track(times, world @ world_from_imu(motion, times) @ IMU_FROM_LIDAR @ geometry.exp(noise))


def readings(motion: str, seed: int = 1) -> ImuReadings:
    """As they should be, with noise and biases."""
    rng, times, step = np.random.default_rng(seed), np.arange(0.0, 16.5, 5e-3), 1e-3
    before, at, after = (world_from_imu(motion, times + late) for late in (-step, 0.0, step))
    rates = geometry.log(geometry.inverse(before) @ after)[:, :3] / (2 * step)
    accelerations = (before - 2 * at + after)[:, :3, 3] / step**2 + [0, 0, 9.81]
    forces = np.einsum("nji,nj->ni", at[:, :3, :3], accelerations)
    return ImuReadings(
        times,
        rates + 5e-3 + rng.normal(0, 2e-3, rates.shape),
        forces + np.array([0.04, -0.03, 0.05]) + rng.normal(0, 0.05, forces.shape),
    )


def found(motion: str, imu: ImuReadings, seed: int = 0, **said: str) -> ImuRead:
    return imu_clock.find(poses(motion, seed), imu, IMU_FROM_LIDAR, OFFSETS, said, "source")


def turned(imu: ImuReadings, rotation: np.ndarray) -> ImuReadings:
    return replace(imu, rates=imu.rates @ rotation.T, forces=imu.forces @ rotation.T)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("motion", [TURNING, SWAYING])
def test_an_imu_that_is_what_is_said_is_no_warning(motion: str, seed: int) -> None:
    imu = readings(motion, seed + 10)
    for given in (imu, replace(imu, forces=imu.forces / 9.81)):
        read = found(motion, given, seed)
        assert read.warnings == ()
        assert (read.rates, read.forces, read.left_out) == (1.0, 1.0, False)


@pytest.mark.parametrize("motion", [TURNING, SWAYING])
@pytest.mark.parametrize("unit", [1.0, 9.81])
def test_an_accelerometer_with_the_sign_of_gravity_is_turned_over(motion: str, unit: float) -> None:
    right = readings(motion)
    read = found(motion, replace(right, forces=-right.forces / unit))
    assert read.forces == -1.0
    [words] = read.warnings
    assert "reads gravity instead of specific force" in words
    assert next(each for each in read.decisions if each.question == "accelerometer").by == "data"
    mended = read.mended(replace(right, forces=-right.forces))
    assert mended is not None
    np.testing.assert_array_equal(mended.forces, right.forces)


@pytest.mark.parametrize("motion", [TURNING, SWAYING])
@pytest.mark.parametrize("rotation", [QUARTER, HALF, Rotation.from_euler("z", 90, degrees=True).as_matrix()])
def test_an_imu_that_is_turned_against_what_is_said_is_left_out(motion: str, rotation: np.ndarray) -> None:
    read = found(motion, turned(readings(motion), rotation))
    assert read.left_out
    [words] = read.warnings
    degrees = round(float(np.degrees(Rotation.from_matrix(rotation).magnitude())))
    assert f"accelerometer's axes are rotated by {degrees} degrees" in words
    assert "it is left out" in words
    assert read.mended(readings(motion)) is None


def test_a_gyroscope_with_other_axes_than_its_accelerometer_is_left_out() -> None:
    right = readings(TURNING)
    read = found(TURNING, replace(right, rates=right.rates @ HALF.T))
    assert read.left_out
    assert "its gyroscope's axes are rotated by 1" in read.warnings[0]


def test_an_extrinsic_that_is_not_along_axes_is_left_out() -> None:
    read = imu_clock.find(
        poses(TURNING), readings(TURNING), geometry.inverse(IMU_FROM_LIDAR), OFFSETS, {}, "source"
    )
    assert read.left_out
    assert "accelerometer's axes differ from the given extrinsic" in read.warnings[0]


@pytest.mark.parametrize("rotation", [HALF, QUARTER])
def test_an_accelerometer_with_other_axes_than_its_gyroscope_is_left_out(rotation: np.ndarray) -> None:
    right = readings(TURNING)
    read = found(TURNING, replace(right, forces=right.forces @ rotation.T))
    assert read.left_out
    assert "accelerometer's axes" in read.warnings[0]


def test_a_gyroscope_that_counts_degrees_is_read_in_radians() -> None:
    right = readings(TURNING)
    read = found(TURNING, replace(right, rates=np.degrees(right.rates)))
    assert read.rates == pytest.approx(np.radians(1.0))
    [words] = read.warnings
    assert "taken for degrees per second" in words
    mended = read.mended(replace(right, rates=np.degrees(right.rates)))
    assert mended is not None
    np.testing.assert_allclose(mended.rates, right.rates)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("rotation", [np.eye(3), QUARTER, HALF])
def test_what_poses_that_neither_turn_nor_accelerate_leave_open_is_a_warning(
    sign: float, rotation: np.ndarray
) -> None:
    imu = turned(readings(DRIVING), rotation)
    read = found(DRIVING, replace(imu, forces=sign * imu.forces))
    assert not read.left_out
    assert read.forces == 1.0
    assert any("the data cannot tell up from down" in words for words in read.warnings)
    for sensor in ("gyroscope", "accelerometer"):
        open_ = f"axes of its {sensor} cannot be checked"
        assert any(open_ in words and "--calibration" in words for words in read.warnings)


def test_a_sign_that_an_option_gives_is_taken_but_not_against_the_data() -> None:
    right = readings(DRIVING)
    read = found(DRIVING, replace(right, forces=-right.forces), accelerometer="down")
    assert read.forces == -1.0
    assert not any("up from down" in words for words in read.warnings)
    with pytest.raises(InputError, match="accelerometer=down contradicts the data"):
        found(TURNING, readings(TURNING), accelerometer="down")


def test_all_orientations_of_an_imu_along_axes_are_tried() -> None:
    assert len(imu_axes.ROTATIONS) == 24
    np.testing.assert_array_equal(imu_axes.ROTATIONS[0], np.eye(3))
    assert len({rotation.tobytes() for rotation in imu_axes.ROTATIONS + 0.0}) == 24
