"""A response curve that is not used because it is too little, and what exposures are promised beside it."""

from dataclasses import replace

import numpy as np

from lvba.visual import exposure_graph, radiometry, response
from lvba.visual.exposure_graph import BLOCKS


def test_a_response_that_is_too_little_to_be_used_is_in_the_standard_deviations():
    """Exposures are off by what a curve below the limit does to them, but for a power of all of them, which is open."""
    rng, images = np.random.default_rng(4), 12
    true = rng.uniform(-0.6, 0.6, images)
    first, second = np.array([(i, j) for i in range(images) for j in range(i + 1, images) if j - i < 4]).T
    slopes = np.linspace(-0.04, 0.04, response.SLOPES)
    by_numbers = np.zeros((len(first), radiometry.NUMBERS))
    light = true[second] - true[first]
    level = np.log(110) + (true[first] + true[second]) / 2
    by_numbers[:, -response.SLOPES :] = response.by_slopes(response.LINEAR, level, light)
    information = np.zeros((BLOCKS, radiometry.NUMBERS, radiometry.NUMBERS))
    information[:, -response.SLOPES :, -response.SLOPES :] = 1e6 * np.eye(response.SLOPES)
    gradient = np.zeros((BLOCKS, radiometry.NUMBERS))
    gradient[:, -response.SLOPES :] = 1e6 * slopes
    known = radiometry.RadiometrySums(information, gradient)
    edges = exposure_graph.Edges(
        first=first,
        second=second,
        mean=light + by_numbers[:, -response.SLOPES :] @ slopes,
        sigma=np.full(len(first), 5e-4),
        weight_fraction=np.full((len(first), 2 * BLOCKS), 1 / BLOCKS),
        pull=np.zeros((len(first), 2 * BLOCKS)),
        sharing=np.zeros((0, 2), np.int64),
        correlation=np.zeros(0),
        pairs=len(first),
        spread=0.01,
        radiometry=radiometry.NONE,
        by_radiometry=by_numbers,
        known=known,
    )
    held = exposure_graph.solve_edges(edges, images)
    error, value = (each - each.mean() for each in (held.log_exposure - true, true))
    error -= value * (error @ value) / (value @ value)
    blind = exposure_graph.solve_edges(replace(edges, known=None), images)
    np.testing.assert_allclose(held.log_exposure, blind.log_exposure)
    assert np.sqrt(np.mean(error**2)) > 3 * np.sqrt(np.mean(blind.sigma**2))
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.sqrt(np.mean(held.sigma**2))
    assert np.sqrt(np.mean(held.sigma**2)) < 1.5 * np.sqrt(np.mean(error**2 + blind.sigma**2))
