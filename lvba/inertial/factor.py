"""The inertial factor: scans move from each to the next as the IMU felt it.

Beside the poses of the scans it has unknowns of its own: the velocity at each scan, and what all share: biases of
gyroscope and accelerometer, gravity, and small errors of extrinsic and clock. These are solved for at each evaluation and
eliminated from the normal equations, so that to a solver this is one more term over poses. Gravity is free but for its
length: which way is down is a result, and the world frame may be any.
Source: Forster et al. 2017, section VII, for residuals and their derivatives.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from lvba import geometry
from lvba.arrays import Pose, PoseBlocks, Poses, Times
from lvba.inertial import preintegration
from lvba.inertial.preintegration import Preintegration
from lvba.inertial.readings import GRAVITY, ImuReadings
from lvba.optim import normal_equations
from lvba.optim.normal_equations import NormalEquations

GYROSCOPE, ACCELEROMETER, DOWN, LEVER, TURN = (slice(at, at + 3) for at in range(0, 15, 3))
OFFSET = slice(15, 16)
"""Where the shared unknowns are among their 16 numbers: biases (rad/s, m/s^2), gravity (m/s^2, world axes), what the
IMU is off its place (m, scan axes), its axes are turned (rad, own axes), and its clock is ahead (s)."""
SHARED = 16
PRIOR_SIGMA = np.append(np.repeat([0.02, 0.2, np.inf, 0.05, 0.02], 3), 0.01)
"""rad/s and m/s^2: MEMS without calibration (data sheets: 1 deg/s, 20 mg); m and rad: of an extrinsic; s: of clocks that
drivers hold together."""
_GRAVITY_SIGMA = 0.03
"""m/s^2: its length by latitude and height."""
_LEAST_TURN, _LEAST_STEP = 5e-4, 1e-3
"""rad and m: no motion between scans is believed to be known better from these alone: deskewing leaves as much."""
_ROTATION, _VELOCITY, _POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
_VELOCITY_SIGMA = 100.0
"""m/s: of scans without readings before and after."""
_ABOUT, _FARTHEST_S = 3, 0.03
"""Preintegrations, each about the biases and the offset (s) of the one before: derivatives by them are of first order."""
_STEPS = 4
"""Gauss-Newton of velocities and shared unknowns: linear but for turns of a few mrad."""


@dataclass(frozen=True)
class InertialState:
    """What the factor solves for beside given poses.

    velocity: (S, 3) float64, m/s, world axes, of the IMU; shared: (16,) float64, see GYROSCOPE and the other slices
    shared_covariance: (16, 16), if the poses were exact
    squares: (K, 3), squared normalized residuals of rotation, velocity and position of each motion
    cost: half the sum of all squares, with those of the priors
    """

    velocity: np.ndarray
    shared: np.ndarray
    shared_covariance: np.ndarray
    squares: np.ndarray
    cost: float


@dataclass(frozen=True)
class InertialFactor:
    """Motions between scans, and how they are weighed.

    whitening: (K, 9, 9), of the residuals [rotation | velocity | position]; scan_from_imu: (4, 4), as far as known
    start: (16,) shared unknowns to begin with
    """

    measured: Preintegration
    whitening: np.ndarray
    scan_from_imu: np.ndarray
    start: np.ndarray

    def cost(self, world_from_scan: Poses) -> float:
        """Half the sum of squared normalized residuals at poses (S, 4, 4), all else at its best."""
        return self.solve(world_from_scan).cost

    def linearize(self, world_from_scan: Poses) -> NormalEquations:
        """The normal equations at poses (S, 4, 4), Gauss-Newton, all else eliminated: blocks of all pairs."""
        state = self.solve(world_from_scan)
        rows = self._rows(world_from_scan, state.velocity, state.shared)
        inner = _Inner.of(rows, self.measured.first, len(world_from_scan), state.shared)
        hessian, gradient = _without_inner(rows, self.measured.first, len(world_from_scan), inner)
        return normal_equations.from_dense(hessian, gradient, state.cost)

    def solve(self, world_from_scan: Poses) -> InertialState:
        """Velocities and shared unknowns of least cost at poses (S, 4, 4)."""
        scans, first = len(world_from_scan), self.measured.first
        velocity, shared = np.zeros((scans, 3)), self.start.copy()
        for _ in range(_STEPS):
            inner = _Inner.of(self._rows(world_from_scan, velocity, shared), first, scans, shared, velocity)
            by_velocity, by_shared = inner.step()
            velocity, shared = velocity + by_velocity, shared + by_shared
        rows = self._rows(world_from_scan, velocity, shared)
        squares = np.square(rows.residual).reshape(-1, 3, 3).sum(2)
        pulls = np.square(_prior(shared)[0]).sum() + np.square(velocity / _VELOCITY_SIGMA).sum()
        return InertialState(
            velocity=velocity,
            shared=shared,
            shared_covariance=np.linalg.inv(inner.shared_hessian),
            squares=squares,
            cost=0.5 * float(squares.sum() + pulls),
        )

    def with_variance_factors(self, rotation: float, force: float) -> "InertialFactor":
        """The factor with its variances of rotations, and of velocities and positions, multiplied."""
        wider = np.repeat(np.sqrt([rotation, force, force]), 3)
        return replace(self, whitening=self.whitening / wider)

    def beside(self, step_covariance: PoseBlocks) -> "InertialFactor":
        """The factor weighed for poses that it has no part in: their own errors count too.

        step_covariance: (S - 1, 6, 6), of the motion from each scan to the next, in the later one's tangent
        """
        turn, seconds = self.scan_from_imu[:3, :3], self.measured.seconds[:, None, None]
        step = step_covariance[self.measured.first]
        rotation = turn.T @ step[:, :3, :3] @ turn + _LEAST_TURN**2 * np.eye(3)
        place = turn.T @ step[:, 3:, 3:] @ turn + _LEAST_STEP**2 * np.eye(3)
        # a tilt makes a part of gravity of an acceleration
        tilt = np.trace(rotation, axis1=1, axis2=2)[:, None, None] / 3 * GRAVITY**2 * np.eye(3)
        total = preintegration.covariance(self.measured)
        total[:, _ROTATION, _ROTATION] += rotation
        total[:, _VELOCITY, _VELOCITY] += tilt * seconds**2
        total[:, _POSITION, _POSITION] += place + 0.25 * tilt * seconds**4
        across = 0.5 * tilt * seconds**3
        total[:, _VELOCITY, _POSITION] += across
        total[:, _POSITION, _VELOCITY] += across
        return replace(self, whitening=_whitening(total))

    def _rows(self, world_from_scan: np.ndarray, velocity: np.ndarray, shared: np.ndarray) -> "_Rows":
        return _rows(self, world_from_scan, velocity, shared).whitened(self.whitening)


def factor(
    readings: ImuReadings,
    times: Times,
    world_from_scan: Poses,
    scan_from_imu: Pose | None = None,
    step_covariance: PoseBlocks | None = None,
) -> InertialFactor | None:
    """The factor between scans at these times (S,), with poses (S, 4, 4) near the solution; None: no two scans have
    readings between.

    readings: in SI units, on the clock of `times` (s)
    step_covariance: as in `InertialFactor.beside`, of these poses; None: they are exact
    """
    extrinsic = np.eye(4) if scan_from_imu is None else np.asarray(scan_from_imu, float)
    bias, offset, built = np.zeros(6), 0.0, None
    for _ in range(_ABOUT):
        measured = preintegration.preintegrate(readings, times, bias, offset)
        if not len(measured):
            return None
        whitening = _whitening(preintegration.covariance(measured))
        start = np.concatenate([bias, _down(measured, world_from_scan @ extrinsic), np.zeros(6), [offset]])
        built = InertialFactor(measured, whitening, extrinsic, start)
        weighed = built if step_covariance is None else built.beside(step_covariance)
        shared = weighed.solve(world_from_scan).shared
        bias, offset = (
            shared[:6],
            float(np.clip(shared[OFFSET][0], offset - _FARTHEST_S, offset + _FARTHEST_S)),
        )
    return built


def _whitening(covariance: np.ndarray) -> np.ndarray:
    """(K, 9, 9): what makes residuals of covariances (K, 9, 9) independent and of variance 1."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _down(measured: Preintegration, world_from_imu: np.ndarray) -> np.ndarray:
    """(3,), m/s^2, world axes: gravity, were the mean of all accelerations zero."""
    felt = np.einsum("kij,kj->i", world_from_imu[measured.first, :3, :3], measured.motions.velocity)
    return np.asarray(-GRAVITY * felt / max(float(np.linalg.norm(felt)), 1e-9))


