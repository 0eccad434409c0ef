"""Errors of scans as a Markov chain: the covariances that it is made from, and the dense equations."""

from itertools import pairwise

import numpy as np
import pytest

from lvba import geometry
from lvba.steps import error_chain


def chain_of(count, rng):
    """Poses, covariances of errors that are alike, and of the motions between them, which are known better."""

    def spread(size):
        root = rng.normal(size=(6, 9)) * size
        return root @ root.T

    own = spread(1.0)
    poses = geometry.exp(0.3 * rng.normal(size=(count, 6)))
    carried = [own]
    for a, b in pairwise(poses):
        move = geometry.adjoint(geometry.inverse(b) @ a)
        carried.append(move @ carried[-1] @ move.T + spread(0.1))
    step = np.stack([later - _moved(before, a, b) for before, later, a, b in zip(
        carried, carried[1:], poses, poses[1:], strict=False)])  # fmt: skip
    return poses, np.stack(carried), step


def _moved(covariance, a, b):
    move = geometry.adjoint(geometry.inverse(b) @ a)
    return move @ covariance @ move.T


def carries(poses):
    return geometry.adjoint(geometry.inverse(poses[1:]) @ poses[:-1])


def dense(diagonal, upper):
    count = len(diagonal)
    full = np.zeros((count, 6, count, 6))
    for k in range(count):
        full[k, :, k] = diagonal[k]
    for k in range(count - 1):
        full[k, :, k + 1], full[k + 1, :, k] = upper[k], upper[k].T
    return full.reshape(6 * count, 6 * count)


def test_the_chain_has_the_covariances_that_it_is_made_from():
    poses, own, step = chain_of(6, np.random.default_rng(10))
    covariance = np.linalg.inv(dense(*error_chain.information(own, step, carries(poses))))
    for k in range(6):
        here = slice(6 * k, 6 * k + 6)
        np.testing.assert_allclose(covariance[here, here], own[k], rtol=1e-6, atol=1e-6)
    for k in range(5):
        pair = covariance[6 * k : 6 * k + 12, 6 * k : 6 * k + 12]
        both = np.concatenate(
            [-geometry.adjoint(geometry.inverse(poses[k + 1]) @ poses[k]), np.eye(6)], axis=1
        )
        # wider where neighbors would have more than 0.999 of their error in common
        found = both @ pair @ both.T
        assert np.trace(found) == pytest.approx(np.trace(step[k]), rel=0.15)


def test_the_chain_is_solved_as_the_dense_equations_are():
    rng = np.random.default_rng(11)
    poses, own, step = chain_of(7, rng)
    diagonal, upper = error_chain.information(own, step, carries(poses))
    diagonal, right = diagonal + np.eye(6), rng.normal(size=(7, 6))
    found = error_chain.solve(diagonal, upper, right)
    np.testing.assert_allclose(
        found.ravel(), np.linalg.solve(dense(diagonal, upper), right.ravel()), rtol=1e-8
    )


def test_draws_from_the_chain_have_its_covariance():
    rng = np.random.default_rng(12)
    poses, own, step = chain_of(4, rng)
    expected = np.linalg.inv(dense(*error_chain.information(own, step, carries(poses))))
    draws = np.array(
        [error_chain.drawn(own, step, carries(poses), rng.normal(size=(4, 6))).ravel() for _ in range(20_000)]
    )
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        draws.T @ draws / len(draws) / np.outer(size, size), expected / np.outer(size, size), atol=0.05
    )


def test_draws_of_independent_errors_have_their_covariances():
    rng = np.random.default_rng(13)
    _, own, _ = chain_of(2, rng)
    none = np.zeros((0, 6, 6))
    draws = np.array([error_chain.drawn(own, none, none, rng.normal(size=(2, 6))) for _ in range(20_000)])
    size = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    scale = size[:, :, None] * size[:, None, :]
    np.testing.assert_allclose(
        np.einsum("nsi,nsj->sij", draws, draws) / len(draws) / scale, own / scale, atol=0.05
    )
