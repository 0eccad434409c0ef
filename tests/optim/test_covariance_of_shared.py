"""Covariances of all unknowns, from those of some."""

import numpy as np
import pytest

from lvba.optim import linear_solver


def test_errors_of_shared_parameters_move_all_that_follows_them():
    rng = np.random.default_rng(5)
    spread = rng.normal(size=(11, 11))
    # two images of four unknowns, three shared parameters
    whole = spread @ spread.T + np.eye(11)
    plain = linear_solver.Covariance(
        blocks=np.stack([whole[:4, :4], whole[4:8, 4:8]]),
        with_shared=np.stack([whole[:4, 8:], whole[4:8, 8:]]),
        shared=whole[8:, 8:],
    )
    index, more = np.array([1, 2]), np.diag([7.0, 3.0, -1.0])
    wider = linear_solver.with_errors_of_shared(plain, more, plain, index)
    following = whole[:, 8 + index] @ np.linalg.inv(whole[np.ix_(8 + index, 8 + index)])
    # less of the last one takes nothing away, and the first one is not asked for
    expected = whole + following @ np.diag([3.0, 0.0]) @ following.T
    np.testing.assert_allclose(wider.blocks, [expected[:4, :4], expected[4:8, 4:8]])
    np.testing.assert_allclose(wider.with_shared, [expected[:4, 8:], expected[4:8, 8:]])
    np.testing.assert_allclose(wider.shared, expected[8:, 8:])
    assert wider.shared[1, 1] == pytest.approx(whole[9, 9] + 3.0)
