"""Shared parameters: a new one is a field, a prior and a Jacobian, and is estimated like those that were there."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from lvba import geometry
from lvba.optim import levenberg_marquardt, linear_solver, normal_equations, shared_parameters
from lvba.optim.levenberg_marquardt import SolverConfig
from lvba.optim.normal_equations import Border
from lvba.optim.shared_parameters import Pose, Scalar, SharedParameters, SharedPrior, Vector, parameter

COUNT = 40
TRUE_BIAS, TRUE_SCALE = np.array([0.03, -0.02]), 1.05
SIGMA_STEP, SIGMA_PLACE = 0.01, 0.05


@dataclass(frozen=True)
class Biased(SharedParameters):
    """What all measured motions are off by."""

    bias: np.ndarray = field(metadata=parameter(Vector(2, "m")))


@dataclass(frozen=True)
class BiasedAndScaled(Biased):
    """A parameter more."""

    scale: float = field(default=1.0, metadata=parameter(Scalar("1")))


@dataclass(frozen=True)
class State:
    """Places (N, 2) of a vehicle in the plane, and what is shared."""

    places: np.ndarray
    shared: SharedParameters


class Measured:
    """Motions between places, times a scale, plus a bias; and the places themselves, vaguely."""

    def __init__(self, scale: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.truth = np.cumsum(rng.normal(size=(COUNT, 2)), axis=0)
        noise = SIGMA_STEP * rng.normal(size=(COUNT - 1, 2))
        self.steps = scale * np.diff(self.truth, axis=0) + TRUE_BIAS + noise
        self.places = self.truth + SIGMA_PLACE * rng.normal(size=self.truth.shape)

    def by_shared(self, state: State) -> np.ndarray:
        """(N - 1, 2, k): the one thing to write for a new parameter."""
        layout = state.shared.layout()
        found = np.zeros((COUNT - 1, 2, layout.size))
        found[:, :, layout["bias"]] = np.eye(2)
        if "scale" in layout.kinds:
            found[:, :, layout["scale"]] = np.diff(state.places, axis=0)[..., None]
        return found

    def linearize(self, state: State) -> normal_equations.NormalEquations:
        scale, by_shared = getattr(state.shared, "scale", 1.0), self.by_shared(state)
        off = scale * np.diff(state.places, axis=0) + state.shared.bias - self.steps
        near = state.places - self.places
        here, weight = np.arange(COUNT), 1 / SIGMA_STEP**2
        diagonal = np.full(COUNT, 2 * scale**2 * weight) + 1 / SIGMA_PLACE**2
        diagonal[[0, -1]] -= scale**2 * weight
        gradient = near / SIGMA_PLACE**2
        gradient[1:] += scale * weight * off
        gradient[:-1] -= scale * weight * off
        coupling = np.zeros((COUNT, 2, by_shared.shape[2]))
        coupling[1:] += scale * weight * by_shared
        coupling[:-1] -= scale * weight * by_shared
        border = Border(
            coupling,
            weight * np.einsum("nik,nil->kl", by_shared, by_shared),
            weight * np.einsum("nik,ni->k", by_shared, off),
        )
        cost = 0.5 * weight * np.sum(off**2) + 0.5 * np.sum(near**2) / SIGMA_PLACE**2
        rows = np.concatenate([here, here[:-1]])
        columns = np.concatenate([here, here[1:]])
        scales = np.concatenate([diagonal, np.full(COUNT - 1, -(scale**2) * weight)])
        return normal_equations.from_blocks(
            rows, columns, scales[:, None, None] * np.eye(2), gradient, float(cost), border
        )


def solve(measured, prior: SharedPrior | None, shared, dense_limit=2500):
    def linearize(state):
        found = measured.linearize(state)
        return found if prior is None else found + prior.linearize(state.shared, (COUNT, 2))

    def retract(state, step):
        return State(state.places + step.blocks, state.shared.retract(step.shared))

    config = SolverConfig(relative_decrease=1e-14, step_tolerance=1e-12, dense_limit=dense_limit)
    found = levenberg_marquardt.levenberg_marquardt(
        State(measured.places, shared), linearize, retract, config
    ).state
    return found, linear_solver.covariance(linearize(found), dense_limit=dense_limit)


def twin(measured, found: State, sigma: np.ndarray, reference: np.ndarray):
    """Jacobian by differences and residuals of the whole problem, dense: the last step to make and the covariance."""

    def residuals(x):
        places, shared = x[: 2 * COUNT].reshape(-1, 2), x[2 * COUNT :]
        scale = shared[2] if len(shared) > 2 else 1.0
        off = (scale * np.diff(places, axis=0) + shared[:2] - measured.steps) / SIGMA_STEP
        near = (places - measured.places) / SIGMA_PLACE
        return np.concatenate([off.ravel(), near.ravel(), (shared - reference) / sigma])

    numbers = [np.atleast_1d(getattr(found.shared, name)) for name in found.shared.layout().kinds]
    x = np.concatenate([found.places.ravel(), *numbers])
    jacobian = np.stack(
        [(residuals(x + step) - residuals(x - step)) / 2e-5 for step in 1e-5 * np.eye(len(x))], axis=1
    )
    hessian = jacobian.T @ jacobian
    return np.linalg.solve(hessian, jacobian.T @ residuals(x)), np.linalg.inv(hessian)


@pytest.mark.parametrize("dense_limit", [0, 2500])
@pytest.mark.parametrize("new", [False, True], ids=["a bias", "a scale more"])
def test_a_new_parameter_is_estimated_with_the_covariance_of_a_dense_twin(new, dense_limit):
    measured = Measured(TRUE_SCALE if new else 1.0)
    start = BiasedAndScaled(np.zeros(2)) if new else Biased(np.zeros(2))
    sigma = {"bias": 0.1, "scale": 0.05} if new else {"bias": [0.1, 0.1]}
    prior = SharedPrior(start, shared_parameters.information(start.layout(), sigma))
    found, known = solve(measured, prior, start, dense_limit)
    deviations = 1 / np.sqrt(np.diag(prior.claimed))
    reference = np.array([0.0, 0.0, 1.0])[: len(deviations)]
    left, covariance = twin(measured, found, deviations, reference)
    assert np.abs(left).max() < 1e-8
    last = 2 * COUNT
    np.testing.assert_allclose(known.shared, covariance[last:, last:], rtol=1e-5)
    blocks = covariance[:last, :last].reshape(COUNT, 2, COUNT, 2)
    here = np.arange(COUNT)
    np.testing.assert_allclose(known.blocks, blocks[here, :, here], rtol=1e-5, atol=1e-12)
    with_shared = covariance[:last, last:].reshape(COUNT, 2, -1)
    np.testing.assert_allclose(known.with_shared, with_shared, rtol=1e-4, atol=1e-9)
    spread = start.layout().named(np.sqrt(np.diag(known.shared)))
    assert (np.abs(found.shared.bias - TRUE_BIAS) < 4 * spread["bias"]).all()
    assert (spread["bias"] < 0.05).all()
    if new:
        assert abs(found.shared.scale - TRUE_SCALE) < 4 * spread["scale"][0]
        assert spread["scale"][0] < 0.1 * (TRUE_SCALE - 1.0)


def test_a_parameter_that_no_factor_sees_stays_and_has_no_variance():
    class Blind(Measured):
        def by_shared(self, state):
            found = super().by_shared(state)
            found[:, :, state.shared.layout()["scale"]] = 0.0
            return found

    found, known = solve(Blind(1.0), None, BiasedAndScaled(np.zeros(2), 1.0))
    assert found.shared.scale == 1.0
    assert not known.shared[2].any()
    assert known.shared[0, 0] > 0


def test_a_parameter_that_the_data_do_not_determine_stays_at_its_prior():
    class Blind(Measured):
        def by_shared(self, state):
            return 0.0 * super().by_shared(state)

    start = BiasedAndScaled(np.array([0.01, 0.02]), 1.0)
    prior = SharedPrior(start, shared_parameters.information(start.layout(), {"bias": 0.1, "scale": 0.05}))
    found, known = solve(Blind(1.0), prior, start)
    assert found.shared.scale == 1.0
    assert found.shared.bias == pytest.approx(start.bias)
    assert np.diag(known.shared) == pytest.approx([0.01, 0.01, 0.0025])


@dataclass(frozen=True)
class Rig(SharedParameters):
    """One of each kind."""

    offset: float = field(metadata=parameter(Scalar("s")))
    pose: np.ndarray = field(metadata=parameter(Pose()))
    center: np.ndarray = field(metadata=parameter(Vector(2, "px")))


def rig(seed: int) -> Rig:
    rng = np.random.default_rng(seed)
    return Rig(float(rng.normal()), geometry.exp(rng.normal(size=6)), rng.normal(size=2))


def test_the_layout_is_in_the_order_of_the_fields():
    layout = Rig.layout()
    assert layout.size == 9
    assert [layout[name] for name in ("offset", "pose", "center")] == [slice(0, 1), slice(1, 7), slice(7, 9)]
    assert layout.units == ("s", *("rad",) * 3, *("m",) * 3, "px", "px")
    assert layout.named(np.arange(9.0))["center"].tolist() == [7.0, 8.0]


def test_a_step_of_all_is_a_step_of_each():
    start, step = rig(0), 0.1 * np.random.default_rng(1).normal(size=9)
    moved = start.retract(step)
    assert moved.offset == start.offset + step[0]
    assert np.array_equal(moved.pose, geometry.retract(start.pose, step[1:7]))
    assert np.array_equal(moved.center, start.center + step[7:])


def test_deviations_have_their_derivatives_by_steps():
    reference, at = rig(2), rig(3)
    slopes = [
        (at.retract(step).deviation(reference) - at.retract(-step).deviation(reference)) / 2e-6
        for step in 1e-6 * np.eye(9)
    ]
    assert at.deviation_jacobian(reference) == pytest.approx(np.array(slopes).T, abs=1e-6)
    assert reference.deviation(reference) == pytest.approx(np.zeros(9), abs=1e-12)


def test_a_prior_has_the_derivatives_of_its_cost():
    sigma = {"offset": 0.1, "pose": [0.1, 0.2, 0.3, 1.0, 2.0, 3.0], "center": 2.0}
    prior = SharedPrior(rig(4), shared_parameters.information(Rig.layout(), sigma))
    at = rig(5)
    found = prior.linearize(at, (3, 6))
    assert found.gradient.shape == (3, 6)
    assert not found.gradient.any()
    assert not found.border.coupling.any()
    for n, step in enumerate(1e-6 * np.eye(9)):
        costs = [prior.linearize(at.retract(sign * step), (3, 6)).cost for sign in (1, -1)]
        assert found.border.gradient[n] == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-5, abs=1e-6)
    assert prior.gradient_variance(at) == pytest.approx(prior.hessian(at))
    more = replace(prior, counted=50 * prior.claimed)
    # 50 times the weight on an error of the same size: 2,500 times the variance
    assert more.gradient_variance(at) == pytest.approx(2500 * prior.hessian(at))


@pytest.mark.parametrize(
    "wrong", [{"offset": 1.0}, {"offset": 1.0, "pose": 1.0, "center": 1.0, "other": 1.0}]
)
def test_every_parameter_has_a_standard_deviation_and_nothing_else_has(wrong):
    with pytest.raises(ValueError, match="standard deviations"):
        shared_parameters.information(Rig.layout(), wrong)


def test_the_mean_of_values_weighs_each_number_by_its_variance():
    reference = Rig(0.0, np.eye(4), np.zeros(2))
    values = [reference.retract(0.01 * np.random.default_rng(seed).normal(size=9)) for seed in (6, 7)]
    sigma = [np.full(9, 1.0), np.full(9, 2.0)]
    sigma[1][0] = 0.5
    mean = shared_parameters.weighted_mean(reference, values, sigma)
    assert mean.offset == pytest.approx(0.2 * values[0].offset + 0.8 * values[1].offset)
    assert mean.center == pytest.approx(0.8 * values[0].center + 0.2 * values[1].center)
    together = shared_parameters.common_sigma(sigma)
    assert together[[0, 1]] == pytest.approx([np.sqrt(0.2), np.sqrt(0.8)])
    same = shared_parameters.weighted_mean(reference, [values[0]] * 2, sigma)
    assert same.pose == pytest.approx(values[0].pose, abs=1e-9)


def test_borders_of_other_parameters_do_not_add_up():
    one, other = (normal_equations.empty(3, 2, border=Border(np.zeros((3, 2, k)), np.eye(k), np.zeros(k)))
                  for k in (2, 3))  # fmt: skip
    with pytest.raises(ValueError, match="unknowns differ"):
        _ = one + other
    assert (one + normal_equations.empty(3, 2)).shared == 2
    assert (normal_equations.empty(3, 2) + other).shared == 3


def test_equations_of_parts_keep_their_border_in_the_whole():
    rng = np.random.default_rng(8)
    parts = []
    for index in (np.array([0, 2]), np.array([1, 2, 3])):
        size = 2 * len(index) + 3
        root = rng.normal(size=(size, size + 2))
        hessian, gradient = root @ root.T, rng.normal(size=size)
        last = size - 3
        equations = normal_equations.from_dense(hessian[:last, :last], gradient[:last].reshape(-1, 2), 1.0)
        border = Border(hessian[:last, last:].reshape(-1, 2, 3), hessian[last:, last:], gradient[last:])
        parts.append((index, replace(equations, border=border)))
    whole = normal_equations.scattered(parts, 4)
    expected, pull = np.zeros((11, 11)), np.zeros(11)
    for index, equations in parts:
        at = np.append((2 * index[:, None] + [0, 1]).ravel(), [8, 9, 10])
        expected[np.ix_(at, at)] += equations.dense()
        pull[at] += np.append(equations.gradient.ravel(), equations.border.gradient)
    np.testing.assert_allclose(whole.dense(), expected)
    np.testing.assert_allclose(whole.sparse().toarray(), expected)
    np.testing.assert_allclose(np.append(whole.gradient.ravel(), whole.border.gradient), pull)
    together = rng.normal(size=(4, 2, 2))
    common = whole.together(together)
    jacobian = np.zeros((11, 5))
    jacobian[:8, :2], jacobian[8:, 2:] = together.reshape(8, 2), np.eye(3)
    np.testing.assert_allclose(common.dense(), jacobian.T @ expected @ jacobian)
    step = normal_equations.Step(rng.normal(size=(4, 2)), rng.normal(size=3))
    flat = np.append(step.blocks.ravel(), step.shared)
    assert whole.predicted(step) == pytest.approx(-pull @ flat - 0.5 * flat @ expected @ flat)
    assert whole.scaled(3.0).predicted(step) == pytest.approx(3.0 * whole.predicted(step))
