"""Parts with world frames of their own, put together."""

import numpy as np
import pytest
from pose_graph_world import loop_world, position_error

from lvba import geometry
from lvba.blocks.merge import PartPoses, merge
from lvba.errors import DegenerateProblemError
from lvba.loop_closure.registration import Loop

SIGMA = np.array([5e-4] * 3 + [4e-3] * 3)


def parts_of(truth, ranges, seed=0):
    """Each part with noise of its own on every step, and off the world by a rigid motion, the first excepted."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, (start, stop) in enumerate(ranges):
        noise = rng.normal(size=(stop - start - 1, 6)) * SIGMA
        poses = [truth[start]]
        for step, off in zip(geometry.inverse(truth[start : stop - 1]) @ truth[start + 1 : stop], noise):
            poses.append(poses[-1] @ step @ geometry.exp(off))
        moved = geometry.exp(rng.normal(size=6) * (k > 0) * np.array([0.03] * 3 + [0.5] * 3))
        covariance = np.broadcast_to(np.diag(SIGMA**2), (stop - start - 1, 6, 6))
        parts.append(PartPoses(np.arange(start, stop), moved @ np.array(poses), covariance))
    return tuple(parts)


def loop_between(truth, first, second, off=0.0, accepted=True):
    measured = geometry.inverse(truth[first]) @ truth[second] @ geometry.exp(off + np.zeros(6))
    information = np.diag(np.array([5e-4] * 3 + [3e-3] * 3) ** -2)
    return Loop(
        0, 4, first, second, measured, information, 0.8, 0.01, 0, accepted, "" if accepted else "too dark"
    )


RANGES = [(0, 25), (20, 45), (40, 65), (60, 85), (80, 100)]


@pytest.fixture(scope="module")
def truth():
    return loop_world(100, seed=6)[0]


def test_parts_come_into_one_frame_and_the_first_pose_stays(truth):
    parts = parts_of(truth, RANGES)
    merged = merge(parts)
    np.testing.assert_array_equal(merged.world_from_scan[0], parts[0].world_from_scan[0])
    # what the noise of 100 steps, in turns too, comes to; the parts themselves are half a meter off and more
    assert position_error(merged.world_from_scan, truth) < 0.3
    assert min(seam.offset_before_m for seam in merged.seams) > 0.3
    np.testing.assert_array_equal(merged.parts_of_scan[18:28], [1, 1, 2, 2, 2, 2, 2, 1, 1, 1])
    assert merged.converged


def test_a_loop_takes_the_drift_out_and_a_refused_one_changes_nothing(truth):
    parts = parts_of(truth, RANGES, seed=1)
    true, false = loop_between(truth, 2, 97), loop_between(truth, 10, 60, np.array([0, 0, 0.4, 2.0, 1.0, 0]))
    with_loop, without = merge(parts, (true,)), merge(parts)
    errors = [position_error(m.world_from_scan, truth) for m in (with_loop, without)]
    assert errors[0] < 0.7 * errors[1]
    row = with_loop.loops[0]
    assert row.used
    assert row.after_m < 0.01 < row.before_m
    both = merge(parts, (true, false, loop_between(truth, 1, 98, accepted=False)))
    np.testing.assert_array_equal(both.world_from_scan, with_loop.world_from_scan)
    assert [row.used for row in both.loops] == [True, False, False]
    assert "chi square" in both.loops[1].reason
    assert both.loops[2].reason == "too dark"


def test_rows_of_seams_tell_how_far_parts_were_apart(truth):
    parts = parts_of(truth, RANGES, seed=2)
    merged = merge(parts)
    assert [(seam.first, seam.second, seam.scans) for seam in merged.seams] == [
        (k, k + 1, 5) for k in range(4)
    ]
    for seam in merged.seams:
        later, earlier = parts[seam.second], parts[seam.first]
        jump = np.linalg.norm((later.world_from_scan[:5] - earlier.world_from_scan[-5:])[:, :3, 3], axis=1)
        assert jump.min() - 0.02 < seam.offset_before_m < jump.max() + 0.02
        assert seam.residual_m < 0.02
        assert 0 < seam.offset_after_m < 0.03
        length = np.linalg.norm(np.diff(truth[earlier.scans[-5:], :3, 3], axis=0), axis=1).sum()
        assert seam.length == pytest.approx(length, rel=0.02)


def test_overlaps_count_twice(truth):
    # with equal certainty, the merged step lies between the two estimates of it
    parts = parts_of(truth, [(0, 10), (5, 15)], seed=3)
    merged = merge(parts).world_from_scan
    one, two = (part.world_from_scan for part in parts)
    for step in range(5, 9):
        mean, first, second = (
            geometry.inverse(p[k]) @ p[k + 1] for p, k in ((merged, step), (one, step), (two, step - 5))
        )
        middle = geometry.interpolate(first, second, np.array(0.5))
        np.testing.assert_allclose(mean, middle, atol=1e-5)


def test_parts_with_a_gap_are_an_error(truth):
    with pytest.raises(DegenerateProblemError, match="do not overlap"):
        merge(parts_of(truth, [(0, 10), (10, 20)]))
