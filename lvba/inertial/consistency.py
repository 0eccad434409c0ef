"""Whether what an IMU felt and how planes have the scans move can both be true; if not, it is not used.

Wrong axes, units, clocks or extrinsics make a factor that contradicts the planes by far more than both predict. Small
offsets of extrinsic and clock, and biases, are unknowns of the factor; what is left makes its variances larger.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lvba.arrays import PoseBlocks, Poses
from lvba.inertial import factor as factors
from lvba.inertial.factor import (
    ACCELEROMETER,
    DOWN,
    GYROSCOPE,
    LEVER,
    OFFSET,
    PRIOR_SIGMA,
    TURN,
    InertialFactor,
    InertialState,
)
from lvba.inertial.readings import GRAVITY, Imu, in_si_units

_FEWEST = 5
"""Motions between scans that planes hold, to judge by."""
_CHANCE, _MOST = 0.79, 3.0
"""Median of the squares of rotations over their degrees of freedom: of a chi-square of three, over three; and at most.
The median, for a few scans may be off by more than their planes predict."""
_MOST_AFTER = 4.0
"""Mean of the squares over their degrees of freedom, of rotations, velocities or positions, where planes and the IMU
agree as well as they can."""
_PULL = 4.0
"""Standard deviations that an unknown may be from what is known of it."""
_UNKNOWNS = (
    (GYROSCOPE, "its gyroscope would have a bias of {:.2g} rad/s"),
    (ACCELEROMETER, "its accelerometer would have a bias of {:.2g} m/s^2"),
    (LEVER, "it would be {:.2g} m off its place"),
    (TURN, "its axes would be turned by {:.2g} rad"),
    (OFFSET, "its clock would be {:.2g} s off"),
)


@dataclass(frozen=True)
class Judged:
    """factor: to be used, None: not. problem: why it is not. rotation, force: what its variances were multiplied by"""

    factor: InertialFactor | None
    problem: str = ""
    rotation: float = 1.0
    force: float = 1.0


@dataclass(frozen=True)
class InertialResult:
    """What an IMU said beside refined poses.

    problem: why it is not used; motions: between scans, how many there are readings of
    shared, sigma: (16,) float64, see `factor.GYROSCOPE` and the other slices, and their standard deviations, if the poses
        were exact
    rotation, force: what its variances were multiplied by
    """

    used: bool
    problem: str = ""
    motions: int = 0
    shared: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sigma: np.ndarray = field(default_factory=lambda: np.zeros(0))
    down_covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) float64, of gravity, likewise."""
    tilt_sigma: float = np.inf
    """rad, of the direction of gravity about each horizontal axis, with the uncertainty of the scans' rotations."""
    rotation: float = 1.0
    force: float = 1.0

    def among(self, covariance: PoseBlocks) -> "InertialResult":
        """The same beside poses of these covariances (S, 6, 6)."""
        if not self.used:
            return self
        down = self.shared[DOWN] / np.linalg.norm(self.shared[DOWN])
        across = np.eye(3) - np.outer(down, down)
        alone = np.trace(across @ self.down_covariance @ across) / 2 / GRAVITY**2
        turned = np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean() / 3
        return replace(self, tilt_sigma=float(np.sqrt(alone + turned)))

    def facts(self) -> dict[str, Any]:
        """For the report: which way is down, and what the IMU is off by."""
        if not self.used:
            return {"used": False, "problem": self.problem}
        down = self.shared[DOWN] / np.linalg.norm(self.shared[DOWN])
        named = {
            "gyroscope_bias": GYROSCOPE,
            "accelerometer_bias": ACCELEROMETER,
            "lever_m": LEVER,
            "turn_rad": TURN,
            "clock_s": OFFSET,
        }
        return {
            "used": True,
            "motions": self.motions,
            "down": down,
            "tilt_deg": float(np.degrees(np.arccos(np.clip(-down[2], -1.0, 1.0)))),
            "tilt_sigma_deg": float(np.degrees(self.tilt_sigma)),
            "values": {name: self.shared[part] for name, part in named.items()},
            "sigma": {name: self.sigma[part] for name, part in named.items()},
            "variance_factors": {"rotation": self.rotation, "force": self.force},
        }


