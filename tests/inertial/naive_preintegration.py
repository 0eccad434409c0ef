"""Preintegration by its definition: the equations of motion integrated in many small steps (Runge-Kutta)."""

import numpy as np


def hat(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def preintegrate(seconds: np.ndarray, rate: np.ndarray, force: np.ndarray, parts: int = 100):
    """Rotation (3, 3), velocity (3,) and position (3,) after steps of constant rate and force, own axes."""
    state = np.hstack([np.eye(3), np.zeros((3, 2))])  # rotation | velocity | position
    for step, turning, felt in zip(seconds, rate, force, strict=True):

        def slope(at, turning=turning, felt=felt):
            rotation = at[:, :3]
            return np.column_stack([rotation @ hat(turning), rotation @ felt, at[:, 3]])

        h = step / parts
        for _ in range(parts):
            one = slope(state)
            two = slope(state + 0.5 * h * one)
            three = slope(state + 0.5 * h * two)
            state = state + h / 6 * (one + 2 * two + 2 * three + slope(state + h * three))
    return state[:, :3], state[:, 3], state[:, 4]
