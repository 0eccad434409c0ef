"""Normal equations that add up, and Levenberg-Marquardt on problems whose answer is known."""

import numpy as np
import pytest
import scipy.linalg

from lvba.optim import levenberg_marquardt, linear_solver, normal_equations
from lvba.optim.levenberg_marquardt import SolverConfig
from lvba.optim.normal_equations import NormalEquations


def random_equations(
    rng, blocks: int = 6, size: int = 3, pairs: int = 12
) -> tuple[NormalEquations, np.ndarray]:
    """A positive definite problem, and its dense Hessian summed the plain way."""
    dense = np.zeros((blocks * size, blocks * size))
    rows, columns, parts = [], [], []
    for _ in range(pairs):
        r, c = rng.choice(blocks, 2, replace=False)
        jacobian = rng.normal(size=(8, 2 * size))
        h = jacobian.T @ jacobian
        index = np.concatenate([r * size + np.arange(size), c * size + np.arange(size)])
        dense[np.ix_(index, index)] += h
        rows += [r, c, r]
        columns += [r, c, c]
        parts += [h[:size, :size], h[size:, size:], h[:size, size:]]
    for b in range(blocks):
        rows, columns, parts = [*rows, b], [*columns, b], [*parts, np.eye(size)]
    dense += np.eye(len(dense))
    gradient = rng.normal(size=(blocks, size))
    return normal_equations.from_blocks(
        np.array(rows), np.array(columns), np.array(parts), gradient, 1.5
    ), dense


@pytest.mark.parametrize("seed", range(5))
def test_blocks_in_any_order_make_the_dense_and_the_sparse_hessian(seed):
    equations, dense = random_equations(np.random.default_rng(seed))
    assert equations.dense() == pytest.approx(dense)
    assert equations.sparse().toarray() == pytest.approx(dense)
    assert (equations.rows <= equations.columns).all()


def test_sums_of_other_patterns_are_the_sums_of_the_hessians():
    rng = np.random.default_rng(0)
    (a, dense_a), (b, dense_b) = random_equations(rng, pairs=4), random_equations(rng, pairs=9)
    total = a + b
    assert total.dense() == pytest.approx(dense_a + dense_b)
    assert total.gradient == pytest.approx(a.gradient + b.gradient)
    assert total.cost == 3.0
    assert (a + a).dense() == pytest.approx(2 * dense_a)
    assert a.scaled(0.5).dense() == pytest.approx(0.5 * dense_a)
    with pytest.raises(ValueError, match="unknowns differ"):
        _ = a + normal_equations.empty(9, 3)


@pytest.mark.parametrize("dense_limit", [0, 1000])
def test_the_step_solves_the_damped_equations_over_the_free_unknowns(dense_limit):
    equations, dense = random_equations(np.random.default_rng(1))
    free = np.ones((6, 3), bool)
    free[2] = free[0, 1] = False
    index = np.flatnonzero(free)
    damped = dense + 0.1 * np.diag(np.diag(dense))
    expected = np.zeros(18)
    expected[index] = -np.linalg.solve(damped[np.ix_(index, index)], equations.gradient.ravel()[index])
    step = linear_solver.solve_step(equations, 0.1, free, dense_limit)
    assert step.blocks.ravel() == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("dense_limit", [0, 1000])
def test_covariance_blocks_are_those_of_the_inverse(dense_limit):
    equations, dense = random_equations(np.random.default_rng(2))
    free = np.ones((6, 3), bool)
    free[3, 1] = False
    index = np.flatnonzero(free)
    inverse = np.zeros((18, 18))
    inverse[np.ix_(index, index)] = np.linalg.inv(dense[np.ix_(index, index)])
    found = linear_solver.covariance(equations, free, dense_limit)
    blocks = inverse.reshape(6, 3, 6, 3)
    for b in range(6):
        assert found.blocks[b] == pytest.approx(blocks[b, :, b], abs=1e-8)
    assert found.with_shared.shape == (6, 3, 0)
    assert found.shared.shape == (0, 0)


def shifted(x, step):
    return x + step.blocks[0]


