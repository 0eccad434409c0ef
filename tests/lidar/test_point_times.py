"""Times of points in whatever unit and from whatever zero."""

import numpy as np
import pytest

from lvba.lidar import point_times
from lvba.lidar.point_times import PointClock

STAMPS = 1_700_000_000.0 + 0.1 * np.arange(20)
SWEEP = np.linspace(-0.1, 0.0, 2001)


def from_stamp(clock, times, stamp):
    return clock.from_stamp(np.zeros((len(times), 3)), times, stamp)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
def test_times_of_the_clock_of_the_stamps(unit):
    times = [(stamp + SWEEP) / unit for stamp in STAMPS]
    clock = point_times.find_clock(times, STAMPS)
    assert isinstance(clock, PointClock)
    assert clock.unit == unit
    assert clock.absolute
    assert clock.begin == pytest.approx(-0.1, abs=1e-3)
    np.testing.assert_allclose(from_stamp(clock, times[3], STAMPS[3]), SWEEP, atol=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("zero", [0.0, -0.1, 12345.0])
def test_times_from_another_zero_are_taken_from_the_middle(unit, zero):
    times = [(zero + SWEEP + 7.0 * number) / unit for number in range(20)]
    clock = point_times.find_clock(times, STAMPS)
    assert isinstance(clock, PointClock)
    assert clock.unit == unit
    assert not clock.absolute
    np.testing.assert_allclose(from_stamp(clock, times[3], STAMPS[3]), SWEEP + 0.05, atol=1e-6)


@pytest.mark.parametrize("times", [np.zeros(100), np.full(100, 1.7e9), None, np.full(100, np.nan)])
def test_times_that_say_nothing(times):
    assert point_times.find_clock([times] * 20, STAMPS) == ""


def test_times_that_are_none():
    assert "no sweep" in point_times.find_clock([SWEEP * 70] * 20, STAMPS)
    rng = np.random.default_rng(0)
    assert "another length" in point_times.find_clock([SWEEP * rng.uniform(0.1, 4) for _ in STAMPS], STAMPS)


def test_sweeps_follow_each_other():
    clock = PointClock(1.0, 0.1, -0.05, False)
    assert not point_times.overlapping(clock, STAMPS)
    assert point_times.overlapping(clock, STAMPS[0] + 0.05 * np.arange(9))


def test_a_scan_unlike_the_others_stays_as_it_is():
    clock = PointClock(1.0, 0.1, -0.1, True)
    assert not from_stamp(clock, STAMPS[0] + 3 + SWEEP, STAMPS[0]).any(), "another moment"
    assert not from_stamp(clock, STAMPS[0] + 5 * SWEEP, STAMPS[0]).any(), "too long"
    assert not from_stamp(clock, np.full(9, np.nan), STAMPS[0]).any()
    some = from_stamp(clock, np.where(np.arange(2001) == 7, np.nan, STAMPS[0] + SWEEP), STAMPS[0])
    assert np.isfinite(some).all()
    assert some[7] == 0
