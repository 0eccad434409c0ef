"""What an IMU felt between two moments, as one motion: against integration of its definition, and differences."""

import naive_preintegration
import numpy as np
import pytest

from lvba import geometry
from lvba.inertial import preintegration
from lvba.inertial.preintegration import covariance, preintegrate
from lvba.inertial.readings import ImuReadings, in_si_units, ordered
from lvba.kernels import preintegration as kernel
from lvba.kernels.preintegration import ImuNoise, ImuSteps

NOISE = ImuNoise(gyroscope=1e-3, accelerometer=2e-2)
NONE = np.zeros(6)


def shaken(count: int = 30, seed: int = 0) -> ImuSteps:
    """Steps of 2 to 8 ms, as of a sensor that is turned and shaken hard."""
    rng = np.random.default_rng(seed)
    return ImuSteps(
        rng.uniform(2e-3, 8e-3, count), rng.normal(0, 3.0, (count, 3)), rng.normal(0, 8.0, (count, 3))
    )


def motion(steps: ImuSteps, bias: np.ndarray = NONE):
    return kernel.preintegrate(steps, np.array([0, len(steps.seconds)]), bias, NOISE)


def error(true, other) -> np.ndarray:
    """(9,) of the first motions: [rotation | velocity | position]."""
    turn = np.eye(4)
    turn[:3, :3] = true.rotation[0].T @ other.rotation[0]
    return np.concatenate(
        [
            geometry.log(turn)[:3],
            other.velocity[0] - true.velocity[0],
            other.position[0] - true.position[0],
        ]
    )


def differences(change, size: int, step: float) -> np.ndarray:
    columns = []
    for axis in range(size):
        off = np.zeros(size)
        off[axis] = step
        columns.append(
            (error(motion(shaken()), change(off)) - error(motion(shaken()), change(-off))) / (2 * step)
        )
    return np.stack(columns, axis=1)


def test_motions_are_those_of_fine_integration():
    steps = shaken()
    rotation, velocity, position = naive_preintegration.preintegrate(*steps)
    found = motion(steps)
    assert np.abs(found.rotation[0] - rotation).max() < 1e-9
    assert np.abs(found.velocity[0] - velocity).max() < 1e-9
    assert np.abs(found.position[0] - position).max() < 1e-9


def test_biases_are_taken_off():
    bias = np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2])
    steps = shaken()
    true = naive_preintegration.preintegrate(steps.seconds, steps.rate - bias[:3], steps.force - bias[3:])
    assert np.abs(motion(steps, bias).position[0] - true[2]).max() < 1e-9


def test_jacobians_by_biases_are_those_of_differences():
    numeric = differences(lambda off: motion(shaken(), off), 6, 1e-5)
    analytic = motion(shaken()).by_bias[0]
    assert np.abs(analytic - numeric).max() < 1e-8 * max(1.0, np.abs(numeric).max())


def test_covariance_is_the_sum_over_the_noise_of_all_readings():
    steps, total = shaken(), np.zeros((9, 9))
    for index, seconds in enumerate(steps.seconds):
        for values, density in ((1, NOISE.gyroscope), (2, NOISE.accelerometer)):

            def moved(off, index=index, values=values):
                changed = [part.copy() for part in steps]
                changed[values][index] += off
                return motion(ImuSteps(*changed))

            by_noise = differences(moved, 3, 1e-4)
            total += by_noise @ by_noise.T * density**2 / seconds
    assert motion(steps).covariance[0] == pytest.approx(total, rel=1e-5, abs=1e-12)


def test_intervals_are_the_same_alone_and_together():
    steps = shaken()
    together = kernel.preintegrate(steps, np.array([0, 11, 11, 30]), NONE, NOISE)
    alone = kernel.preintegrate(ImuSteps(*(part[11:] for part in steps)), np.array([0, 19]), NONE, NOISE)
    assert all((one[2] == other[0]).all() for one, other in zip(together, alone, strict=True))
    assert (together.rotation[1] == np.eye(3)).all()


def steady(rate_hz: float = 100.0, seconds: float = 2.0) -> ImuReadings:
    times = np.arange(0, seconds, 1 / rate_hz)
    return ImuReadings(
        times, np.tile([0.0, 0.0, 0.5], (len(times), 1)), np.tile([0.2, 0.0, 9.81], (len(times), 1))
    )


def test_moments_between_readings_are_met_exactly():
    times = np.array([0.1234, 0.4321, 1.777])
    found = preintegrate(steady(), times, NONE)
    assert list(found.first) == [0, 1]
    assert found.seconds == pytest.approx(np.diff(times), abs=1e-12)
    true = naive_preintegration.preintegrate(np.diff(times)[1:], [[0.0, 0.0, 0.5]], [[0.2, 0.0, 9.81]])
    assert np.abs(found.motions.position[1] - true[2]).max() < 1e-9


def test_intervals_without_readings_are_left_out():
    readings = steady()
    gap = (readings.times < 0.6) | (readings.times > 0.7)
    cut = ImuReadings(readings.times[gap], readings.rates[gap], readings.forces[gap])
    times = np.array([-0.2, 0.1, 0.5, 0.62, 0.68, 0.9, 1.2, 2.5])
    assert list(preintegrate(cut, times, NONE).first) == [1, 5]
    assert (
        len(
            preintegrate(ImuReadings(*(part[:1] for part in (cut.times, cut.rates, cut.forces))), times, NONE)
        )
        == 0
    )


def test_what_is_not_noise_grows_with_time_and_turn():
    found = preintegrate(steady(), np.array([0.0, 0.2, 1.7]), NONE)
    beyond = covariance(found) - found.motions.covariance
    turned = 0.5 * found.seconds
    assert np.sqrt(beyond[:, 0, 0]) == pytest.approx(preintegration._SCALE * turned)
    assert np.sqrt(beyond[:, 8, 8]) == pytest.approx(0.5 * preintegration._SLOW_FORCE * found.seconds**2)
    assert (np.linalg.eigvalsh(covariance(found)) > 0).all()


def test_readings_are_put_in_order_and_units():
    times = np.array([0.3, 0.1, 0.2, 0.1, np.nan, 0.4])
    forces = np.tile([0.0, 0.0, 1.0], (6, 1))
    forces[5, 0] = np.inf
    found = ordered(times, np.arange(18.0).reshape(6, 3), forces)
    assert list(found.times) == [0.1, 0.2, 0.3]
    assert list(found.rates[:, 0]) == [3.0, 6.0, 0.0]
    assert in_si_units(found).forces[:, 2] == pytest.approx(9.81)
    assert in_si_units(in_si_units(found)).forces[:, 2] == pytest.approx(9.81)
    assert in_si_units(ImuReadings(found.times, found.rates, 3.0 * found.forces)) is None
