"""Cholesky of a band with a border, against the dense solution."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from lvba.optim import banded_cholesky, linear_solver, normal_equations
from lvba.optim.normal_equations import Border


def path(count, reach, size, *, loop=False, shared=0, seed=0):
    """Normal equations of a path whose frames are coupled to the next ones; closed, or with parameters that all share."""
    rng = np.random.default_rng(seed)
    total = np.zeros((count, size, count, size))
    pairs = [(i, j) for i in range(count) for j in range(i + 1, min(i + reach + 1, count))]
    pairs += [(i, count - 1 - j) for i in range(reach) for j in range(reach - i)] if loop else []
    for i, j in pairs:
        row = rng.normal(size=(4, 2 * size))
        block = (row.T @ row).reshape(2, size, 2, size)
        for a, k in enumerate((i, j)):
            for b, m in enumerate((i, j)):
                total[k, :, m] += block[a, :, b]
    border = None
    if shared:
        coupling, corner = np.zeros((count, size, shared)), np.zeros((shared, shared))
        for i in range(count):
            row = rng.normal(size=(4, size + shared))
            block = row.T @ row
            total[i, :, i] += block[:size, :size]
            coupling[i] = block[:size, size:]
            corner += block[size:, size:]
        border = Border(coupling, corner, rng.normal(size=shared))
    blocks = total.swapaxes(1, 2)
    rows, columns = np.nonzero(np.triu(np.abs(blocks).sum((2, 3)) > 0))
    gradient = rng.normal(size=(len(total), size))
    return normal_equations.NormalEquations(
        rows.astype(np.int32),
        columns.astype(np.int32),
        blocks[rows, columns].copy(),
        gradient,
        1.0,
        border=border,
    )


def flat(step):
    return np.concatenate([step.blocks.ravel(), step.shared])


CASES = {
    "a path": {"count": 120, "reach": 4},
    "a loop": {"count": 120, "reach": 4, "loop": True},
    "a path with a border": {"count": 120, "reach": 4, "shared": 9},
    "few frames": {"count": 9, "reach": 3, "shared": 2},
    "all coupled": {"count": 80, "reach": 79},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_steps_are_those_of_the_dense_solver(case):
    equations = path(size=6, **case)
    free = np.random.default_rng(1).random(equations.gradient.shape) > 0.1
    free[0] = False
    dense = flat(linear_solver.solve_step(equations, 1e-3, free, dense_limit=100_000))
    banded = linear_solver.solve_step(equations, 1e-3, free, dense_limit=0)
    np.testing.assert_allclose(flat(banded), dense, atol=1e-9 * np.abs(dense).max())
    assert not banded.blocks[~free].any()


def inverse_of(equations, free, damping):
    """The inverse of the damped Hessian over the free unknowns, zero elsewhere."""
    hessian = equations.dense()
    hessian += damping * np.diag(np.diag(hessian))
    index = np.flatnonzero(np.append(free.ravel(), np.ones(equations.shared, bool)))
    inverse = np.zeros_like(hessian)
    inverse[np.ix_(index, index)] = np.linalg.inv(hessian[np.ix_(index, index)])
    return inverse


BACK_ENDS = {
    "dense": (10**6, banded_cholesky.MOST_BYTES),
    "band": (0, banded_cholesky.MOST_BYTES),
    "sparse LU": (0, 1e3),
}


@pytest.fixture(params=BACK_ENDS.values(), ids=BACK_ENDS.keys())
def dense_limit(request, monkeypatch):
    limit, most_bytes = request.param
    monkeypatch.setattr(banded_cholesky, "MOST_BYTES", most_bytes)
    return limit


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def problem(request):
    equations = path(size=6, **request.param)
    free = np.random.default_rng(1).random(equations.gradient.shape) > 0.1
    free[0] = False
    return equations, free


def same(found, inverse, free):
    count, size = free.shape
    here, last = np.arange(count), count * size
    blocks = inverse[:last, :last].reshape(count, size, count, size)[here, :, here]
    for part, expected in (
        (found.blocks, blocks),
        (found.with_shared, inverse[:last, last:].reshape(count, size, -1)),
        (found.shared, inverse[last:, last:]),
    ):
        np.testing.assert_allclose(part, expected, rtol=1e-6, atol=1e-9 * np.abs(inverse).max())


def test_solutions_are_those_of_the_dense_inverse(problem, dense_limit):
    equations, free = problem
    right = np.random.default_rng(3).normal(size=(free.size + equations.shared, 3))
    found = linear_solver.factorize(equations, 1e-3, free, dense_limit).solve(right)
    expected = inverse_of(equations, free, 1e-3) @ right
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_covariances_are_those_of_the_dense_inverse(problem, dense_limit):
    equations, free = problem
    known = linear_solver.covariance(equations, free, dense_limit)
    same(known, inverse_of(equations, free, 0.0), free)
    np.testing.assert_array_equal(linear_solver.shared_covariance(equations, free, dense_limit), known.shared)


def test_covariances_given_shared_parameters_are_those_where_they_are_held(problem, dense_limit):
    equations, free = problem
    count, size = free.shape
    known = np.arange(equations.shared)[::2]
    information = equations.dense()
    kept = np.setdiff1d(
        np.flatnonzero(np.r_[free.ravel(), np.ones(equations.shared, bool)]), known + count * size
    )
    expected = np.zeros((count * size, count * size))
    inner = kept < count * size
    expected[np.ix_(kept[inner], kept[inner])] = np.linalg.inv(information[np.ix_(kept, kept)])[
        np.ix_(inner, inner)
    ]
    here = np.arange(count)
    expected = expected.reshape(count, size, count, size)[here, :, here]
    found = linear_solver.covariance(equations, free, dense_limit).given(known)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_propagated_covariances_are_those_of_the_dense_inverse(problem, dense_limit, monkeypatch):
    monkeypatch.setattr(linear_solver, "_COLUMNS", 7)
    equations, free = problem
    rng = np.random.default_rng(4)
    jacobian = rng.normal(size=(20, free.size + equations.shared)) * (rng.random((20, 1)) > 0.2)
    found = linear_solver.propagated(equations, csr_matrix(jacobian), free, dense_limit)
    expected = jacobian @ inverse_of(equations, free, 0.0) @ jacobian.T
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("with_spread", [False, True])
def test_sandwiches_are_those_of_the_dense_inverse(problem, dense_limit, with_spread, monkeypatch):
    monkeypatch.setattr(linear_solver, "_COLUMNS", 30)
    equations, free = problem
    gradients = np.random.default_rng(5).normal(size=(40, free.size + equations.shared))
    inverse = inverse_of(equations, free, 0.0)
    middle = gradients.T @ gradients + (equations.dense() if with_spread else 0.0)
    spread = equations if with_spread else None
    found = linear_solver.sandwich(equations, csr_matrix(gradients), spread, free, dense_limit)
    same(found, inverse @ middle @ inverse, free)
    shared = linear_solver.shared_sandwich(equations, csr_matrix(gradients), spread, free, dense_limit)
    np.testing.assert_array_equal(shared, found.shared)


def test_a_band_that_would_be_too_large_is_solved_otherwise(monkeypatch):
    equations = path(120, 4, 6)
    expected = linear_solver.solve_step(equations, 1e-3, dense_limit=0)
    monkeypatch.setattr(banded_cholesky, "MOST_BYTES", 1e3)
    with pytest.raises(MemoryError, match="a band of"):
        banded_cholesky.factor(
            equations.rows, equations.columns, equations.blocks, np.zeros((120, 6)), np.ones((120, 6), bool)
        )
    found = linear_solver.solve_step(equations, 1e-3, dense_limit=0)
    np.testing.assert_allclose(flat(found), flat(expected), rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("part", ["poses", "shared"])
def test_what_is_not_positive_has_no_solution(part):
    equations = path(120, 4, 6, shared=3)
    border = equations.border
    if part == "poses":
        worst = replace(equations, blocks=-equations.blocks)
    else:
        worst = replace(equations, border=replace(border, hessian=0.1 * border.hessian))
    assert linear_solver.solve_step(worst, 0.0, dense_limit=0) is None
    assert linear_solver.solve_step(worst, 0.0) is None
    with pytest.raises(np.linalg.LinAlgError):
        linear_solver.covariance(worst)
