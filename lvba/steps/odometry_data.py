"""What the report says of the odometry: jumps, motions that are far off, and what confirms those of the result."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from lvba.arrays import Poses
from lvba.dataset import Dataset
from lvba.lidar.bundle_adjustment import odometry_dependent_steps
from lvba.loop_closure.rough_poses import RoughError
from lvba.steps import trajectory_jumps
from lvba.steps.outcomes import Accepted, LidarStage, VisualStage
from lvba.trajectory import Trajectory


def of_odometry(
    dataset: Dataset, accepted: Accepted, lidar: LidarStage, visual: VisualStage
) -> dict[str, Any]:
    """Where the rough scan poses jump or are far off, and where nothing says how scans after that are to those before.

    accepted: what is in use; lidar, visual: what was found
    """
    poses = dataset.scans.world_from_sensor
    by_images = _tied(dataset, accepted, visual, trajectory_jumps.CONFIRMED_M, trajectory_jumps.CONFIRMED_DEG)
    # a sensor that turns round a corner between sparse scans continues unlike before and after
    as_images = _alike(by_images, accepted.world_from_scan, poses)
    rough = trajectory_jumps.find(dataset.scans).without(_confirmed(poses, lidar)).without(as_images)
    surfaces = _confirmed(accepted.world_from_scan, lidar)
    return {
        "jumps_after": rough.after,
        "jumps_m": rough.meters,
        "jumps_deg": rough.degrees,
        "unconfirmed_after": rough.without(surfaces).without(_tied(dataset, accepted, visual)).after,
        "pauses_after": _pauses(dataset, accepted, lidar, visual),
        "too_far_off": lidar.rough_error and _too_far_off(lidar.rough_error, by_images, len(poses)),
    }


def _pauses(dataset: Dataset, accepted: Accepted, lidar: LidarStage, visual: VisualStage) -> np.ndarray:
    """(K,) int64, scans after which the recording paused, and neither surfaces nor images determine the motion to the
    next."""
    if lidar.result is None:
        return np.zeros(0, np.int64)
    steps = odometry_dependent_steps(lidar.result.odometry_dependence, lidar.result.degenerate_scans)
    open_steps = steps[trajectory_jumps.pauses(np.diff(dataset.scans.times))[steps]]
    return np.setdiff1d(open_steps, _tied(dataset, accepted, visual))


def _too_far_off(error: RoughError, confirmed: np.ndarray, scans: int) -> dict[str, Any]:
    """How far rough poses were off that scans were registered for, and what is open that images do not confirm, either.

    confirmed: (K,) int64, scans after which images confirm the motion in use
    A motion of the first or last scan alone concerns no other one.
    """
    by_images = np.intersect1d(error.open_after, confirmed)
    left_open, last = np.setdiff1d(error.open_after, by_images), scans - 1
    ends = [end for end, after in ((0, 0), (last, last - 1)) if after in left_open]
    return asdict(replace(error, open_after=np.setdiff1d(left_open, [0, last - 1]))) | {
        "by_images_after": by_images,
        "unconnected_ends": ends,
    }


def _confirmed(world_from_scan: Poses, lidar: LidarStage) -> np.ndarray:
    """(K,) int64, scans after which poses (S, 4, 4) continue unlike before and after, and surfaces confirm it: a sensor
    may truly move so fast."""
    if lidar.result is None:
        return np.zeros(0, np.int64)
    return _alike(lidar.confirmed, lidar.result.world_from_scan, world_from_scan)


def _alike(after: np.ndarray, one: Poses, other: Poses) -> np.ndarray:
    """(J,) int64, of scans (K,) int64 those after which poses (S, 4, 4) and others have the same motion."""
    return np.asarray(after[~trajectory_jumps.differ(one, other)[after]])


def _tied(
    dataset: Dataset,
    accepted: Accepted,
    visual: VisualStage,
    most_m: float = trajectory_jumps.LEAST_M,
    most_deg: float = trajectory_jumps.LEAST_DEG,
) -> np.ndarray:
    """(K,) int64, scans after which images say how the next is to it, and agree with the poses in use to so much."""
    if visual.result is None or not accepted.cameras.accepted:
        return np.zeros(0, np.int64)
    scans = Trajectory(dataset.scans.times, accepted.world_from_scan)
    return trajectory_jumps.tied_by_images(scans, visual.result, dataset.images.times, most_m, most_deg)
