"""Parts that were solved on their own, put together: a pose graph over all scans, tied in the overlaps and by loops."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lvba import geometry, trajectory
from lvba.loop_closure import registration
from lvba.loop_closure.registration import Loop
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges, PoseGraph, PoseGraphConfig
from lvba.settings import Group, setting


@dataclass(frozen=True)
class MergeConfig(Group):
    """How the parts of a long recording become one."""

    loops: bool = setting(
        True,
        meaning="Look for places that parts see again.",
        change_when="Different places look alike, and the report lists a false loop.",
    )
    coarse_rounds: int = setting(
        2,
        meaning="Rounds of the joint LiDAR bundle adjustment with the middle cells, which forgive what merging leaves.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report shows offsets of decimeters between parts after merging (more).",
        advanced=True,
    )
    scan_rounds: int = setting(
        5,
        meaning="Rounds of the joint LiDAR bundle adjustment with the finest cells; rounds after it has converged cost "
        "nothing. 0: no joint adjustment.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report says that scans of joined parts still moved in the last round (more).",
        advanced=True,
    )
    image_rounds: int = setting(
        5,
        meaning="Rounds of the joint visual bundle adjustment; rounds after it has converged cost nothing. 0: none.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report says that cameras of joined parts still moved in the last round (more).",
        advanced=True,
    )


@dataclass(frozen=True)
class PartPoses:
    """What one part says about its scans.

    scans: (n,) int64, ascending, indices of its scans in the whole
    world_from_scan: (n, 4, 4) float64, refined in the part, or rough where it could not be solved; its world frame may be
        off that of others by any rigid motion
    step_covariance: (n - 1, 6, 6) float64, of the relative pose of each scan and the next in the part, rad and m, local
        tangent [rotation | translation] at the later scan; that of the odometry where the part could not be solved
    """

    scans: np.ndarray
    world_from_scan: np.ndarray
    step_covariance: np.ndarray


@dataclass(frozen=True)
class Seam:
    """Two parts that share scans.

    first, second: the parts; scans: how many they share; length: m, of the path through these
    offset_before_m, offset_before_deg: rigid motion between the two parts' poses of the shared scans before merging
    residual_m, residual_deg: root mean squares of the differences of these poses without that rigid motion
    offset_after_m, offset_after_deg: largest difference of the step from one shared scan to the next in the merged
        trajectory and in either part
    """

    first: int
    second: int
    scans: int
    length: float
    offset_before_m: float
    offset_before_deg: float
    residual_m: float
    residual_deg: float
    offset_after_m: float
    offset_after_deg: float


@dataclass(frozen=True)
class LoopRow:
    """What became of a loop between two parts.

    first, second: parts; first_scan, second_scan: scans in the whole, -1 where none was found
    used: whether it is in the merged trajectory; reason: why, or why not
    before_m, before_deg: by how much it was missed before merging; after_m, after_deg: afterwards
    overlap: part of what could be seen in both that agrees; residual: m, typical distance of surfaces
    """

    first: int
    second: int
    first_scan: int
    second_scan: int
    used: bool
    reason: str
    before_m: float
    before_deg: float
    after_m: float
    after_deg: float
    overlap: float
    residual: float


@dataclass(frozen=True)
class MergedScans:
    """One trajectory of all parts.

    world_from_scan: (S, 4, 4) float64, world frame of the part with the first scan, whose pose is unchanged
    parts_of_scan: (S,) int64, how many parts hold each scan
    seams, loops: one row each
    cost_before, cost_after: half the squared errors over variances of the edges that are used
    """

    world_from_scan: np.ndarray
    parts_of_scan: np.ndarray
    seams: tuple[Seam, ...]
    loops: tuple[LoopRow, ...]
    cost_before: float
    cost_after: float
    converged: bool


def merge(
    parts: tuple[PartPoses, ...], loops: tuple[Loop, ...] = (), *, config: PoseGraphConfig | None = None
) -> MergedScans:
    """All scans in one world frame.

    Raises DegenerateProblemError: the parts do not overlap.
    """
    count = 1 + max(int(part.scans[-1]) for part in parts)
    steps = pose_graph.concatenate([_steps(part) for part in parts])
    accepted = [loop for loop in loops if loop.accepted]
    edges = pose_graph.concatenate([steps, registration.edges(accepted)])
    first = min(parts, key=lambda part: int(part.scans[0]))
    root = int(first.scans[0])
    start = pose_graph.propagate(count, steps, root, first.world_from_scan[0])
    graph = pose_graph.solve(start, edges, fixed=root, config=config or PoseGraphConfig())
    return MergedScans(
        world_from_scan=graph.world_from_node,
        parts_of_scan=np.bincount(np.concatenate([part.scans for part in parts]), minlength=count),
        seams=tuple(_seams(parts, graph.world_from_node)),
        loops=tuple(_rows(loops, graph, len(steps))),
        cost_before=graph.cost_before,
        cost_after=graph.cost_after,
        converged=graph.converged,
    )


def _steps(part: PartPoses) -> Edges:
    """From each scan of a part to its next."""
    poses = part.world_from_scan
    measured = geometry.steps(poses)
    information = pose_graph.information_of(part.step_covariance)
    return Edges(part.scans[:-1], part.scans[1:], measured, information, np.zeros(len(measured), bool))


def _seams(parts: tuple[PartPoses, ...], merged: np.ndarray) -> Iterator[Seam]:
    """Of all pairs of parts that share scans."""
    for second, part in enumerate(parts):
        for first, earlier in enumerate(parts[:second]):
            shared, mine, other = np.intersect1d(earlier.scans, part.scans, return_indices=True)
            if len(shared):
                poses = earlier.world_from_scan[mine], part.world_from_scan[other]
                yield _seam(first, second, *poses, merged[shared])


def _seam(first: int, second: int, earlier: np.ndarray, later: np.ndarray, merged: np.ndarray) -> Seam:
    """earlier, later, merged: (n, 4, 4), poses of the shared scans in either part and after merging."""
    earlier_from_later = trajectory.align(later, earlier)
    middle = later[:, :3, 3].mean(0)
    offset = geometry.transform_points(earlier_from_later, middle[None])[0] - middle
    residual = geometry.inverse(earlier) @ (earlier_from_later @ later)
    offsets_after = [_step_differences(poses, merged) for poses in (earlier, later)]
    return Seam(
        first=first,
        second=second,
        scans=len(merged),
        length=float(np.linalg.norm(np.diff(merged[:, :3, 3], axis=0), axis=1).sum()),
        offset_before_m=float(np.linalg.norm(offset)),
        offset_before_deg=float(geometry.rotation_angle_deg(earlier_from_later)),
        residual_m=float(np.sqrt(np.mean(np.sum(residual[:, :3, 3] ** 2, axis=1)))),
        residual_deg=float(np.sqrt(np.mean(geometry.rotation_angle_deg(residual) ** 2))),
        offset_after_m=max(meters for meters, _ in offsets_after),
        offset_after_deg=max(degrees for _, degrees in offsets_after),
    )


def _step_differences(poses: np.ndarray, merged: np.ndarray) -> tuple[float, float]:
    """Largest difference (m, degrees) of the steps between neighbors (n, 4, 4) in two trajectories."""
    steps, others = (geometry.steps(p) for p in (poses, merged))
    difference = geometry.inverse(steps) @ others
    meters = np.linalg.norm(difference[:, :3, 3], axis=1).max(initial=0.0)
    return float(meters), float(geometry.rotation_angle_deg(difference).max(initial=0.0))


def _rows(loops: tuple[Loop, ...], graph: PoseGraph, steps: int) -> Iterator[LoopRow]:
    """One for each loop; graph: its edges after the first `steps` are the accepted ones, in order."""
    edge = steps
    for loop in loops:
        missed, reason, used = np.full((2, 6), np.nan), loop.reason, False
        if loop.accepted:
            missed = np.stack([graph.residual_before[edge], graph.residual_after[edge]])
            reason, used = graph.loop_reason[edge], bool(graph.loop_weight[edge])
            edge += 1
        meters = np.linalg.norm(missed[:, 3:], axis=1).tolist()
        degrees = np.degrees(np.linalg.norm(missed[:, :3], axis=1)).tolist()
        yield LoopRow(
            first=loop.first,
            second=loop.second,
            first_scan=loop.first_scan,
            second_scan=loop.second_scan,
            used=used,
            reason=reason,
            before_m=meters[0],
            before_deg=degrees[0],
            after_m=meters[1],
            after_deg=degrees[1],
            overlap=loop.overlap,
            residual=loop.residual,
        )
