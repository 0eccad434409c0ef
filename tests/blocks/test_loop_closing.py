"""The whole way of a split recording: parts refined on their own, places recognized, everything merged."""

import numpy as np
import plane_world
import pytest

from lvba import geometry, trajectory
from lvba.blocks import merge
from lvba.blocks.merge import PartPoses
from lvba.lidar.bundle_adjustment import refine
from lvba.loop_closure import candidates, registration, submap

SCANS, SIZE, OVERLAP = 36, 12, 4


def drifted(truth):
    """Rough poses of a loop whose ends miss each other by 1 m and 2 degrees."""
    end = truth[-1, :3, 3]
    there = geometry.from_rotation_translation(np.eye(3), end)
    part = np.linspace(0, 1, len(truth))[:, None]
    missed = np.array([0.004, -0.006, np.radians(2.0), 0.8, -0.6, 0.15])
    noise = np.random.default_rng(0).normal(size=(len(truth), 6)) * np.repeat([0.001, 0.01], 3)
    return there @ geometry.exp(part * missed) @ geometry.inverse(there) @ truth @ geometry.exp(noise)


def step_covariance(world_from_scan, covariance):
    """Of the motion between neighbors that are off their map independently."""
    back = geometry.adjoint(geometry.inverse(world_from_scan[1:]) @ world_from_scan[:-1])
    return back @ covariance[:-1] @ np.swapaxes(back, -1, -2) + covariance[1:]


@pytest.fixture(scope="module")
def split():
    """True and rough poses, and the parts: poses and submap, none of the one in the middle, which nobody solved."""
    truth = plane_world.path("courtyard", SCANS)
    scans = plane_world.scan_all(plane_world.courtyard(), truth, 6000, 0.02, "spinning", 2)
    rough = drifted(truth)
    parts, submaps = [], []
    for start in range(0, SCANS - OVERLAP, SIZE - OVERLAP):
        numbers = np.arange(start, min(start + SIZE, SCANS))
        if start == SIZE - OVERLAP:
            sigma = np.diag(np.repeat([0.01, 0.08], 3) ** 2)
            parts.append(PartPoses(numbers, rough[numbers], np.tile(sigma, (len(numbers) - 1, 1, 1))))
            submaps.append(None)
            continue
        found = refine([scans[k] for k in numbers], rough[numbers])
        steps = step_covariance(found.world_from_scan, found.conditional_covariance)
        parts.append(PartPoses(numbers, found.world_from_scan, steps))
        submaps.append(
            submap.build(
                found.planes,
                found.plane_points,
                found.world_from_scan,
                numbers,
                covariance=found.conditional_covariance,
            )
        )
    return truth, rough, tuple(parts), submaps


def found_loops(rough, parts, submaps):
    pairs = candidates.candidates(rough, tuple(part.scans for part in parts))
    return tuple(
        registration.register(submaps[pair.first], submaps[pair.second], pair)
        for pair in pairs
        if submaps[pair.first] is not None and submaps[pair.second] is not None
    )


def test_a_loop_that_misses_by_a_meter_is_closed_by_merging_alone(split):
    truth, rough, parts, submaps = split
    closed = found_loops(rough, parts, submaps)
    assert [(loop.first, loop.second) for loop in closed if loop.accepted] == [(0, 2), (0, 3)]
    merged, without = merge.merge(parts, closed), merge.merge(parts)
    errors = [
        trajectory.pose_error(poses, truth)
        for poses in (rough, without.world_from_scan, merged.world_from_scan)
    ]
    assert errors[0].ate_m > 0.2
    assert errors[1].ate_m > 0.05
    assert errors[2].ate_m < 0.03
    every = (truth, rough, without.world_from_scan, merged.world_from_scan)
    ends = [geometry.inverse(poses[0]) @ poses[-1] for poses in every]
    missed = [np.linalg.norm((geometry.inverse(ends[0]) @ end)[:3, 3]) for end in ends[1:]]
    assert missed[0] > 0.9
    assert missed[1] > 0.05
    assert missed[2] < 0.01
    assert [row.used for row in merged.loops] == [loop.accepted for loop in closed]


def test_a_false_loop_among_true_ones_changes_nothing(split):
    _, rough, parts, submaps = split
    closed = found_loops(rough, parts, submaps)
    # what a look-alike place could have made of it
    true = next(loop for loop in closed if loop.accepted)
    wrong = true.first_from_second @ geometry.exp(np.array([0, 0, 0.05, 0.6, 0.8, 0]))
    false = registration.Loop(0, 3, 1, SCANS - 2, wrong, true.information, 0.9, 0.01, 0, True, "")
    with_false = merge.merge(parts, (*closed, false))
    assert not with_false.loops[-1].used
    np.testing.assert_array_equal(with_false.world_from_scan, merge.merge(parts, closed).world_from_scan)


def test_every_seam_has_a_row(split):
    _, _, parts, _ = split
    merged = merge.merge(parts)
    assert [(seam.first, seam.second, seam.scans) for seam in merged.seams] == [
        (0, 1, 4),
        (1, 2, 4),
        (2, 3, 4),
    ]
    # a solved part and one that is not differ where they overlap
    assert merged.seams[0].offset_before_m < 0.3
    assert merged.seams[2].residual_m < 0.005 < merged.seams[0].residual_m
