"""Which of several loops to believe: those that fit the odometry and each other, judged together."""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import PoseBlocks

_MOST_SEEDS = 20
"""Refused loops from which another set is grown, to see whether it explains as much."""
_UNKNOWN = 1e-4
"""Information (1 / rad^2, 1 / m^2) that stands for none: a standard deviation of 100."""


@dataclass(frozen=True)
class Choice:
    """L loops, used or not.

    used: (L,) bool
    distance: (L,) float64, squared error over its variance that the loop costs beside the used ones; 6 is expected
    reason: L sentences
    """

    used: np.ndarray
    distance: np.ndarray
    reason: tuple[str, ...]

    @staticmethod
    def none(count: int) -> "Choice":
        """No loop is used."""
        return Choice(np.zeros(count, bool), np.full(count, np.nan), ("",) * count)


def choose(
    error: np.ndarray, predicted: np.ndarray, information: PoseBlocks, gate: float, margin: float
) -> Choice:
    """The set of loops of least `squared errors over their variances + gate * refused`, as far as it is unique.

    error: (L, 6) float64, what loops measure less what is predicted without them
    predicted: (6 L, 6 L) float64, covariance of the predictions; information: (L, 6, 6), of the loops themselves
    margin: sets that contradict each other and differ by less are both refused
    Greedy, from the loop that fits best, and again from each refused one: exact where contradictions are few.
    """
    count = len(error)
    joint = predicted.copy()
    own = np.linalg.inv(information + _UNKNOWN * np.eye(6))
    for loop in range(count):
        joint[_part(loop), _part(loop)] += own[loop]
    alone = _distances(error, joint)
    best = _grow(error, joint, int(np.argmin(alone)), gate)
    seeds = np.argsort(alone, kind="stable")[:_MOST_SEEDS].tolist()
    others = [_grow(error, joint, seed, gate) for seed in seeds if not best[seed] and alone[seed] <= gate]
    best, *others = sorted([best, *others], key=lambda used: _value(error, joint, used, gate))
    contested = np.zeros(count, bool)
    for other in others:
        if _value(error, joint, other, gate) - _value(error, joint, best, gate) < margin:
            contested |= best ^ other
    used = best & ~contested
    distance = _beside(error, joint, used)
    reason = tuple(_reason(*facts, gate) for facts in zip(used, contested, distance, error, strict=True))
    return Choice(used, distance, reason)


def _reason(used: bool, contested: bool, distance: float, error: np.ndarray, gate: float) -> str:
    if used:
        return f"fits the odometry and the other loops: chi square {distance:.1f}"
    if contested:
        return "contradicts other loops that fit as well: which are true cannot be told"
    off = f"{np.linalg.norm(error[3:]):.3f} m and {np.degrees(np.linalg.norm(error[:3])):.3f} degrees"
    return f"misses by {off}: chi square {distance:.0f} beside the odometry and the used loops, {gate:.0f} allowed"


def _part(loop: int) -> slice:
    return slice(6 * loop, 6 * loop + 6)


def _blocks(matrix: np.ndarray) -> np.ndarray:
    """The (L, 6, 6) blocks on the diagonal."""
    count = len(matrix) // 6
    here = np.arange(count)
    return matrix.reshape(count, 6, count, 6)[here, :, here]


def _distances(error: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Of each loop alone, (L,)."""
    return np.asarray(np.einsum("li,li->l", error, np.linalg.solve(_blocks(joint), error[..., None])[..., 0]))


def _conditioned(error: np.ndarray, joint: np.ndarray, loop: int) -> tuple[np.ndarray, np.ndarray]:
    """What is left of the errors and their covariance when a loop is used."""
    gain = np.linalg.solve(joint[_part(loop), _part(loop)], joint[_part(loop)]).T
    left = error.ravel() - gain @ error[loop]
    return left.reshape(error.shape), joint - gain @ joint[_part(loop)]


def _grow(error: np.ndarray, joint: np.ndarray, seed: int, gate: float) -> np.ndarray:
    """The set (L,) bool that takes in the next best loop until none passes the gate; empty if the seed does not."""
    used = np.zeros(len(error), bool)
    following, distance = seed, _distances(error, joint)
    noise = 1e-9 * np.diag(joint)
    while distance[following] <= gate:
        used[following] = True
        if used.all():
            break
        error, joint = _conditioned(error, joint, following)
        joint[np.diag_indices_from(joint)] += noise
        distance = np.where(used, np.inf, _distances(error, joint))
        following = int(np.argmin(distance))
    return used


def _value(error: np.ndarray, joint: np.ndarray, used: np.ndarray, gate: float) -> float:
    """What a set of loops costs, refused ones included."""
    pick = np.flatnonzero(np.repeat(used, 6))
    e = error.ravel()[pick]
    cost = float(e @ np.linalg.solve(joint[np.ix_(pick, pick)], e)) if len(pick) else 0.0
    return cost + gate * float(np.count_nonzero(~used))


def _beside(error: np.ndarray, joint: np.ndarray, used: np.ndarray) -> np.ndarray:
    """What each loop costs beside the used ones, without itself among these, (L,)."""
    pick, rest = (np.flatnonzero(np.repeat(which, 6)) for which in (used, ~used))
    inverse = np.linalg.inv(joint[np.ix_(pick, pick)])
    pull = inverse @ error.ravel()[pick]
    distance = np.zeros(len(error))
    distance[used] = _distances(pull.reshape(-1, 6), inverse) if len(pick) else 0.0
    gain = joint[np.ix_(rest, pick)] @ inverse
    left = error.ravel()[rest] - gain @ error.ravel()[pick]
    covariance = joint[np.ix_(rest, rest)] - gain @ joint[np.ix_(pick, rest)]
    distance[~used] = _distances(left.reshape(-1, 6), covariance) if len(rest) else 0.0
    return distance
