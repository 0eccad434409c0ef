"""How scans move and turn by numbers that all of them share, such as errors of the range sensor, and what becomes of
that along a path that is longer than what was looked at.

Without a common rigid motion, and without a common scale, in which nothing is predicted: what ranges are too long by with
the direction of the beam is mostly such a scale, and poses of a car seemed to be off by half a meter that were off by
centimeters. A sensor whose beams go higher than it says bends a map evenly, so that turns grow with the length of the
path, and shifts with its square.
"""

import math
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Poses

_SAG = 1.0 / math.sqrt(5.0)
"""A path that bends evenly is off by so much of its curvature times its squared extent (both root mean square): a
parabola about its mean, over points spread evenly on a line."""


@dataclass(frozen=True)
class PoseResponse:
    """Of scans, by a unit of each of k numbers; adds up over scans.

    turn, shift, bend: (k, k) float64, sums over scans of products of how far poses turn, rad, move, m, and of how fast
        they turn along the line that they spread most along, rad/m
    extent: m^2, sum over scans of squared places on that line; scans: how many
    """

    turn: np.ndarray
    shift: np.ndarray
    bend: np.ndarray
    extent: float = 0.0
    scans: int = 0

    @staticmethod
    def of(moved: np.ndarray, world_from_scan: Poses) -> "PoseResponse":
        """Of scans at poses (S, 4, 4).

        moved: (S, 6, k) float64, change of each, local tangent, by a unit of each number
        """
        rotation, place = world_from_scan[:, :3, :3], world_from_scan[:, :3, 3]
        place = place - place.mean(axis=0)
        turn, shift = (rotation @ moved[:, part] for part in (slice(3), slice(3, 6)))
        shift = shift - shift.mean(axis=0)
        common = _common_turn(place, turn, shift)
        turn, shift = turn - common, shift - _cross(common, place)
        square = float(np.sum(place**2))
        if square > 0:
            shift = shift - place[:, :, None] * (np.einsum("si,sik->k", place, shift) / square)
        along = place @ np.linalg.svd(place, full_matrices=False)[2][0]
        extent = float(along @ along)
        rate = np.einsum("s,sik->ik", along, turn) / max(extent, 1e-12)
        return PoseResponse(
            turn=np.einsum("sik,sil->kl", turn, turn),
            shift=np.einsum("sik,sil->kl", shift, shift),
            bend=len(place) * rate.T @ rate,
            extent=extent,
            scans=len(place),
        )

    @staticmethod
    def nothing(size: int) -> "PoseResponse":
        """Of no scan, by so many numbers."""
        none = np.zeros((size, size))
        return PoseResponse(none, none, none)

    def by(self, moment: np.ndarray, extent: float) -> tuple[float, float]:
        """rad and m, root mean square over scans, that poses turn and move by numbers that are not known of.

        moment: (k, k) float64, second moments of the numbers
        extent: m, root mean square, of all scans along the line that they spread most along (`extent_of`)
        """
        scans = max(self.scans, 1)
        turn, shift, bend = (
            float(np.sum(each * moment)) / scans for each in (self.turn, self.shift, self.bend)
        )
        seen, whole = self.extent / scans, extent**2
        turn += bend * max(whole - seen, 0.0)
        shift += _SAG**2 * bend * max(whole**2 - seen**2, 0.0)
        return math.sqrt(max(turn, 0.0)), math.sqrt(max(shift, 0.0))

    def of_numbers(self, columns: slice) -> "PoseResponse":
        """By some of the numbers."""
        turn, shift, bend = (each[columns, columns] for each in (self.turn, self.shift, self.bend))
        return PoseResponse(turn, shift, bend, self.extent, self.scans)

    def __add__(self, other: "PoseResponse") -> "PoseResponse":
        return PoseResponse(
            self.turn + other.turn,
            self.shift + other.shift,
            self.bend + other.bend,
            self.extent + other.extent,
            self.scans + other.scans,
        )


def _common_turn(place: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(3, k): of all scans at places (S, 3) that turn (S, 3, k) and move (S, 3, k), world axes, about their mean.

    By positions and orientations, an angle by what it moves a meter away (as `trajectory.align_for_errors`): where all
    scans turn in their own frames, as by an error of elevation, positions are not turned.
    """
    squares = np.eye(3) * (np.sum(place**2) + len(place)) - place.T @ place
    moments = np.cross(place[:, None], shift.transpose(0, 2, 1), axis=2).sum(axis=0).T
    return np.asarray(np.linalg.solve(squares, moments + turn.sum(axis=0)))


def _cross(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(S, 3, k): how places (S, 3) move by common turns (3, k)."""
    return np.asarray(np.cross(turn.T[None], place[:, None], axis=2).transpose(0, 2, 1))


def extent_of(world_from_scan: Poses) -> float:
    """m, root mean square, of scans at poses (S, 4, 4) along the line that they spread most along."""
    place = world_from_scan[:, :3, 3] - world_from_scan[:, :3, 3].mean(axis=0)
    return float(np.linalg.norm(place, 2)) / math.sqrt(max(len(place), 1))
