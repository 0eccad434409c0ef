"""The motion from a scan to the next, as their surfaces have it: surfels of a scan, registered to those before it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import STAGES
from lvba.lidar.odometry_factor import JUMP
from lvba.loop_closure import alignments, submap, surfel_icp, verification
from lvba.loop_closure.alignments import Expected
from lvba.loop_closure.submap import Patch, SubmapConfig
from lvba.loop_closure.surfel_icp import Target

_REACH_M = 40.0
"""Surfaces further away are seen by few points, and tell little of positions."""
_FEWEST = 30
"""Surfels below which a scan tells nothing."""
_NEAR_M = 0.1
_STARTS = 24
_LEAST_OVERLAP, _LEAST_AGREEING = 0.15, 0.85
"""An alignment by which surfaces agree less, or contradict each other more, is none."""
_FLOOR = np.repeat([np.radians(0.03), 0.005], 3)
_OPEN_SIGMA_M = 0.05
_MATCH_M, _MATCH_DEG = 0.5, 20.0

_WIDE_M, _WIDE_DEG = float(JUMP[5, 5] ** -0.5), float(np.degrees(JUMP[0, 0] ** -0.5))
_TEST = STAGES[-1].plane_test
_ALONE = replace(
    STAGES[-1],
    plane_test=replace(
        _TEST, min_scans=1, min_points=_TEST.min_points // 2, max_tilt=2**0.5 * _TEST.max_tilt
    ),
)
"""Planes of one scan alone have half as many points as those that two must see ..."""
_SURFELS = SubmapConfig(min_points=2, full=32)
"""... and so have its surfels."""


@dataclass(frozen=True)
class Step:
    """Where a scan is in the frame of the one before it, as surfaces have it.

    first_from_second: (4, 4) float64
    information: (6, 6) float64, inverse covariance, local tangent [rotation | translation], zero in open directions and
        where surfaces do not agree at all
    overlap: part of the second scan's surfels that lie on a surface; agreeing: part that agrees of all that agrees or
        contradicts; open: number of directions that surfaces leave open
    """

    first_from_second: np.ndarray
    information: np.ndarray
    overlap: float
    agreeing: float
    open: int

    @property
    def aligned(self) -> bool:
        """Whether surfaces agree at all."""
        return self.overlap >= _LEAST_OVERLAP and self.agreeing >= _LEAST_AGREEING

    def beside(self, rough: Pose, prior: np.ndarray) -> np.ndarray:
        """(4, 4): the most likely step beside the odometry's (4, 4).

        prior: (6, 6) float64, information of the odometry
        """
        off = geometry.log(geometry.inverse(rough) @ self.first_from_second)
        step = np.linalg.solve(self.information + prior, self.information @ off)
        return np.asarray(geometry.retract(rough, step))

    def correction(self, rough: Pose) -> np.ndarray:
        """(6,), rad and m: how far an odometry (4, 4) is off along the directions that surfaces determine."""
        off = geometry.log(geometry.inverse(rough) @ self.first_from_second)
        known = self.information @ np.linalg.pinv(self.information, rcond=1e-9, hermitian=True)
        return np.asarray(known @ off)


def surfels(points: np.ndarray, sensor_position: Vector) -> Patch | None:
    """The surfels of one scan, in its frame; None: too few.

    points: (N, 3) float32, m, scan frame; sensor_position: (3,), m, scan frame
    """
    still = np.eye(4)[None]
    try:
        planes, labels = bundle_adjustment.find_planes(
            [points], still, sensor_position=sensor_position, stages=(_ALONE,)
        )
    except DegenerateProblemError:
        return None
    whole = submap.build(
        planes, labels, still, np.arange(1), sensor_position=sensor_position, config=_SURFELS
    )
    patch = submap.around(whole, 0, _REACH_M)
    return patch if len(patch) >= _FEWEST else None


def overlap(first: Target, second: Patch, first_from_second: Pose) -> float:
    """Part of the second scan's surfels that lie on surfaces of the first, 0 to 1."""
    return float(np.mean(verification.agreeing(first, second, first_from_second, _NEAR_M)))


def contradicting(first: Target, second: Patch, first_from_second: Pose) -> float:
    """Part of what surfels say of a motion that contradicts it, 0 to 1: one scan sees through surfaces of the other; 0 if
    they have nothing in common."""
    return verification.evidence(first, Target.of(second), first_from_second, _NEAR_M).contradicting


def contradicts(first: Target, second: Patch, first_from_second: Pose) -> bool:
    """Whether one scan sees through surfaces of the other where a motion has them; not if they have nothing in common."""
    return contradicting(first, second, first_from_second) > 1 - _LEAST_AGREEING


def register(first: Target, second: Patch, rough: Pose, prior: np.ndarray = JUMP) -> Step:
    """The step that surfaces fall into from the odometry's (4, 4); searched for where they do not.

    prior: (6, 6) float64, information of the odometry
    """
    stages = surfel_icp.COARSE + surfel_icp.FINE
    step = _judged(first, second, surfel_icp.align(first, second, rough, stages, rough, prior))
    if step.aligned and step.overlap > 2 * _LEAST_OVERLAP:
        return step
    target, expected = Target.of(second), Expected(rough, _WIDE_M, _WIDE_DEG)
    ways = alignments.find(first, target, expected, tolerance=_NEAR_M, starts=_STARTS)
    if not ways:
        return step
    other = alignments.best_of(ways, first, target, _NEAR_M)
    searched = _judged(first, second, other.a_from_b)
    return searched if searched.overlap > step.overlap else step


def refined(first: Target, second: Patch, begin: Pose, rough: Pose, prior: np.ndarray) -> Step:
    """As `register`, from near by: begin (4, 4). prior: (6, 6) float64, information of the odometry"""
    return _judged(first, second, surfel_icp.align(first, second, begin, surfel_icp.FINE, rough, prior))


def _judged(first: Target, second: Patch, pose: np.ndarray) -> Step:
    matches = surfel_icp.match(first, second, pose, _MATCH_M, _MATCH_DEG)
    known = surfel_icp.certainty(first, second, pose, matches, _FLOOR, _OPEN_SIGMA_M)
    evidence = verification.evidence(first, Target.of(second), pose, _NEAR_M)
    step = Step(
        first_from_second=pose,
        information=known.information,
        overlap=float(np.mean(evidence.for_b > 0)),
        agreeing=evidence.agreeing,
        open=len(known.open),
    )
    if step.aligned:
        return step
    return Step(pose, np.zeros((6, 6)), step.overlap, step.agreeing, 6)


def together(patches: Sequence[Patch | None], world_from_scan: Poses, frame: int) -> Patch | None:
    """The surfels of some scans in the frame of one of them; None: there are none. world_from_scan: (n, 4, 4)"""
    frame_from_world = geometry.inverse(world_from_scan[frame])
    moved = [
        patch.moved(frame_from_world @ pose)
        for patch, pose in zip(patches, world_from_scan, strict=True)
        if patch is not None
    ]
    if not moved:
        return None
    return Patch(
        center=np.concatenate([patch.center for patch in moved]),
        normal=np.concatenate([patch.normal for patch in moved]),
        observer=np.concatenate([patch.observer for patch in moved]),
        thickness=np.concatenate([patch.thickness for patch in moved]),
        cell=max(patch.cell for patch in moved),
    )
