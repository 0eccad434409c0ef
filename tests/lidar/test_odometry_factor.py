"""How wrong the odometry is, read off its errors where planes hold the scans."""

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar.odometry_factor import by_turns, odometry_prior, reestimated, with_jumps, with_pauses

CEILING = np.repeat([0.01, 0.05], 3)


def walk(count: int = 200, rotation: float = 0.002, translation: float = 0.008, seed: int = 0):
    """Refined poses (S, 4, 4), and rough ones whose steps are off by these standard deviations (rad, m)."""
    rng = np.random.default_rng(seed)
    step = geometry.exp(np.tile([0.0, 0.0, 0.02, 0.3, 0.0, 0.0], (count, 1)))
    off = rng.normal(size=(count, 6)) * np.repeat([rotation, translation], 3)
    refined, rough = [np.eye(4)], [np.eye(4)]
    for one, wrong in zip(step, geometry.exp(off), strict=True):
        refined.append(refined[-1] @ one)
        rough.append(rough[-1] @ one @ wrong)
    return np.stack(refined), np.stack(rough)


def sigmas(prior) -> np.ndarray:
    return 1 / np.sqrt(np.diagonal(prior.information, axis1=1, axis2=2))


def test_it_is_found_in_spite_of_slips_and_these_are_as_uncertain_as_it_may_be():
    refined, rough = walk()
    slips = np.array([50, 100, 150])
    for at in slips:
        slip = (
            rough[at] @ geometry.exp(np.array([0.3, 0.0, 0.0, 1.0, 0.0, 0.0])) @ geometry.inverse(rough[at])
        )
        rough[at:] = slip @ rough[at:]
    prior = odometry_prior(rough, 0.01, 0.05)
    found = sigmas(reestimated(prior, refined, np.ones(201, bool)))
    others = np.delete(found, slips - 1, axis=0)
    assert others == pytest.approx(np.tile(np.repeat([0.002, 0.008], 3), (197, 1)), rel=0.15)
    assert found[slips - 1] == pytest.approx(np.tile(CEILING, (3, 1)))


def test_steps_of_a_wrong_speed_hold_nothing():
    """For the solution and for expected errors: an odometry may begin with a wrong speed. Where planes do not hold scans,
    errors tell nothing."""
    refined, rough = walk(translation=0.002)
    for at in range(1, 7):
        late = rough[at] @ geometry.exp(np.array([0, 0, 0, 0.03, 0, 0])) @ geometry.inverse(rough[at])
        rough[at:] = late @ rough[at:]
    for estimate in (reestimated, by_turns):
        found = sigmas(estimate(odometry_prior(rough, 0.01, 0.05), refined, np.arange(201) != 3))
        off = np.array([0, 1, 4, 5])
        assert (found[off, 3:] > 0.01).all()
        others = np.delete(found, off, axis=0)
        assert others[:, 3:] == pytest.approx(np.full((196, 3), 0.002), rel=0.3)
        assert found[off, :3] == pytest.approx(np.full((4, 3), 0.002), rel=0.3)


def test_steps_that_turn_are_known_less_well_where_the_odometry_errs_in_turns():
    rng = np.random.default_rng(1)
    turn = rng.permutation(np.repeat([0.01, 0.2, 0.6], 70))
    step = geometry.exp(np.outer(turn, [0, 0, 1.0, 0, 0, 0]) + np.array([0, 0, 0, 0.3, 0, 0]))
    off = rng.normal(size=(210, 6)) * np.repeat([0.002, 0.008], 3) * (1 + 10 * turn[:, None])
    refined, rough = [np.eye(4)], [np.eye(4)]
    for one, wrong in zip(step, geometry.exp(off), strict=True):
        refined.append(refined[-1] @ one)
        rough.append(rough[-1] @ one @ wrong)
    prior, held = odometry_prior(np.stack(rough), 0.01, 0.05), np.ones(211, bool)
    found = sigmas(by_turns(prior, np.stack(refined), held))
    for each in (0.01, 0.2, 0.6):
        expected = np.repeat([0.002, 0.008], 3) * (1 + 10 * each)
        assert np.median(found[turn == each], axis=0) == pytest.approx(expected, rel=0.3)


