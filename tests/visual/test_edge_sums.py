"""Kernels over the values of each edge against plain twins."""

import numpy as np
import pytest

from lvba.kernels import edge_sums
from lvba.visual import radiometry, response


@pytest.fixture
def values():
    """Values of seven edges, one of which has none, and of three blocks."""
    rng = np.random.default_rng(3)
    edge = rng.choice([0, 1, 2, 4, 5, 6], 300)
    edge[:6] = [0, 1, 2, 4, 5, 6]
    return edge, rng.integers(0, 3, 300), rng.normal(size=300), rng.uniform(0.1, 2.0, 300), rng


def test_medians_match_their_twin(values):
    edge, _, value, _, _ = values
    value[edge == 4] = 0.25
    twin = [np.median(value[edge == each]) if (edge == each).any() else 0.0 for each in range(7)]
    np.testing.assert_array_equal(edge_sums.medians(edge, value, 7), twin)
    assert len(edge_sums.medians(edge[:0], value[:0], 0)) == 0


def test_normal_sums_match_their_twin(values):
    edge, block, value, weight, rng = values
    by_numbers = rng.normal(size=(300, radiometry.NUMBERS))
    columns = np.column_stack([by_numbers, value])
    for each in np.unique(edge):
        mine = edge == each
        columns[mine] -= np.average(columns[mine], axis=0, weights=weight[mine])
    table = edge_sums.normal_sums(edge, block, value, weight, by_numbers, 7, 3)
    for each in range(3):
        mine = block == each
        twin = columns[mine].T @ (weight[mine, None] * columns[mine])
        np.testing.assert_allclose(table[each], twin[:-1], atol=1e-12)


def test_hat_integrals_match_their_twin():
    places = np.concatenate([response.KNOTS, np.linspace(response.KNOTS[0] - 1, response.KNOTS[-1] + 1, 9)])
    found = edge_sums.hat_integrals(places, response.KNOTS)
    for place, row in zip(places, found, strict=True):
        # the hats are linear between knots, so the rule of trapezes is exact from knot to knot
        inner = response.KNOTS[(response.KNOTS[0] < response.KNOTS) & (place > response.KNOTS)]
        steps = np.array([response.KNOTS[0], *inner, place])
        hats = np.array([np.interp(steps, response.KNOTS, one) for one in np.eye(response.SLOPES)])
        twin = (0.5 * (hats[:, 1:] + hats[:, :-1]) * np.diff(steps)).sum(axis=1)
        np.testing.assert_allclose(row, twin, atol=1e-14)