MOST_SCANS = 600
"""More together are solved without the IMU: its equations couple all, which takes memory and time as the square and the
cube of the scans."""


def built(imu: Imu, world_from_scan: Poses, step_covariance: PoseBlocks) -> Judged:
    """The factor of an IMU about poses (S, 4, 4), where it can be used at all; step_covariance: as in `before`."""
    readings = in_si_units(imu.readings)
    if readings is None:
        return Judged(None, "what its accelerometer feels is gravity neither in m/s^2 nor in g")
    factor = factors.factor(readings, imu.scan_times, world_from_scan, imu.scan_from_imu, step_covariance)
    if factor is None:
        return Judged(None, "there are no readings from one scan to the next")
    return Judged(factor)


def before(
    factor: InertialFactor, world_from_scan: Poses, step_covariance: PoseBlocks, held: np.ndarray
) -> Judged:
    """By poses (S, 4, 4) that the IMU had no part in: by how it turns, and by what must be wrong for it to fit.

    step_covariance: (S - 1, 6, 6), of the motion from each scan to the next, in the later one's tangent
    held: (S,) bool, scans that planes hold in every direction
    """
    first = factor.measured.first
    motions = held[first] & held[first + 1]
    if np.count_nonzero(motions) < _FEWEST:
        return Judged(None, "planes hold too few scans to check it by")
    state = factor.beside(step_covariance).solve(world_from_scan)
    median = float(np.median(state.squares[motions, 0])) / 3
    if median > _MOST:
        deviations = np.sqrt(median / _CHANCE)
        problem = f"its rotations differ from those by the planes by {deviations:.1f} standard deviations"
        return Judged(None, _with_pulls(problem, state))
    if pulls := _pulls(state):
        return Judged(None, pulls)
    wider = max(1.0, median / _CHANCE)
    return Judged(factor.with_variance_factors(wider, 1.0), rotation=wider)


def after(judged: Judged, world_from_scan: Poses) -> Judged:
    """By poses (S, 4, 4) at which planes and the IMU converged; variances grow where they have to."""
    assert judged.factor is not None
    state = judged.factor.solve(world_from_scan)
    rotation, *force = (float(mean) for mean in state.squares.mean(axis=0) / 3)
    worst = max(rotation, *force)
    if worst > _MOST_AFTER:
        return Judged(
            None, _with_pulls(f"it contradicts the planes by {np.sqrt(worst):.1f} standard deviations", state)
        )
    if pulls := _pulls(state):
        return Judged(None, pulls)
    turned, felt = max(1.0, rotation), max(1.0, *force)
    return replace(
        judged,
        factor=judged.factor.with_variance_factors(turned, felt),
        rotation=judged.rotation * turned,
        force=judged.force * felt,
    )


def result(judged: Judged, world_from_scan: Poses) -> InertialResult:
    """What is known at poses (S, 4, 4) that the factor had a part in."""
    assert judged.factor is not None
    state = judged.factor.solve(world_from_scan)
    return InertialResult(
        used=True,
        motions=len(judged.factor.measured),
        shared=state.shared,
        sigma=np.sqrt(np.diagonal(state.shared_covariance)),
        down_covariance=state.shared_covariance[DOWN, DOWN],
        rotation=judged.rotation,
        force=judged.force,
    )


def _pulls(state: InertialState) -> str:
    """What would have to be wrong by more than can be, empty: nothing."""
    for part, text in _UNKNOWNS:
        value = state.shared[part]
        if np.abs(value / PRIOR_SIGMA[part]).max() > _PULL:
            return text.format(float(np.linalg.norm(value)))
    return ""


def _with_pulls(problem: str, state: InertialState) -> str:
    pulls = _pulls(state)
    return f"{problem}; {pulls}" if pulls else problem