@dataclass(frozen=True)
class _Rows:
    """Residuals (K, 9) and their Jacobians, by poses (K, 9, 6), velocities (K, 9, 3) and shared unknowns (K, 9, 16)."""

    residual: np.ndarray
    by_earlier: np.ndarray
    by_later: np.ndarray
    by_velocity: np.ndarray
    by_later_velocity: np.ndarray
    by_shared: np.ndarray

    @classmethod
    def constant(cls, residual: np.ndarray) -> "_Rows":
        """With Jacobians of zeros."""
        count = len(residual)
        return cls(
            residual=residual,
            by_earlier=np.zeros((count, 9, 6)),
            by_later=np.zeros((count, 9, 6)),
            by_velocity=np.zeros((count, 9, 3)),
            by_later_velocity=np.zeros((count, 9, 3)),
            by_shared=np.zeros((count, 9, SHARED)),
        )

    def whitened(self, whitening: np.ndarray) -> "_Rows":
        return _Rows(
            residual=np.einsum("kab,kb->ka", whitening, self.residual),
            by_earlier=whitening @ self.by_earlier,
            by_later=whitening @ self.by_later,
            by_velocity=whitening @ self.by_velocity,
            by_later_velocity=whitening @ self.by_later_velocity,
            by_shared=whitening @ self.by_shared,
        )


