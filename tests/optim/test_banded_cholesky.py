"""Cholesky of a band with a border, against the dense solution."""

import numpy as np
import pytest

from lvba.optim import banded_cholesky, linear_solver, normal_equations


def path(count, reach, size, *, loop=False, shared=False, seed=0):
    """Normal equations of a path whose frames are coupled to the next ones; closed, or with a block that all share."""
    rng = np.random.default_rng(seed)
    total = np.zeros((count + shared, size, count + shared, size))
    pairs = [(i, j) for i in range(count) for j in range(i + 1, min(i + reach + 1, count))]
    pairs += [(i, count - 1 - j) for i in range(reach) for j in range(reach - i)] if loop else []
    pairs += [(i, count) for i in range(count)] if shared else []
    for i, j in pairs:
        row = rng.normal(size=(4, 2 * size))
        block = (row.T @ row).reshape(2, size, 2, size)
        for a, k in enumerate((i, j)):
            for b, m in enumerate((i, j)):
                total[k, :, m] += block[a, :, b]
    blocks = total.swapaxes(1, 2)
    rows, columns = np.nonzero(np.triu(np.abs(blocks).sum((2, 3)) > 0))
    gradient = rng.normal(size=(len(total), size))
    return normal_equations.NormalEquations(
        rows.astype(np.int32), columns.astype(np.int32), blocks[rows, columns].copy(), gradient, 1.0
    )


CASES = {
    "a path": {"count": 120, "reach": 4},
    "a loop": {"count": 120, "reach": 4, "loop": True},
    "a path with a mount": {"count": 120, "reach": 4, "shared": True},
    "few frames": {"count": 9, "reach": 3, "shared": True},
    "all coupled": {"count": 80, "reach": 79},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_steps_are_those_of_the_dense_solver(case):
    equations = path(size=6, **case)
    free = np.random.default_rng(1).random(equations.gradient.shape) > 0.1
    free[0] = False
    dense = linear_solver.solve_step(equations, 1e-3, free, dense_limit=100_000)
    banded_step = linear_solver.solve_step(equations, 1e-3, free, dense_limit=0)
    np.testing.assert_allclose(banded_step, dense, atol=1e-9 * np.abs(dense).max())
    assert not banded_step[~free].any()


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_columns_of_the_inverse_are_those_of_the_dense_one(case):
    equations = path(size=3, **case)
    index = np.arange(3, equations.gradient.size)
    wanted = np.array([0, 5, len(index) - 1])
    dense, sparse = (linear_solver.inverse_columns(equations, index, limit)(wanted) for limit in (10**6, 0))
    np.testing.assert_allclose(sparse, dense, rtol=1e-6, atol=1e-8 * np.abs(dense).max())


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_selected_blocks_of_the_inverse_are_those_of_the_dense_one(case):
    equations = path(size=6, **case)
    free = np.random.default_rng(1).random(equations.gradient.shape) > 0.1
    free[0] = False
    factors = linear_solver.factorize(equations, 1e-3, free)
    assert isinstance(factors, banded_cholesky.BandedCholesky)
    hessian = equations.dense()
    hessian += 1e-3 * np.diag(np.diag(hessian))
    index = np.flatnonzero(free)
    inverse = np.zeros_like(hessian)
    inverse[np.ix_(index, index)] = np.linalg.inv(hessian[np.ix_(index, index)])
    here = np.arange(len(free))
    expected = inverse.reshape(len(here), 6, len(here), 6)[here, :, here]
    np.testing.assert_allclose(factors.inverse_blocks(), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("most_bytes", [banded_cholesky.MOST_BYTES, 1e3], ids=["band", "sparse LU"])
def test_covariances_are_those_of_the_dense_inverse(case, most_bytes, monkeypatch):
    monkeypatch.setattr(banded_cholesky, "MOST_BYTES", most_bytes)
    equations = path(size=6, **case)
    free = np.ones(equations.gradient.shape, bool)
    free[0], free[5, 2], free[-1, 4] = False, False, False
    dense, selected = (linear_solver.covariance_blocks(equations, free, limit) for limit in (10**6, 0))
    for found, wanted in zip(selected, dense, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7 * np.abs(wanted).max())


def test_a_band_that_would_be_too_large_is_solved_otherwise(monkeypatch):
    equations = path(120, 4, 6)
    expected = linear_solver.solve_step(equations, 1e-3, dense_limit=0)
    monkeypatch.setattr(banded_cholesky, "MOST_BYTES", 1e3)
    with pytest.raises(MemoryError, match="a band of"):
        banded_cholesky.factor(
            equations.rows, equations.columns, equations.blocks, np.zeros((120, 6)), np.ones((120, 6), bool)
        )
    np.testing.assert_allclose(
        linear_solver.solve_step(equations, 1e-3, dense_limit=0), expected, rtol=1e-7, atol=1e-12
    )


@pytest.mark.parametrize("shared", [False, True])
def test_what_is_not_positive_has_no_solution(shared):
    equations = path(120, 4, 6, shared=shared)
    worst = normal_equations.NormalEquations(
        equations.rows, equations.columns, -equations.blocks, equations.gradient, 1.0
    )
    assert linear_solver.solve_step(worst, 0.0, dense_limit=0) is None
