"""Readings of an IMU between two moments as one motion, with its derivatives by the biases and its covariance.

Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-manifold preintegration for real-time visual-inertial
odometry", sections V and VI; here rate and force are constant over each step, and that is integrated exactly.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.point_cluster import fill_cross

_TERMS = 16
"""Of each power series: exact to rounding for turns of up to half a radian in a step."""


class ImuSteps(NamedTuple):
    """Steps of constant rate and force. seconds: (M,) float64, s; rate: (M, 3), rad/s; force: (M, 3), m/s^2; own axes"""

    seconds: np.ndarray
    rate: np.ndarray
    force: np.ndarray


class ImuNoise(NamedTuple):
    """White noise as a density. gyroscope: rad/s/sqrt(Hz); accelerometer: m/s^2/sqrt(Hz)"""

    gyroscope: float
    accelerometer: float


class ImuMotions(NamedTuple):
    """Motions of K intervals, in the axes at their begins; errors are [rotation | velocity | position], rotation on the
    right.

    rotation: (K, 3, 3) float64; velocity: (K, 3), m/s, and position: (K, 3), m, without gravity and first velocity
    by_bias: (K, 9, 6), of the errors by the biases of gyroscope and accelerometer; covariance: (K, 9, 9)
    """

    rotation: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    by_bias: np.ndarray
    covariance: np.ndarray


@parallel_kernel
def preintegrate(steps: ImuSteps, starts: np.ndarray, bias: np.ndarray, noise: ImuNoise) -> ImuMotions:
    """The motion over the steps starts[k] to starts[k + 1] of each interval.

    starts: (K + 1,) int64; bias: (6,) float64, rad/s and m/s^2, taken off the readings
    """
    count = len(starts) - 1
    rotation, velocity, position = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    by_bias, covariance = np.zeros((count, 9, 6)), np.zeros((count, 9, 9))
    for k in prange(count):
        for axis in range(3):
            rotation[k, axis, axis] = 1.0
        for step in range(starts[k], starts[k + 1]):
            _take_step(
                steps.seconds[step], steps.rate[step], steps.force[step], bias, noise,
                rotation[k], velocity[k], position[k], by_bias[k], covariance[k],
            )  # fmt: skip
    return ImuMotions(
        rotation=rotation, velocity=velocity, position=position, by_bias=by_bias, covariance=covariance
    )


@kernel
def _take_step(
    seconds: float,
    rate: np.ndarray,
    force: np.ndarray,
    bias: np.ndarray,
    noise: ImuNoise,
    axes: np.ndarray,
    velocity: np.ndarray,
    position: np.ndarray,
    by_bias: np.ndarray,
    covariance: np.ndarray,
) -> None:
    """One step, in place: of the axes (3, 3) as they are turned since the start, and of the rest as in `ImuMotions`."""
    angle, felt = np.empty(3), np.empty(3)
    for axis in range(3):
        angle[axis] = (rate[axis] - bias[axis]) * seconds
        felt[axis] = force[axis] - bias[3 + axis]
    turn, once, twice, by_once, by_twice = _series(angle, felt)
    gained, moved = _times(once, felt), _times(twice, felt)
    carry, spread = _error_step(seconds, axes, (turn, once, twice), (by_once, by_twice), (gained, moved))
    _put(by_bias, 0, 0, 1.0, _product(carry, by_bias))
    _add(by_bias, -1.0, spread)
    _put(covariance, 0, 0, 1.0, _transformed(carry, covariance))
    gyroscope, accelerometer = noise.gyroscope**2 / seconds, noise.accelerometer**2 / seconds
    for row in range(9):
        for column in range(9):
            for axis in range(3):
                covariance[row, column] += gyroscope * spread[row, axis] * spread[column, axis]
                covariance[row, column] += accelerometer * spread[row, 3 + axis] * spread[column, 3 + axis]
    # the position continues by the velocity and the axes before the step, the velocity by these axes
    faster, farther = _times(axes, gained), _times(axes, moved)
    for axis in range(3):
        position[axis] += velocity[axis] * seconds + farther[axis] * seconds**2
        velocity[axis] += faster[axis] * seconds
    _put(axes, 0, 0, 1.0, _product(axes, turn))


@kernel
def _error_step(
    seconds: float,
    axes: np.ndarray,
    series: tuple[np.ndarray, np.ndarray, np.ndarray],
    by_angle: tuple[np.ndarray, np.ndarray],
    done: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """How errors propagate over a step, (9, 9), and what errors of rate and force add to them, (9, 6)."""
    turn, once, twice = series
    carry, spread = np.zeros((9, 9)), np.zeros((9, 6))
    _put(carry, 3, 0, -seconds, _product(axes, _hat(done[0])))
    _put(carry, 6, 0, -(seconds**2), _product(axes, _hat(done[1])))
    for row in range(3):
        carry[3 + row, 3 + row] = carry[6 + row, 6 + row] = 1.0
        carry[6 + row, 3 + row] = seconds
        for column in range(3):
            carry[row, column] = turn[column, row]
            # the right Jacobian is the transpose of the left one, `once`
            spread[row, column] = once[column, row] * seconds
    _put(spread, 3, 0, seconds**2, _product(axes, by_angle[0]))
    _put(spread, 6, 0, seconds**3, _product(axes, by_angle[1]))
    _put(spread, 3, 3, seconds, _product(axes, once))
    _put(spread, 6, 3, seconds**2, _product(axes, twice))
    return carry, spread


@kernel
def _series(
    angle: np.ndarray, felt: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """exp of a turn (3, 3); its integral over the step and the integral of that, as parts of the step; and how these two
    times `felt` change with the angle, (3, 3)."""
    turning, power = _hat(angle), np.zeros((3, 3))
    power[0, 0] = power[1, 1] = power[2, 2] = 1.0
    turn, once, twice = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    by_once, by_twice = np.zeros((3, 3)), np.zeros((3, 3))
    vector, by_vector = felt, np.zeros((3, 3))
    weight = 1.0
    for term in range(_TERMS):
        first, second = weight / (term + 1), weight / ((term + 1) * (term + 2))
        _add(turn, weight, power)
        _add(once, first, power)
        _add(twice, second, power)
        _add(by_once, first, by_vector)
        _add(by_twice, second, by_vector)
        by_vector = _product(turning, by_vector)
        _add(by_vector, -1.0, _hat(vector))
        vector = _times(turning, vector)
        power = _product(turning, power)
        weight /= term + 1
    return turn, once, twice, by_once, by_twice


@kernel
def _hat(vector: np.ndarray) -> np.ndarray:
    matrix = np.zeros((3, 3))
    fill_cross(vector, matrix)
    return matrix


# loops, and each for arrays of one type only: expressions of whole arrays took 20 s to compile


@kernel
def _add(out: np.ndarray, scale: float, matrix: np.ndarray) -> None:
    for row in range(matrix.shape[0]):
        for column in range(matrix.shape[1]):
            out[row, column] += scale * matrix[row, column]


@kernel
def _put(out: np.ndarray, top: int, left: int, scale: float, matrix: np.ndarray) -> None:
    """What is in `out` from (top, left) on becomes scale times the matrix."""
    for row in range(matrix.shape[0]):
        for column in range(matrix.shape[1]):
            out[top + row, left + column] = scale * matrix[row, column]


@kernel
def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    result = np.zeros(len(matrix))
    for row in range(len(matrix)):
        for column in range(len(vector)):
            result[row] += matrix[row, column] * vector[column]
    return result


@kernel
def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    result = np.zeros((one.shape[0], other.shape[1]))
    for row in range(one.shape[0]):
        for middle in range(one.shape[1]):
            value = one[row, middle]
            if value != 0.0:
                for column in range(other.shape[1]):
                    result[row, column] += value * other[middle, column]
    return result


@kernel
def _transformed(carry: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """C P C'."""
    half, result = _product(carry, covariance), np.zeros(covariance.shape)
    for row in range(half.shape[0]):
        for middle in range(half.shape[1]):
            value = half[row, middle]
            if value != 0.0:
                for column in range(len(carry)):
                    result[row, column] += value * carry[column, middle]
    return result