def _rows(
    given: InertialFactor, world_from_scan: np.ndarray, velocity: np.ndarray, shared: np.ndarray
) -> _Rows:
    """Residuals and Jacobians in rad, m/s and m, in the axes of the IMU at the earlier scan; rotations at the later."""
    first, seconds, motions = given.measured.first, given.measured.seconds[:, None], given.measured.motions
    imu_axes = given.scan_from_imu[:3, :3] @ geometry.exp(np.r_[shared[TURN], np.zeros(3)])[:3, :3]
    lever = given.scan_from_imu[:3, 3] + shared[LEVER]
    scan, later = world_from_scan[first, :3, :3], world_from_scan[first + 1, :3, :3]
    positions = world_from_scan[:, :3, 3] + world_from_scan[:, :3, :3] @ lever
    own = np.swapaxes(scan @ imu_axes, -1, -2)  # imu from world at the earlier scan
    bias = shared[:6] - given.measured.bias
    by_bias, by_offset = motions.by_bias, given.measured.by_offset
    expected = np.einsum("kab,b->ka", by_bias, bias)
    gained = velocity[first + 1] - velocity[first] - shared[DOWN] * seconds
    moved = positions[first + 1] - positions[first] - velocity[first] * seconds
    moved -= 0.5 * shared[DOWN] * seconds**2
    felt, way = np.einsum("kij,kj->ki", own, gained), np.einsum("kij,kj->ki", own, moved)
    expected = expected + by_offset * (shared[OFFSET] - given.measured.offset)
    turned = motions.rotation @ geometry.exp(np.pad(expected[:, :3], ((0, 0), (0, 3))))[:, :3, :3]
    relative = own @ later @ imu_axes
    off = geometry.from_rotation_translation(np.swapaxes(turned, -1, -2) @ relative, np.zeros(3))
    rotation = geometry.log(off)[:, :3]
    residual = np.concatenate(
        [rotation, felt - motions.velocity - expected[:, 3:6], way - motions.position - expected[:, 6:]],
        axis=1,
    )

    rows, eye = _Rows.constant(residual), np.eye(3)
    back, into = np.swapaxes(relative, -1, -2), geometry.inverse_right_jacobian(rotation)
    by_earlier, by_later, by_shared = rows.by_earlier, rows.by_later, rows.by_shared
    by_earlier[:, _ROTATION, :3] = -into @ back @ imu_axes.T
    by_later[:, _ROTATION, :3] = into @ imu_axes.T
    by_earlier[:, _VELOCITY, :3] = geometry.hat(felt) @ imu_axes.T
    by_earlier[:, _POSITION, :3] = geometry.hat(way) @ imu_axes.T + own @ scan @ geometry.hat(lever)
    by_later[:, _POSITION, :3] = -own @ later @ geometry.hat(lever)
    by_earlier[:, _POSITION, 3:] = -own @ scan
    by_later[:, _POSITION, 3:] = own @ later
    rows.by_velocity[:, _VELOCITY], rows.by_later_velocity[:, _VELOCITY] = -own, own
    rows.by_velocity[:, _POSITION] = -own * seconds[..., None]
    by_shared[:, _VELOCITY, DOWN] = -own * seconds[..., None]
    by_shared[:, _POSITION, DOWN] = -0.5 * own * seconds[..., None] ** 2
    by_shared[:, _POSITION, LEVER] = own @ (later - scan)
    by_shared[:, _ROTATION, TURN] = into @ (eye - back)
    by_shared[:, _VELOCITY, TURN], by_shared[:, _POSITION, TURN] = geometry.hat(felt), geometry.hat(way)
    # of second order in the biases beyond those of the preintegration
    right = eye - 0.5 * geometry.hat(expected[:, :3])
    by_both = np.concatenate([by_bias, by_offset[:, :, None]], axis=2)
    by_both[:, :3] = into @ np.swapaxes(off[:, :3, :3], -1, -2) @ right @ by_both[:, :3]
    by_shared[:, :, :6], by_shared[:, :, OFFSET] = -by_both[:, :, :6], -by_both[:, :, 6:]
    return rows


