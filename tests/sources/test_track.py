"""Poses of an odometry at and beyond its ends, against a motion that is known."""

import numpy as np
import pytest

from lvba import geometry
from lvba.sources.importing import smoothing
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track
from lvba.sources.importing.turning import TurningTrack

TWIST = np.array([0.2, -0.1, 0.5, 1.0, 0.3, -0.2])
"""rad/s and m/s."""


def world_from_lidar(times):
    return geometry.exp(np.asarray(times)[:, None] * TWIST)


def track_of(times):
    return Track(np.asarray(times), world_from_lidar(times))


def tracks():
    """The same motion as each kind of track has it, with poses from 1 to 3 s, ten a second."""
    plain = track_of(np.arange(1.0, 3.05, 0.1))
    readings = np.arange(0.5, 3.5, 5e-3)
    rates = np.tile(TWIST[:3], (len(readings), 1))
    turning = turnings.turning(ImuReadings(readings, rates, np.zeros_like(rates)), np.eye(4))
    return {
        "poses": plain,
        "gyroscope": TurningTrack(plain.times, plain.poses, turning),
        "smooth": smoothing.smooth(plain, None),
        "smooth_gyroscope": smoothing.smooth(plain, turning),
    }


@pytest.mark.parametrize("kind", ["poses", "gyroscope", "smooth", "smooth_gyroscope"])
def test_the_motion_goes_on_for_a_tenth_of_the_time_from_pose_to_pose(kind):
    track = tracks()[kind]
    queries = np.array([0.9905, 0.9986, 3.0014, 3.0095])
    off = geometry.log(geometry.inverse(world_from_lidar(queries)) @ track.at(queries))
    held = geometry.log(geometry.inverse(world_from_lidar(queries)) @ track.poses[[0, 0, -1, -1]])
    tolerance = 1e-9 if kind in ("poses", "gyroscope") else 2e-4  # a smoothing spline rounds off a turn
    assert np.abs(off).max() < tolerance < np.abs(held).max() / 10
    assert track.covers(0.9905, 3.0095)
    assert not track.covers(0.989, 2.0)
    assert not track.covers(2.0, 3.011)
    # beyond, it stands still
    np.testing.assert_array_equal(track.at(np.array([3.5])), track.at(np.array([track.ends[1]])))
    np.testing.assert_array_equal(track.at(np.array([0.0])), track.at(np.array([track.ends[0]])))


@pytest.mark.parametrize(("step", "more"), [(0.01, 1e-3), (0.1, 0.01), (0.2, 0.02), (0.4, 0.02)])
def test_it_goes_on_for_20_ms_at_most(step, more):
    track = track_of(2.0 + step * np.arange(8))
    np.testing.assert_allclose(track.ends, (2.0 - more, track.times[-1] + more), rtol=0, atol=1e-12)


def test_a_motion_over_a_gap_does_not_go_on():
    late = track_of([0.0, 0.1, 0.2, 0.3, 0.9])
    assert late.ends == (pytest.approx(-0.01), 0.9)
    assert not late.covers(0.9, 0.901)
    assert not late.covers(0.25, 0.35)


def test_a_single_pose_stands_still():
    alone = track_of([1.0])
    assert alone.ends == (1.0, 1.0)
    np.testing.assert_allclose(
        alone.at(np.array([0.0, 1.0, 2.0])), alone.poses[[0, 0, 0]], rtol=0, atol=1e-12
    )


def test_how_far_a_time_lies_outside_of_the_poses():
    track = track_of(np.arange(1.0, 3.05, 0.1))
    assert track.outside(1.5, 3.005) == 0.0
    assert track.outside(0.9, 1.5) == pytest.approx(0.1)
    assert track.outside(2.9, 3.25) == pytest.approx(0.25)
