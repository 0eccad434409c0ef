"""Numbers of distinct rows."""

import numpy as np
import pytest

from lvba import distinct_rows


@pytest.mark.parametrize("size", [5, 1 << 40])
def test_rows_are_numbered_as_numpy_sorts_them(size):
    # of 1 << 40 the columns together do not fit into one number
    rows = np.random.default_rng(0).integers(-3, 3, (200, 4)) * size
    expected = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    np.testing.assert_array_equal(distinct_rows.number(rows), expected)
    assert 100 < len(np.unique(expected)) < 200


def test_no_rows_have_no_numbers():
    assert distinct_rows.number(np.zeros((0, 3), np.int64)).shape == (0,)