def _prior(shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalized residuals (17,) of what is known of the shared unknowns (16,), and their Jacobian (17, 16)."""
    length = float(np.linalg.norm(shared[DOWN]))
    residual = np.append(shared / PRIOR_SIGMA, (length - GRAVITY) / _GRAVITY_SIGMA)
    jacobian = np.zeros((SHARED + 1, SHARED))
    jacobian[:SHARED] = np.diag(1.0 / PRIOR_SIGMA)
    jacobian[SHARED, DOWN] = shared[DOWN] / max(length, 1e-9) / _GRAVITY_SIGMA
    return residual, jacobian


def _transposed_product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(np.swapaxes(one, -1, -2) @ other)


@dataclass(frozen=True)
class _Inner:
    """Normal equations of velocities and shared unknowns.

    banded: Cholesky factor of the velocities' Hessian, (6, 3 S); coupling: (3 S, 16); by_coupling: (3 S, 16), the inverse
    of that Hessian times it; shared_hessian: (16, 16), velocities eliminated
    """

    banded: np.ndarray
    coupling: np.ndarray
    by_coupling: np.ndarray
    shared_hessian: np.ndarray
    velocity_gradient: np.ndarray
    shared_gradient: np.ndarray

    @classmethod
    def of(
        cls,
        rows: _Rows,
        first: np.ndarray,
        scans: int,
        shared: np.ndarray,
        velocity: np.ndarray | None = None,
    ) -> "_Inner":
        one, two, by_shared = rows.by_velocity, rows.by_later_velocity, rows.by_shared
        diagonal, beside = np.zeros((scans, 3, 3)), np.zeros((scans, 3, 3))
        diagonal += np.eye(3) / _VELOCITY_SIGMA**2
        diagonal[first] += _transposed_product(one, one)
        diagonal[first + 1] += _transposed_product(two, two)
        beside[first] = _transposed_product(one, two)
        coupling, gradient = np.zeros((scans, 3, SHARED)), np.zeros((scans, 3))
        coupling[first] += _transposed_product(one, by_shared)
        coupling[first + 1] += _transposed_product(two, by_shared)
        gradient[first] += np.einsum("kab,ka->kb", one, rows.residual)
        gradient[first + 1] += np.einsum("kab,ka->kb", two, rows.residual)
        if velocity is not None:
            gradient += velocity / _VELOCITY_SIGMA**2
        banded = scipy.linalg.cholesky_banded(_band(diagonal, beside), check_finite=False)
        pulls, by_pull = _prior(shared)
        all_of_them = coupling.reshape(-1, SHARED)
        by_coupling = scipy.linalg.cho_solve_banded((banded, False), all_of_them, check_finite=False)
        own = np.einsum("kai,kaj->ij", by_shared, by_shared) + by_pull.T @ by_pull
        return cls(
            banded=banded,
            coupling=all_of_them,
            by_coupling=by_coupling,
            shared_hessian=own - all_of_them.T @ by_coupling,
            velocity_gradient=gradient.ravel(),
            shared_gradient=np.einsum("kai,ka->i", by_shared, rows.residual) + by_pull.T @ pulls,
        )

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton's, of velocities (S, 3) and shared unknowns (16,)."""
        alone = self.solved(self.velocity_gradient)
        shared = -np.linalg.solve(self.shared_hessian, self.shared_gradient - self.coupling.T @ alone)
        return (-alone - self.by_coupling @ shared).reshape(-1, 3), shared

    def solved(self, right: np.ndarray) -> np.ndarray:
        """The inverse of the velocities' Hessian times (3 S, ...)."""
        return np.asarray(scipy.linalg.cho_solve_banded((self.banded, False), right, check_finite=False))


def _band(diagonal: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """(6, 3 S): a block-tridiagonal matrix of blocks (S, 3, 3) as `scipy.linalg.cholesky_banded` takes it."""
    band = np.zeros((6, 3 * len(diagonal)))
    for row in range(3):
        for column in range(3):
            if row <= column:
                band[5 + row - column, column::3] = diagonal[:, row, column]
            band[2 + row - column, 3 + column :: 3] = beside[:-1, row, column]
    return band


def _without_inner(
    rows: _Rows, first: np.ndarray, scans: int, inner: _Inner
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (6 S, 6 S) and gradient (S, 6) of the poses, where velocities and shared unknowns are at their best."""
    both = first[:, None] + np.arange(2)
    by_poses = np.stack([rows.by_earlier, rows.by_later], axis=1)
    by_velocities = np.stack([rows.by_velocity, rows.by_later_velocity], axis=1)
    hessian, across = np.zeros((scans, 6, scans, 6)), np.zeros((scans, 3, scans, 6))
    with_shared, gradient = np.zeros((scans, 6, SHARED)), np.zeros((scans, 6))
    for one in range(2):
        # no scan is the earlier one of two motions, nor the later one
        mine = both[:, one]
        gradient[mine] += np.einsum("kab,ka->kb", by_poses[:, one], rows.residual)
        with_shared[mine] += _transposed_product(by_poses[:, one], rows.by_shared)
        for two in range(2):
            other = both[:, two]
            hessian[mine, :, other] += _transposed_product(by_poses[:, one], by_poses[:, two])
            across[mine, :, other] += _transposed_product(by_velocities[:, one], by_poses[:, two])
    coupling = across.reshape(3 * scans, -1)
    whole = hessian.reshape(6 * scans, -1) - coupling.T @ inner.solved(coupling)
    shared = with_shared.reshape(-1, SHARED) - coupling.T @ inner.by_coupling
    whole -= shared @ np.linalg.solve(inner.shared_hessian, shared.T)
    return 0.5 * (whole + whole.T), gradient