def test_scans_that_planes_do_not_hold_have_no_vote():
    refined, rough = walk()
    held = np.arange(201) >= 120
    # these sit at the odometry for want of anything better, and so agree with it
    refined[:120] = refined[120] @ geometry.inverse(rough[120]) @ rough[:120]
    found = sigmas(reestimated(odometry_prior(rough, 0.01, 0.05), refined, held))
    assert found[0] == pytest.approx(np.repeat([0.002, 0.008], 3), rel=0.25)


def test_few_scans_change_nothing_and_no_estimate_passes_its_limits():
    refined, rough = walk(rotation=0.5, translation=0.5)
    prior = odometry_prior(rough, 0.01, 0.05)
    assert reestimated(prior, refined, np.arange(201) < 9) is prior
    assert sigmas(reestimated(prior, refined, np.ones(201, bool)))[0] == pytest.approx(CEILING)
    perfect = sigmas(reestimated(odometry_prior(refined, 0.01, 0.05), refined, np.ones(201, bool)))
    assert (perfect > 1e-4).all()


def test_what_is_promised_may_be_worse_than_expected_but_not_without_end():
    refined, rough = walk(translation=0.15)
    prior, held = odometry_prior(rough, 0.01, 0.05), np.ones(201, bool)
    assert np.median(sigmas(by_turns(prior, refined, held)), axis=0)[3:] == pytest.approx(0.15, rel=0.2)
    assert sigmas(reestimated(prior, refined, held))[:, 3:] == pytest.approx(0.05)
    far = odometry_prior(walk(translation=1.0)[1], 0.01, 0.05)
    assert sigmas(by_turns(far, refined, held)).max() == pytest.approx(0.2)
    assert by_turns(prior, refined, np.arange(201) < 9) is prior


def test_jumps_have_no_vote_and_are_held_by_next_to_nothing():
    refined, rough = walk()
    jumps = np.arange(0, 200, 3)
    prior = with_jumps(odometry_prior(rough, 0.01, 0.05), jumps, refined)
    assert prior.residuals(refined)[jumps] == pytest.approx(0.0, abs=1e-9)
    known = reestimated(prior, refined, np.ones(201, bool))
    expected = np.tile(np.repeat([0.002, 0.008], 3), (200, 1))
    expected[jumps] = np.repeat([np.radians(4.0), 0.6], 3)
    assert sigmas(known) == pytest.approx(expected, rel=0.15)


def test_some_scans_have_the_odometry_between_them():
    refined, rough = walk()
    prior = with_jumps(odometry_prior(rough, 0.01, 0.05), np.array([50, 120]), refined)
    part = prior.among(np.arange(100, 150))
    assert part.jumps.tolist() == [20]
    assert np.array_equal(part.residuals(refined[100:150]), prior.residuals(refined)[100:149])


def test_steps_across_a_pause_are_as_uncertain_as_it_is_long_and_have_no_vote():
    refined, rough = walk()
    times = np.arange(201.0)
    times[101:] += 19.0  # the step after scan 100 takes twenty times as long as the others
    # in which the odometry drifted
    rough[101:] = (
        rough[100] @ geometry.exp(np.repeat([0.03, 0.15], 3)) @ geometry.inverse(rough[100]) @ rough[101:]
    )
    held = np.ones(201, bool)
    plain = odometry_prior(rough, 0.01, 0.05)
    prior = with_pauses(plain, times)
    ordinary = np.delete(np.arange(200), 100)
    np.testing.assert_array_equal(prior.information[ordinary], plain.information[ordinary])
    assert sigmas(prior)[100] == pytest.approx(20 * sigmas(plain)[100])
    for estimate in (reestimated, by_turns):
        known = sigmas(estimate(prior, refined, held))
        assert known[ordinary] == pytest.approx(np.tile(np.repeat([0.002, 0.008], 3), (199, 1)), rel=0.3)
        assert known[100] == pytest.approx(20 * np.repeat([0.002, 0.008], 3), rel=0.3)
    few = prior.among(np.arange(90, 111))
    assert sigmas(few)[10] == pytest.approx(sigmas(prior)[100])
    assert few.spans[10] == pytest.approx(20)


def test_stamps_that_jitter_and_jumps_are_no_pauses():
    refined, rough = walk()
    times = np.arange(201.0) + np.random.default_rng(0).uniform(-0.4, 0.4, 201)
    prior = odometry_prior(rough, 0.01, 0.05)
    assert with_pauses(prior, times) is prior
    times[101:] += 19.0
    jumps = with_jumps(prior, np.array([100]), refined)
    assert with_pauses(jumps, times) is jumps