def rosenbrock(x: np.ndarray) -> NormalEquations:
    """Residuals (1 - x, 10 (y - x^2))."""
    residual = np.array([1 - x[0], 10 * (x[1] - x[0] ** 2)])
    jacobian = np.array([[-1.0, 0.0], [-20 * x[0], 10.0]])
    gradient = (jacobian.T @ residual)[None]
    return NormalEquations(np.zeros(1, int), np.zeros(1, int), (jacobian.T @ jacobian)[None], gradient,
                           0.5 * float(residual @ residual))  # fmt: skip


@pytest.mark.parametrize("dense_limit", [0, 1000])
def test_what_is_added_to_every_diagonal_is_solved_with(dense_limit):
    equations, dense = random_equations(np.random.default_rng(3))
    free = np.ones((6, 3), bool)
    free[0] = free[3, 2] = False
    added = np.array([1.0, 20.0, 300.0])
    index = np.flatnonzero(free)
    expected = np.zeros(18)
    hessian = dense + np.diag(np.tile(added, 6))
    expected[index] = -np.linalg.solve(hessian[np.ix_(index, index)], equations.gradient.ravel()[index])
    step = linear_solver.solve_step(equations, 0.5, free, dense_limit, 2 * added)
    assert step.blocks.ravel() == pytest.approx(expected, abs=1e-10)


def test_a_curved_valley_is_followed_to_its_end():
    config = SolverConfig(max_iterations=100, relative_decrease=0.0, step_tolerance=1e-9)
    found = levenberg_marquardt.levenberg_marquardt(np.array([-1.2, 1.0]), rosenbrock, shifted, config)
    assert found.converged
    assert found.state == pytest.approx([1, 1], abs=1e-7)
    costs = [i.cost for i in found.history]
    assert all(b <= a for a, b in zip([found.cost_initial, *costs], costs, strict=False))
    assert not all(i.accepted for i in found.history)


def test_too_few_iterations_are_a_result_and_not_an_error():
    found = levenberg_marquardt.levenberg_marquardt(
        np.array([-1.2, 1.0]), rosenbrock, shifted, SolverConfig(max_iterations=5)
    )
    assert not found.converged
    assert len(found.history) == 5
    assert found.cost < found.cost_initial


def test_unknowns_that_are_not_free_stay():
    free = np.array([[False, True]])
    found = levenberg_marquardt.levenberg_marquardt(
        np.array([2.0, 0.0]), rosenbrock, shifted, SolverConfig(max_iterations=50), free
    )
    assert found.state == pytest.approx([2.0, 4.0], abs=1e-6)


def test_a_cost_that_is_not_a_number_is_never_accepted():
    def linearize(x: np.ndarray) -> NormalEquations:
        at = rosenbrock(x)
        return at if x[0] < 0 else NormalEquations(at.rows, at.columns, at.blocks, at.gradient, float("nan"))

    found = levenberg_marquardt.levenberg_marquardt(np.array([-1.2, 1.0]), linearize, shifted)
    assert np.isfinite(found.cost)
    assert found.state[0] < 0


@pytest.mark.parametrize("wrong", [{"max_iterations": 0}, {"initial_damping": -1.0}, {"dense_limit": -1}])
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SolverConfig(**wrong)


def test_a_cost_by_itself_leads_to_the_same_state_with_fewer_linearizations():
    config = SolverConfig(max_iterations=100, relative_decrease=0.0, step_tolerance=1e-9)
    start, calls = np.array([-1.2, 1.0]), []

    def counted(x):
        calls.append(x)
        return rosenbrock(x)

    plain = levenberg_marquardt.levenberg_marquardt(start, rosenbrock, shifted, config)
    found = levenberg_marquardt.levenberg_marquardt(
        start, counted, shifted, config, cost=lambda x: rosenbrock(x).cost
    )
    assert np.array_equal(found.state, plain.state)
    assert found.history == plain.history
    refused = sum(not entry.accepted for entry in found.history)
    assert refused > 0
    assert len(calls) <= len(found.history) + 1 - refused


def bowl(x):
    """An indefinite Newton Hessian at 0 of a cost with minima at +-1; Gauss-Newton's of (x^2 - 1)."""
    cost = 0.5 * float((x[0] ** 2 - 1) ** 2)
    gradient = 2 * x[0] * (x[0] ** 2 - 1)
    return cost, gradient, 6 * x[0] ** 2 - 2, 4 * x[0] ** 2


