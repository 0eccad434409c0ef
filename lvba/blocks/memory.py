"""What a run will take of memory: the largest part or region of space, and joint rounds of all scans and cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Poses
from lvba.blocks import lidar_joint, split
from lvba.blocks.split import Load, Part
from lvba.dataset import Dataset
from lvba.optim import banded_cholesky
from lvba.visual import keyframes
from lvba.visual.keyframes import KeyframeConfig

_PAIR = 36 * 8.0
"""Bytes of a block of two scans or groups, and of such a block of a factor or an inverse."""
_PAIR_OF_CAMERAS = 49 * 8.0
"""Bytes of a block of two keyframes."""
_DENSE_POSES = 2500 // 6
"""Scans or cameras up to which `optim.linear_solver` makes a dense factor."""


@dataclass(frozen=True)
class Peaks:
    """Peak memory, bytes, of a process that solves the largest part (in the end with what others took at the same place),
    looks at the largest region of space, or does a joint round of all scans or of all cameras; all but `part` are zero
    where there is one part."""

    part: float
    region: float = 0.0
    joint: float = 0.0
    cameras: float = 0.0

    @property
    def largest(self) -> float:
        """Of all steps."""
        return max(self.part, self.region, self.joint, self.cameras)


def peaks(dataset: Dataset, parts: Sequence[Part], load: Load, chosen: KeyframeConfig) -> Peaks:
    """What a recording in these parts takes.

    chosen: which images are keyframes
    """
    part = max(split.memory_bytes(load, len(part.scan_numbers), len(part.image_numbers)) for part in parts)
    if len(parts) == 1:
        return Peaks(part)
    with_near = max(_with_near(dataset, each, load) for each in parts)
    regions = split.regions(parts, load)
    scans = max(region.core_scans[1] - region.core_scans[0] for region in regions)
    images = dataset.images
    numbers = keyframes.select(images.times, images.world_from_sensor, load.range_m, chosen)
    return Peaks(
        max(part, with_near),
        split.BASE_BYTES + split.BYTES_PER_POINT * load.solved_per_scan * scans,
        split.BASE_BYTES + joint_bytes(dataset.scans.world_from_sensor, load.reach_m),
        split.BASE_BYTES + camera_bytes(images.world_from_sensor[numbers]),
    )


def _with_near(dataset: Dataset, part: Part, load: Load) -> float:
    frames = split.with_near(dataset, part)
    return split.visual_bytes(load, len(frames.scans), len(frames.images))


def camera_bytes(world_from_camera: Poses) -> float:
    """What a joint round of all cameras holds at its peak: its equations, and the band that is their factor.

    world_from_camera: (K, 4, 4), of keyframes. Images within `split.NEAR_M` of one part's path are looked at together,
    so that all within twice of it may be tied.
    """
    count = len(world_from_camera)
    if not count:
        return 0.0
    tied = cKDTree(world_from_camera[:, :3, 3]).query_pairs(2.0 * split.NEAR_M, output_type="ndarray")
    here = np.arange(count - 1)
    tied = np.concatenate([tied, np.column_stack([here, here + 1])])
    width = count
    if not _is_dense(count, len(tied) + count):
        width = banded_cholesky.width_of(tied.min(axis=1), tied.max(axis=1), count)
    return _PAIR_OF_CAMERAS * (3 * (len(tied) + count) + width * count)


def _is_dense(poses: int, pairs: int) -> bool:
    """Whether `optim.linear_solver` makes a dense factor of them."""
    return poses <= _DENSE_POSES or pairs > lidar_joint.NEAR * poses * (poses + 1) / 2


def joint_bytes(world_from_scan: Poses, reach: float) -> float:
    """What a joint round of all scans holds at its peak: the sum of all block equations, and its factor.

    world_from_scan: (S, 4, 4); reach: m, of the LiDAR: of scans within twice of it all pairs count, an upper bound
    """
    scans, near = len(world_from_scan), lidar_joint.near_pairs(world_from_scan, reach)
    size = lidar_joint.group_size(world_from_scan, reach)
    if size:
        groups = -(-scans // size)
        pairs = scans * (size + 1) / 2 + groups * (groups + 1) / 2
        factors = groups**2 + scans * size
    else:
        pairs = near
        factors = scans**2 if _is_dense(scans, near) else 2 * near
    # two sums of block equations and what they add up to; then that, it with the odometry, and its factor
    return _PAIR * max(3 * pairs, 2 * pairs + factors)
