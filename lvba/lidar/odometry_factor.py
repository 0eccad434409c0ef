"""The odometry prior: neighbouring scans stay about as far apart as the rough poses say.

It decides only what planes leave open. Where they determine a direction, they outweigh it by orders of magnitude.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Poses, Times
from lvba.optim import pose_graph
from lvba.optim.normal_equations import NormalEquations
from lvba.optim.pose_graph import Edges
from lvba.trajectory import gaps

_FEWEST_STEPS = 10
_KINDS = 3
"""Steps that turn alike are a part of all: one of so many."""
_CEILING = 4.0
"""Times what is expected of a step that its standard deviation is estimated at most."""
_FLOOR_ROTATION, _FLOOR_TRANSLATION = 2e-4, 1e-3
"""rad and m: no odometry is taken for better than this from scan to scan."""
_ORDINARY = 3.0
"""Standard deviations, root mean square over three axes, by which a step is off at most; one of 200,000 by chance."""
JUMP = np.diag(np.repeat([np.radians(4.0), 0.6], 3) ** -2.0)
"""(6, 6), information of a step of which nothing is known yet."""


@dataclass(frozen=True)
class OdometryPrior:
    """Relative poses of neighbouring scans, S - 1 factors: edges of a pose graph that is a chain.

    next_from_previous is measured as previous_from_next: (S - 1, 4, 4)
    information: (S - 1, 6, 6), of the local tangent [rotation | translation] at the later scan
    ceiling: (6,), rad and m, standard deviations of a step that no estimate exceeds
    jumps: (K,) int64, steps that the odometry knows nothing of: they say nothing of the others, and stay uncertain
    spans: (S - 1,) float64, times the usual time that a step takes, for as long an odometry drifts; 1: usual; None: all
        are
    """

    previous_from_next: np.ndarray
    information: np.ndarray
    ceiling: np.ndarray
    jumps: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    spans: np.ndarray | None = None

    def cost(self, world_from_scan: Poses) -> float:
        """Half the sum of squared normalized residuals."""
        return pose_graph.cost(self.residuals(world_from_scan), self._edges())

    def residuals(self, world_from_scan: Poses) -> np.ndarray:
        """(S - 1, 6), rad and m, of poses (S, 4, 4); see `pose_graph.residuals`."""
        return pose_graph.residuals(world_from_scan, self._edges())

    def linearize(self, world_from_scan: Poses) -> NormalEquations:
        """The normal equations at poses (S, 4, 4); Gauss-Newton."""
        return pose_graph.linearize(world_from_scan, self._edges())

    def among(self, members: Indices) -> "OdometryPrior":
        """Of successive scans (n,) int64."""
        steps = members[:-1]
        return replace(
            self,
            previous_from_next=self.previous_from_next[steps],
            information=self.information[steps],
            jumps=np.flatnonzero(np.isin(steps, self.jumps)),
            spans=None if self.spans is None else self.spans[steps],
        )

    def _edges(self) -> Edges:
        earlier = np.arange(len(self.information))
        return Edges(
            first=earlier,
            second=earlier + 1,
            first_from_second=self.previous_from_next,
            information=self.information,
            is_loop=np.zeros(len(earlier), bool),
        )


def odometry_prior(world_from_scan: Poses, sigma_rotation: float, sigma_translation: float) -> OdometryPrior:
    """The prior of rough poses (S, 4, 4) with standard deviations (rad, m) of one step."""
    sigmas = np.repeat([sigma_rotation, sigma_translation], 3)
    steps = geometry.steps(world_from_scan)
    information = np.broadcast_to(np.diag(sigmas**-2), (len(steps), 6, 6)).copy()
    return OdometryPrior(steps, information, sigmas)


def with_jumps(prior: OdometryPrior, jumps: Indices, world_from_scan: Poses) -> OdometryPrior:
    """The prior with some steps (K,) int64 as poses (S, 4, 4) have them, and hardly held there."""
    return replace(_as_poses(prior, jumps, world_from_scan, JUMP), jumps=np.asarray(jumps))


def with_motions(
    prior: OdometryPrior,
    steps: Indices,
    world_from_scan: Poses,
    sigma_rotation: float,
    sigma_translation: float,
) -> OdometryPrior:
    """The prior with some steps (K,) int64 as poses (S, 4, 4) have them, with standard deviations (rad, m) of their own.

    Two kinds of steps err by different amounts: the fewer ones say nothing of the others.
    """
    if not len(steps):
        return prior
    information = np.diag(np.repeat([sigma_rotation, sigma_translation], 3) ** -2.0)
    others = np.setdiff1d(np.arange(len(prior.information)), steps)
    fewer = steps if len(steps) < len(others) else others
    held = _as_poses(prior, steps, world_from_scan, information)
    return replace(held, jumps=np.union1d(prior.jumps, fewer))


def _as_poses(
    prior: OdometryPrior, steps: Indices, world_from_scan: Poses, information: np.ndarray
) -> OdometryPrior:
    """The prior with some steps (K,) int64 as poses (S, 4, 4) have them, of so much information (6, 6) each."""
    motions, known = prior.previous_from_next.copy(), prior.information.copy()
    motions[steps] = geometry.inverse(world_from_scan[steps]) @ world_from_scan[steps + 1]
    known[steps] = information
    return replace(prior, previous_from_next=motions, information=known)


def with_pauses(prior: OdometryPrior, times: Times) -> OdometryPrior:
    """The prior of scans at times (S,) s with steps that take much longer than usual as uncertain as the odometry may
    drift in so long a time; as it is where there is none."""
    long, interval = gaps(times), np.diff(times)
    long[prior.jumps] = False
    if not long.any():
        return prior
    spans = np.where(long, interval / np.median(interval), 1.0)
    information = prior.information / spans[:, None, None] ** 2
    return replace(prior, information=information, spans=spans)


def reestimated(prior: OdometryPrior, world_from_scan: Poses, held: np.ndarray) -> OdometryPrior:
    """The prior with the standard deviations that its errors at refined poses (S, 4, 4) show; robust (median).

    Steps that are off by far hold nothing: an odometry that is right to a millimeter may have begun with a wrong speed.
    In a street, steps that were 20 mm off drew the first scans 8 mm along it.
    held: (S,) bool, scans that planes hold in every direction: only steps between two of these tell how wrong the
        odometry is; where they are few the prior stays as it is
    """
    ordinary, telling = _telling(prior, held)
    if np.count_nonzero(telling) < _FEWEST_STEPS:
        return prior
    error = np.abs(prior.residuals(world_from_scan))
    sigma = _as_off(prior, _sigmas(error[None, telling]), error, telling, prior.ceiling)
    return _with_sigmas(prior, sigma, ordinary)


def by_turns(prior: OdometryPrior, world_from_scan: Poses, held: np.ndarray) -> OdometryPrior:
    """The same for expected errors, each step as steps with turns like its own show, whatever was expected of it.

    An odometry errs more where the sensor turns more, which is where scans lose planes and depend on it. Solved by this
    prior, scans that hang on it follow whatever else there is: of nine rooms, one frame came off by 14 cm.
    world_from_scan, held: as of `reestimated`
    """
    ordinary, telling = _telling(prior, held)
    if np.count_nonzero(telling) < _FEWEST_STEPS:
        return prior
    # not of the rough poses: where these hardly turn, their errors would be taken for turns
    turn = geometry.rotation_angle_deg(geometry.steps(world_from_scan))
    error = np.abs(prior.residuals(world_from_scan))
    by_turn = _by_turn(turn, turn[telling], error[telling])
    return _with_sigmas(prior, _as_off(prior, by_turn, error, telling, _CEILING * prior.ceiling), ordinary)


def _as_off(
    prior: OdometryPrior, sigma: np.ndarray, error: np.ndarray, telling: np.ndarray, most: np.ndarray
) -> np.ndarray:
    """(S - 1, 6), rad and m, no more than `most`, (6,): standard deviations (S - 1 or 1, 6) of steps of the usual time,
    larger for telling ones (S - 1,) bool with errors (S - 1, 6) that are too large for them: so much that they hardly
    draw the scans any more.

    Of other steps, errors may be those of the poses.
    """
    sigma, spans = np.minimum(sigma, most), 1.0 if prior.spans is None else prior.spans[:, None]
    size = np.sqrt(np.square(error / (sigma * spans)).reshape(len(error), 2, 3).mean(axis=2))
    factor = np.where(telling[:, None], np.maximum(size / _ORDINARY, 1.0) ** 2, 1.0)
    return np.asarray(np.minimum(sigma * np.repeat(factor, 3, axis=1), most))


def _telling(prior: OdometryPrior, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S - 1,) bool each: steps that are no jumps, and those of them that tell how wrong the odometry is."""
    ordinary = np.ones(len(prior.information), bool)
    ordinary[prior.jumps] = False
    telling = held[1:] & held[:-1] & ordinary
    return ordinary, telling if prior.spans is None else telling & (prior.spans == 1)


