"""Planes beside each other, which contradict what is estimated in the same way where a model has faults."""

import numpy as np

from lvba.arrays import Indices, Vectors


def neighborhoods(center: Vectors, halvings: int) -> Indices:
    """(P,) int64: in which of 2 ** halvings neighborhoods, of as many planes each, each of P planes is; fewer of few.

    center: (P, 3) float64, m
    The planes are halved along their longest side, then each half, and so on.
    """
    number = np.zeros(len(center), np.int64)
    parts: list[Indices] = [np.arange(len(center))]
    for _ in range(halvings):
        parts = [half for part in parts for half in _halves(center, part)]
    for index, part in enumerate(parts):
        number[part] = index
    return number


def _halves(center: Vectors, part: Indices) -> list[Indices]:
    """The planes on either side of the middle of their longest side; those that are too few stay together."""
    if len(part) < 2:
        return [part]
    own = center[part]
    order = np.argsort(own[:, np.argmax(np.ptp(own, axis=0))], kind="stable")
    middle = len(part) // 2
    return [part[order[:middle]], part[order[middle:]]]