def equations_of(cost, gradient, hessian):
    at = np.zeros(1, int)
    return NormalEquations(at, at, np.array([[[hessian]]]), np.array([[gradient]]), cost)


def test_where_the_hessian_is_indefinite_a_convex_one_takes_over():
    def newton(x):
        cost, gradient, hessian, _ = bowl(x)
        return equations_of(cost, gradient, hessian)

    def convex(x):
        used.append(float(x[0]))
        cost, gradient, _, hessian = bowl(x)
        return equations_of(cost, gradient, hessian)

    used: list[float] = []
    config = SolverConfig(initial_damping=0.0, step_tolerance=1e-12, relative_decrease=0.0)
    found = levenberg_marquardt.levenberg_marquardt(
        np.array([0.5]), newton, shifted, config, convex=convex, metric=np.ones(1)
    )
    assert used == [0.5]
    assert found.state == pytest.approx([1.0], abs=1e-9)


@pytest.mark.parametrize("most", [1, 3])
def test_no_more_steps_are_taken_than_asked_for(most):
    found = levenberg_marquardt.levenberg_marquardt(
        np.array([-1.2, 1.0]), rosenbrock, shifted, SolverConfig(), most_accepted=most
    )
    assert sum(entry.accepted for entry in found.history) == most


@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_a_rise_within_the_noise_of_the_cost_is_accepted(noise):
    def wrong(x):
        """A gradient of the wrong sign: the cost rises by 1.5 over the first step."""
        return equations_of(0.5 * float(x[0] ** 2), -float(x[0]), 1.0)

    found = levenberg_marquardt.levenberg_marquardt(
        np.ones(1), wrong, shifted, SolverConfig(initial_damping=0.0),
        metric=np.ones(1), cost_noise=noise, most_accepted=1,
    )  # fmt: skip
    assert found.history[0].accepted == (noise > 0)


def test_a_single_step_is_damped_until_its_equations_are_positive():
    metric = np.array([0.5])
    step, damping = levenberg_marquardt.damped_step(equations_of(1.0, 2.0, 4.0), 0.0, metric=metric)
    assert step.blocks == pytest.approx(np.array([[-0.5]]))
    assert damping == 0.0
    step, damping = levenberg_marquardt.damped_step(equations_of(1.0, 2.0, -4.0), 0.0, metric=metric)
    assert damping == 10.0
    assert step.blocks == pytest.approx(np.array([[-2.0]]))
    step, _ = levenberg_marquardt.damped_step(equations_of(1.0, 2.0, -1e12), 0.0, metric=metric)
    assert step is None


def test_a_pattern_of_all_pairs_is_solved_densely_and_like_any_other():
    rng = np.random.default_rng(8)
    root = rng.normal(size=(30, 40))
    equations = normal_equations.from_dense(root @ root.T, rng.normal(size=(10, 3)), 1.0)
    np.testing.assert_allclose(equations.dense(), root @ root.T)
    step = linear_solver.solve_step(equations, 0.0, dense_limit=0)
    expected = -np.linalg.solve(root @ root.T, equations.gradient.ravel())
    np.testing.assert_allclose(step.blocks.ravel(), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("size", [3, 2])
def test_projected_equations_are_those_by_other_unknowns(size):
    rng = np.random.default_rng(9)
    equations, dense = random_equations(rng)
    jacobian = rng.normal(size=(6, 3, size))
    if size == 3:
        jacobian[1:4] = np.eye(3)
    found = equations.projected(jacobian)
    whole = scipy.linalg.block_diag(*jacobian)
    np.testing.assert_allclose(found.dense(), whole.T @ dense @ whole, atol=1e-12 * np.abs(dense).max())
    np.testing.assert_allclose(found.gradient.ravel(), whole.T @ equations.gradient.ravel())
    assert found.cost == equations.cost


def test_diagonal_blocks_are_zero_where_there_are_none():
    at = np.array([1], np.int32)
    equations = NormalEquations(at, at, np.full((1, 2, 2), 3.0), np.zeros((3, 2)), 0.0)
    found = equations.diagonal_blocks()
    assert np.array_equal(found[1], np.full((2, 2), 3.0))
    assert not found[[0, 2]].any()
