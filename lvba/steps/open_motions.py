"""Motions that planes leave open for all scans, as along a corridor: what of a pose's error is along them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import PoseBlocks, Poses
from lvba.lidar.degeneracy import DegenerateDirection

_LITTLE = 0.1
"""Of a degenerate direction, in sigmas of the odometry: a turn that is no part of it."""


@dataclass(frozen=True)
class OpenMotions:
    """D motions, world axes, `[rotation | translation]`.

    motion: (6, D) float64, rad and m; coefficient: (D, 6) float64, how much of each is in a motion
    """

    motion: np.ndarray
    coefficient: np.ndarray

    @staticmethod
    def of(common: Sequence[DegenerateDirection]) -> "OpenMotions | None":
        """The degenerate directions of all scans, None without any."""
        if not common:
            return None
        basis = np.linalg.qr(np.stack([_plain(each.direction) for each in common], axis=1))[0]
        sigmas = common[0].sigmas[:, None]
        return OpenMotions(basis * sigmas, (basis / sigmas).T)

    def at(self, world_from_sensor: Poses) -> "Open":
        """The same at poses (S, 4, 4), in the tangent of each."""
        back = np.zeros((len(world_from_sensor), 6, 6))
        back[:, :3, :3] = back[:, 3:, 3:] = np.swapaxes(world_from_sensor[:, :3, :3], -1, -2)
        return Open(self.coefficient @ np.swapaxes(back, -1, -2), back @ self.motion)


@dataclass(frozen=True)
class Open:
    """D motions at S poses.

    coefficient: (S, D, 6), of each in a tangent of a pose; motion: (S, 6, D), that tangent
    """

    coefficient: np.ndarray
    motion: np.ndarray

    @property
    def count(self) -> int:
        """D."""
        return int(self.motion.shape[2])

    def along(self, of: np.ndarray) -> np.ndarray:
        """(S, D) float64: how far tangents go along them. of: (S, 6) float64, rad and m"""
        return np.asarray((self.coefficient @ of[..., None])[..., 0])

    def part(self, of: np.ndarray) -> np.ndarray:
        """(S, 6) float64: what of tangents is along them. of: (S, 6) float64, rad and m"""
        return np.asarray((self.motion @ self.along(of)[..., None])[..., 0])

    def covariance(self, of: PoseBlocks) -> np.ndarray:
        """(N, D, D) float64, of the coefficients. of: (N, 6, 6) float64, of the last N tangents"""
        coefficient = self.coefficient[len(self.coefficient) - len(of) :]
        return np.asarray(coefficient @ of @ np.swapaxes(coefficient, -1, -2))

    def shift_m(self, of: PoseBlocks, used: np.ndarray) -> float:
        """Root mean square of shifts along them, m. of: (S, 6, 6) float64, of tangents; used: (S,) bool, those counted"""
        shift = self.motion[used, 3:] @ self.covariance(of)[used] @ np.swapaxes(self.motion[used, 3:], -1, -2)
        return float(np.sqrt(np.trace(shift, axis1=1, axis2=2).mean())) if used.any() else 0.0

    def known_by(self, of: PoseBlocks, along: PoseBlocks, where: np.ndarray) -> np.ndarray:
        """(S, 6, 6) float64, rad and m: covariances of poses, along the motions instead of their own those of others.

        of: (S, 6, 6) float64, the poses'; along: (S, 6, 6) float64, the others'; where: (S,) bool, that is so
        """
        beside = np.eye(6) - self.motion @ self.coefficient
        slide = self.motion @ self.covariance(along) @ np.swapaxes(self.motion, -1, -2)
        known = beside @ of @ np.swapaxes(beside, -1, -2) + slide
        return np.asarray(np.where(where[:, None, None], known, of))


def _plain(direction: np.ndarray) -> np.ndarray:
    """A slide (6,) without the little turn that noise has added to it, which would be large where it is followed far."""
    turn = np.linalg.norm(direction[:3]) < _LITTLE * np.linalg.norm(direction)
    return np.asarray(np.where(turn & (np.arange(6) < 3), 0.0, direction))
