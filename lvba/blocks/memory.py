"""What a run will take of memory: the largest part, the largest region of space, and the joint rounds of all scans.

The joint rounds of cameras are not in it: which images are tied is known when their points are. There are about 25 pairs
of 392 bytes for each image.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from lvba.arrays import Poses
from lvba.blocks import lidar_joint, split
from lvba.blocks.split import Load, Part
from lvba.dataset import Dataset

_PAIR = 36 * 8.0
"""Bytes of a block of two scans or groups, and of such a block of a factor or an inverse."""
_DENSE_SCANS = 2500 // 6
"""Scans up to which `optim.linear_solver` makes a dense factor."""


@dataclass(frozen=True)
class Peaks:
    """Peak memory, bytes, of a process that solves the largest part, looks at the largest region of space, or does a
    joint round of all scans; region and joint are zero where there is one part."""

    part: float
    region: float = 0.0
    joint: float = 0.0

    @property
    def largest(self) -> float:
        """Of all steps."""
        return max(self.part, self.region, self.joint)


def peaks(dataset: Dataset, parts: Sequence[Part], load: Load) -> Peaks:
    """What a recording in these parts takes."""
    part = max(split.memory_bytes(load, len(part.scan_numbers), len(part.image_numbers)) for part in parts)
    if len(parts) == 1:
        return Peaks(part)
    regions = split.regions(parts, load)
    scans = max(region.core_scans[1] - region.core_scans[0] for region in regions)
    return Peaks(
        part,
        split.BASE_BYTES + split.BYTES_PER_POINT * load.points_per_scan * scans,
        split.BASE_BYTES + joint_bytes(dataset.scans.world_from_sensor, load.reach_m),
    )


def joint_bytes(world_from_scan: Poses, reach: float) -> float:
    """What a joint round of all scans holds at its peak: the sum of all shares, and its factor.

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
        dense = scans <= _DENSE_SCANS or near > lidar_joint.NEAR * scans * (scans + 1) / 2
        factors = scans**2 if dense else 2 * near
    # two sums of shares and what they add up to; then that, it with the odometry, and its factor
    return _PAIR * max(3 * pairs, 2 * pairs + factors)