def _with_sigmas(prior: OdometryPrior, sigma: np.ndarray, steps: np.ndarray) -> OdometryPrior:
    """The prior with standard deviations (S - 1, 6) of some steps (S - 1,) bool."""
    information = prior.information.copy()
    sigma = sigma if prior.spans is None else sigma * prior.spans[:, None]
    information[steps] = (sigma**-2)[steps][:, :, None] * np.eye(6)
    return replace(prior, information=information)


def _sigmas(error: np.ndarray) -> np.ndarray:
    """(N, 6), rad and m: standard deviations of errors (N, n, 6), sizes; robust (median)."""
    parts = [1.4826 * np.median(error[:, :, part], axis=(1, 2)) for part in (slice(3), slice(3, 6))]
    return np.repeat(np.maximum(np.stack(parts, axis=1), [_FLOOR_ROTATION, _FLOOR_TRANSLATION]), 3, axis=1)


def _by_turn(turn: np.ndarray, known: np.ndarray, error: np.ndarray) -> np.ndarray:
    """(S - 1, 6), rad and m: standard deviations of steps that turn by so much (S - 1,) degrees.

    known: (n,) degrees, turns of steps with these errors (n, 6), sizes
    """
    order = np.argsort(known, kind="stable")
    like = max(_FEWEST_STEPS, len(known) // _KINDS)
    first = np.clip(np.searchsorted(known[order], turn) - like // 2, 0, len(known) - like)
    return _sigmas(error[order][first[:, None] + np.arange(like)])
