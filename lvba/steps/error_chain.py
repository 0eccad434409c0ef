"""Errors of scans that go together with those of their neighbors: a Markov chain, and what cameras say of it.

Of D numbers each: the 6 of a tangent `[rotation | translation]`, rad and m, or how far each has slid along D motions.
"""

from typing import NamedTuple

import numpy as np

from lvba.optim import linear_solver, normal_equations
from lvba.optim.normal_equations import Border


def most_likely(
    own: np.ndarray,
    step: np.ndarray,
    carry: np.ndarray,
    camera_information: np.ndarray,
    differences: np.ndarray,
    shared: np.ndarray,
) -> np.ndarray:
    """The most likely errors (S, D) of the scans.

    own: (S, D, D) float64, of the errors, none on average
    step: (S - 1, D, D) float64, of the motion from each to the next; empty: errors are independent
    carry: (S - 1, D, D) float64, what an error of each makes of the next, if the motion is right
    camera_information: (S, D, D) float64, 0: none; differences: (S, D) float64, what cameras say
    shared: (S, D, 7) float64, what one standard deviation of each number that all cameras share does to the differences
    Errors of neighbors go together as far as the motion between them is more certain than they are: a group of scans
    moves as one. Beyond neighbors only through them: a Markov chain, whose information is block-tridiagonal.
    """
    if len(step):
        diagonal, upper = information(own, step, carry)
    else:
        diagonal, upper = np.linalg.inv(own), np.zeros_like(own[1:])
    weighed = camera_information @ shared
    border = Border(
        coupling=weighed,
        hessian=np.eye(shared.shape[-1]) + np.einsum("sia,sib->ab", shared, weighed),
        gradient=-np.einsum("sia,si->a", weighed, differences),
    )
    right = np.einsum("sij,sj->si", camera_information, differences)
    return solve(diagonal + camera_information, upper, right, border)


_MOST_COMMON = 0.999
"""Of the error of a scan, the part that it can have in common with the next one."""


def information(own: np.ndarray, step: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The information of the chain of errors: blocks on the diagonal (S, D, D) and (S - 1, D, D) beside it.

    own, step, carry: float64, as of `most_likely`
    """
    links = _links(own, step, carry)
    # of unit covariance each, the later error is `correlation` (C) times the one before and noise of covariance 1 - C^2
    noise = 1.0 / (1.0 - links.correlation**2)
    diagonal = np.zeros_like(own)
    diagonal[0] = np.linalg.inv(own[0])
    later, before = (np.swapaxes(each, -1, -2) for each in (links.later, links.before))
    diagonal[1:] = later @ (noise[:, :, None] * links.later)
    diagonal[:-1] += before @ ((noise * links.correlation**2)[:, :, None] * links.before)
    return diagonal, -before @ ((noise * links.correlation)[:, :, None] * links.later)


def drawn(own: np.ndarray, step: np.ndarray, carry: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Errors (S, D) of scans that are as likely as any: a draw from the chain.

    own, step, carry: float64, as of `most_likely`; noise: (S, D) float64, independent, of unit variance
    """
    alone = slice(1) if len(step) else slice(None)
    first = np.linalg.cholesky(own[alone]) @ noise[alone, :, None]
    if not len(step):
        return np.asarray(first[..., 0])
    links = _links(own, step, carry)
    errors = [first[0, :, 0]]
    for k, correlation in enumerate(links.correlation):
        unit = correlation * (links.before[k] @ errors[-1]) + np.sqrt(1.0 - correlation**2) * noise[k + 1]
        errors.append(links.back[k] @ unit)
    return np.array(errors)


class _Links(NamedTuple):
    """How errors of successive scans go together, in axes in which both are of unit covariance and correlate one by one.

    correlation: (S - 1, D); before, later: (S - 1, D, D), what brings errors there; back: what brings later ones back
    """

    correlation: np.ndarray
    before: np.ndarray
    later: np.ndarray
    back: np.ndarray


def _links(own: np.ndarray, step: np.ndarray, carry: np.ndarray) -> _Links:
    before = carry @ own[:-1] @ np.swapaxes(carry, -1, -2)
    common = 0.5 * (before + own[1:] - step)
    left, right = np.linalg.cholesky(before), np.linalg.cholesky(own[1:])
    correlation = np.linalg.solve(
        left, np.swapaxes(np.linalg.solve(right, np.swapaxes(common, -1, -2)), -1, -2)
    )
    values, axes = np.linalg.eigh(0.5 * (correlation + np.swapaxes(correlation, -1, -2)))
    to_axes = np.swapaxes(axes, -1, -2)
    return _Links(
        correlation=np.clip(values, 0.0, _MOST_COMMON),
        before=to_axes @ np.linalg.solve(left, carry),
        later=to_axes @ np.linalg.inv(right),
        back=right @ axes,
    )


def solve(
    diagonal: np.ndarray, upper: np.ndarray, right: np.ndarray, border: Border | None = None
) -> np.ndarray:
    """The solution (S, D) of block-tridiagonal equations with positive blocks.

    diagonal: (S, D, D) float64; upper: (S - 1, D, D) float64, beside it; right: (S, D) float64
    border: of numbers that all share, found beside
    """
    here = np.arange(len(diagonal))
    rows, columns = np.concatenate([here, here[:-1]]), np.concatenate([here, here[1:]])
    blocks = np.concatenate([diagonal, upper])
    equations = normal_equations.from_blocks(rows, columns, blocks, -right, 0.0, border)
    solution = linear_solver.solve_step(equations, 0.0)
    return np.zeros_like(right) if solution is None else solution.blocks
