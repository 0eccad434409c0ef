"""Natural cubic smoothing splines, each as smooth as leaving out single samples shows to predict them best.

Of samples y at times t, the spline f makes sum (y - f(t))^2 + a * integral f''^2 least. With the banded matrices Q and R
of the second differences, y - f(t) = a Q B^-1 Q' y for B = R + a Q' Q. Sources: Green and Silverman 1994, sections 2.3
and 3.4; Craven and Wahba 1979, generalized cross-validation; for traces of banded inverses, Takahashi, Fagan and Chen
1973.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from lvba.arrays import Times

_STIFFNESSES = np.geomspace(1e-3, 1e8, 45)
"""a, in cubes of the time from sample to sample: from none to what bends over hundreds of samples."""


@dataclass(frozen=True)
class _Bands:
    """second: (n - 2, 3), rows of Q'; r, qq: (3, n - 2), the lower bands of R and Q' Q as LAPACK has them."""

    second: np.ndarray
    r: np.ndarray
    qq: np.ndarray

    @classmethod
    def of(cls, times: Times) -> "_Bands":
        """At times (n,), strictly ascending."""
        step = np.diff(times)
        before, after = 1 / step[:-1], 1 / step[1:]
        second = np.stack([before, -before - after, after], axis=1)
        r, qq = np.zeros((2, 3, len(second)))
        r[0], r[1, :-1] = (step[:-1] + step[1:]) / 3, step[1:-1] / 6
        qq[0] = np.einsum("ni,ni->n", second, second)
        qq[1, :-1] = np.einsum("ni,ni->n", second[:-1, 1:], second[1:, :2])
        qq[2, :-2] = second[:-2, 2] * second[2:, 0]
        return cls(second, r, qq)

    def factor(self, stiffness: float) -> np.ndarray:
        """(3, n - 2): the Cholesky factor of B."""
        return np.asarray(cholesky_banded(self.r + stiffness * self.qq, lower=True, check_finite=False))

    def left(self, stiffness: float, factor: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(n, k): what samples (n, k) are off their splines."""
        bent = sum(self.second[:, k, None] * values[k : len(values) - 2 + k] for k in range(3))
        weights = cho_solve_banded((factor, True), bent, check_finite=False)
        off = np.zeros(values.shape)
        for k in range(3):
            off[k : len(off) - 2 + k] += self.second[:, k, None] * weights
        return stiffness * off


def fit(times: Times, values: np.ndarray, slowest: float = 0.0) -> CubicSpline:
    """The splines of k columns, each as smooth as its own samples ask for.

    times: (n,) float64, strictly ascending, n >= 4, about 1 apart; values: (n, k) float64
    slowest: at least so stiff that of a swing through an angle of 1 in this time half remains, in the unit of times
    Returns a spline whose values are (..., k) at times (...).
    """
    bands = _Bands.of(times)
    # a swing of angular frequency w remains by 1 / (1 + a w^4)
    softest = slowest**4
    enough = softest <= _STIFFNESSES
    stiffnesses = _STIFFNESSES[enough] if enough.any() else np.array([softest])
    factors = np.stack([bands.factor(each) for each in stiffnesses])
    freedom = stiffnesses * _traces(factors, bands.qq)
    least = np.full(values.shape[1], np.inf)
    smooth = values.copy()
    for stiffness, factor, free in zip(stiffnesses, factors, freedom, strict=True):
        off = bands.left(float(stiffness), factor, values)
        score = np.sum(off**2, axis=0) / free**2
        better = score < least
        least[better], smooth[:, better] = score[better], (values - off)[:, better]
    return CubicSpline(times, smooth, bc_type="natural")


def _traces(factors: np.ndarray, band: np.ndarray) -> np.ndarray:
    """(m,): traces of B^-1 A of m matrices B by their Cholesky factors (m, 3, n); band: (3, n), of the symmetric A."""
    pivot, near, far = factors[:, 0], factors[:, 1] / factors[:, 0], factors[:, 2] / factors[:, 0]
    count, size = pivot.shape
    trace = np.zeros(count)
    # of the inverse: on the diagonal at the next two places, and beside it at the next one
    next_one, next_two, next_near = np.zeros((3, count))
    for place in range(size - 1, -1, -1):
        a, b = near[:, place], far[:, place]
        beyond = -a * next_near - b * next_two
        beside = -a * next_one - b * next_near
        here = pivot[:, place] ** -2.0 - a * beside - b * beyond
        trace += band[0, place] * here + 2 * (band[1, place] * beside + band[2, place] * beyond)
        next_one, next_two, next_near = here, next_one, beside
    return trace
