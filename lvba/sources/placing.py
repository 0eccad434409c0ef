"""Points of a moving sensor, put where they belong by its poses at some moments."""

import numpy as np

from lvba.arrays import Poses, Times


def place(points: np.ndarray, nodes: Times, node_poses: Poses, times: Times) -> np.ndarray:
    """(N, 3) float64: points at times (N,) s by poses (K, 4, 4) at evenly spaced nodes (K,) s, linear between two.

    points: (N, 3) float32, m, each in the sensor's frame at its own time
    Between nodes that are some milliseconds apart, a straight line is as good as the arc: 1 rad/s for 2.5 ms at 50 m
    is off it by 0.1 mm.
    """
    step = nodes[1] - nodes[0] if len(nodes) > 1 else 1.0
    where = np.clip((times - nodes[0]) / step, 0, len(nodes) - 1)
    before = np.minimum(where.astype(np.int64), max(len(nodes) - 2, 0))
    after = np.minimum(before + 1, len(nodes) - 1)
    part = (where - before)[:, None, None]
    rows = (1 - part) * node_poses[before, :3] + part * node_poses[after, :3]
    return np.asarray(np.einsum("nij,nj->ni", rows[..., :3], points.astype(float)) + rows[..., 3])


def nodes(first: float, last: float, spacing: float) -> np.ndarray:
    """(K,) s, from first to last (s), at most `spacing` (s) apart; one where both are the same."""
    if last <= first:
        return np.array([first])
    return np.linspace(first, last, int(np.ceil((last - first) / spacing)) + 1)
