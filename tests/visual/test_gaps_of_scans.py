"""What cameras are expected to be off where scans are far: in gaps between them and beyond their ends."""

import numpy as np
import pytest

from lvba import geometry, spline
from lvba.carried import carry, far
from lvba.trajectory import Trajectory
from lvba.visual import trajectory_prior

EXTRINSIC = geometry.inverse(geometry.exp(np.array([1.2, -1.1, 1.0, 0.05, -0.1, 0.08])))
NEAR = geometry.inverse(EXTRINSIC)


def hand(seed):
    """A sensor in a hand that sways and turns as it likes: poses at times."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.3, 3.0, (8, 6)), rng.uniform(0, 2 * np.pi, (8, 6))
    size = rng.normal(size=(8, 6)) * np.repeat([0.1, 0.2], 3)
    return lambda times: geometry.exp((size * np.sin(rate * times[:, None, None] + phase)).sum(axis=1))


def without(gap, step=0.1, end=12.0):
    """Times of scans, some of which in the middle are not there, for so many s."""
    times = np.arange(0, end, step)
    return times[(times < 4.0) | (times >= 4.0 + gap)]


@pytest.mark.parametrize("gap", [0.3, 1.0, 2.0, 5.0])
def test_a_spline_is_off_across_a_gap_by_what_it_says(gap):
    ratio = []
    for seed in range(12):
        poses, times = hand(seed), without(gap)
        at = np.linspace(times[times < 4.0][-1], 4.0 + gap, 9)[1:-1]
        scans = Trajectory(times, poses(times))
        off = geometry.log(geometry.inverse(poses(at)) @ spline.through(scans, at)).reshape(-1, 2, 3)
        said = trajectory_prior.BETWEEN_SCANS * np.sqrt(3) * spline.leave_one_out_error(scans, at)
        ratio.append(np.linalg.norm(off, axis=2) / said)
    assert np.sqrt(np.mean(np.square(ratio))) < 3.0
    # across more than five intervals a spline tells nothing
    assert spline.unknown(scans, at).all() == (gap > 0.5)


def test_scans_at_equal_intervals_have_no_gaps_nor_have_those_whose_stamps_jitter():
    times, at = np.arange(0, 10, 0.1), np.arange(0.05, 9.9, 0.1)
    rng = np.random.default_rng(0)
    for jitter in (0.0, 0.02):
        shaken = times + rng.uniform(-jitter, jitter, len(times)) / 2
        assert not (spline._in_gaps(shaken) > 1).any()
        assert not spline.unknown(Trajectory(shaken, hand(0)(shaken)), at).any()


def drifting(seed, poses, times, rate=0.02):
    """An odometry that drifts as a random walk, by so many m and rad in a second."""
    rng = np.random.default_rng(seed)
    step = np.diff(times, prepend=times[0])
    walk = np.cumsum(rng.normal(size=(len(times), 6)) * rate * np.sqrt(step)[:, None], axis=0)
    return geometry.exp(walk) @ poses(times)


@pytest.mark.parametrize("case", ["gap", "end", "begin"])
def test_the_odometry_drifts_where_scans_are_far_by_as_much_as_is_expected(case):
    normalized, usual = [], []
    for seed in range(20):
        poses = hand(seed)
        every = np.arange(0, 24.0, 0.1)
        rough = drifting(seed, poses, every)
        kept = {
            "gap": (every < 9) | (every > 15),
            "end": every < 18,
            "begin": every > 6,
        }[case]
        scans = Trajectory(every[kept], rough[kept])
        images = every[5::10] + 0.05
        near = rough[5::10] @ geometry.inverse(poses(every[5::10])) @ poses(images)
        refined = poses(scans.times)
        carried = carry(scans, refined, Trajectory(images, near @ EXTRINSIC), EXTRINSIC)
        off = geometry.log(geometry.inverse(poses(images)) @ carried.world_from_sensor @ NEAR)
        far = carried.drift[:, 1] > 0
        beyond = np.maximum(scans.times[0] - images, images - scans.times[-1])
        assert far.sum() == {"gap": 6, "end": 6, "begin": 6}[case]
        assert (beyond[far] > 0).all() == (case != "gap")
        # all of them together count as one: by so much is the expectation of each wider
        alone = carried.drift[far] / np.sqrt(far.sum())
        normalized.append(off[far].reshape(-1, 2, 3) / alone[:, :, None])
        usual.append(np.abs(off[~far, 3:]).max())
    ratio = np.sqrt(np.square(normalized).mean(axis=(0, 1, 3)))
    assert (ratio < 2.0).all()
    assert (ratio > 0.3).all()
    assert max(usual) < 0.04


def test_cameras_far_from_scans_are_held_by_what_the_odometry_may_drift():
    poses, every = hand(1), np.arange(0, 24.0, 0.1)
    rough = drifting(1, poses, every)
    images = every[5::10]
    priors = [
        trajectory_prior.build(
            Trajectory(every[:last], rough[:last]), poses(every[:last]),
            Trajectory(images, rough[5::10] @ EXTRINSIC), NEAR,
        )
        for last in (180, 240)
    ]  # fmt: skip
    far = images > every[179] + 0.1
    sizes = [trajectory_prior.sigmas(prior.sources[0])[:, 3:] for prior in priors]
    assert (sizes[0][far] > 2 * sizes[1][far]).all()
    np.testing.assert_array_equal(sizes[0][~far], sizes[1][~far])
    solved = trajectory_prior.take(priors[0], np.flatnonzero(~far))
    spread = trajectory_prior.expected_spread(
        priors[0], solved, priors[0].calibration.reference, np.flatnonzero(~far)
    )
    assert (
        np.trace(spread[far, 3:, 3:], axis1=1, axis2=2) > np.square(sizes[0][far]).sum(axis=1) * 0.5
    ).all()


def test_times_in_gaps_and_beyond_the_ends_are_far_from_scans():
    scans = np.r_[np.arange(0, 5, 0.5), np.arange(9, 12, 0.5)]
    at = np.array([-0.6, -0.4, 0.2, 4.4, 4.7, 8.9, 9.1, 11.8, 12.1])
    assert far(scans, at).tolist() == [True, False, False, False, True, True, False, False, True]
    assert not far(scans[:1], at).any()
