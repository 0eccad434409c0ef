"""Which corrections of a camera's calibration are made: those that cannot be chance, by a plain regression as twin."""

import numpy as np
import pytest

from lvba.optim.shared_parameters import SharedPrior, information
from lvba.visual import fixed_calibration
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration

LAYOUT = Calibration.layout()
SIGMA = np.concatenate([np.broadcast_to(s, LAYOUT.kinds[n].size) for n, s in PriorConfig().sigma.items()])


def estimate(true, rows, noise=1.0, seed=0):
    """Deviations and covariance from rows of a linear model, with the prior's zero as one more observation of each."""
    measured = rows @ true + noise * np.random.default_rng(seed).normal(size=len(rows))
    covariance = np.linalg.inv(rows.T @ rows / noise**2 + np.diag(SIGMA**-2.0))
    return covariance @ rows.T @ measured / noise**2, covariance


def rows_of(count, seed=1):
    """Each number seen about twenty times as well as its prior knows it, all mixed."""
    return np.random.default_rng(seed).normal(size=(count, LAYOUT.size)) / SIGMA * 20 / np.sqrt(count)


def insignificant(off, covariance, per_pixel=1.0):
    """By a covariance that is as the information has it; per_pixel of 1: all that is not chance moves patches enough."""
    return fixed_calibration.insignificant(
        off, fixed_calibration.Precision(covariance=covariance, plain=covariance, per_pixel=per_pixel)
    )


def wrong(**off):
    true = np.zeros(LAYOUT.size)
    for name, value in off.items():
        true[LAYOUT[name]] = value
    return true


def test_right_calibrations_are_left_alone():
    fixed = [insignificant(*estimate(wrong(), rows_of(300), seed=s)) for s in range(200)]
    assert all(names == fixed_calibration.CORRECTIONS for names in fixed)


@pytest.mark.parametrize(
    ("name", "value"), [("focal", (0.01, 0)), ("principal_point", (4, 0)), ("readout", 0.02)]
)
def test_a_wrong_one_is_corrected_and_only_that(name, value):
    """But for what is two standard deviations off by chance beside a number of the same camera."""
    fixed = [insignificant(*estimate(wrong(**{name: value}), rows_of(300), seed=seed)) for seed in range(100)]
    assert not any(name in each for each in fixed)
    others = sum(len(each) < 3 for each in fixed)
    assert others <= (18 if name in fixed_calibration.INTRINSICS else 0)


def test_what_looks_like_a_turned_camera_is_not_corrected():
    """A principal point that only a turn of the camera differs from by nothing."""
    rows = rows_of(300)
    place = np.arange(LAYOUT.size)[LAYOUT["principal_point"]]
    turn = np.arange(LAYOUT.size)[LAYOUT["scan_from_camera"]][:2]
    rows[:, place] = rows[:, turn] * SIGMA[turn] / SIGMA[place]
    off, covariance = estimate(wrong(principal_point=4), rows)
    assert abs(off[place]).min() > 1  # half of it is taken for the one, half for the other
    assert "principal_point" in insignificant(off, covariance)


def test_the_others_are_judged_as_they_are_without_what_is_fixed():
    """Two that each could be chance beside the other, but not both: one is kept, whichever it is."""
    rows = rows_of(300)
    readout, focal = LAYOUT["readout"], LAYOUT["focal"].start
    rows[:, readout] = (rows[:, focal] * SIGMA[focal] / SIGMA[readout])[:, None] * (
        1 + 0.02 * np.random.default_rng(3).normal(size=(300, 1))
    )
    off, covariance = estimate(wrong(readout=0.02), rows)
    fixed = insignificant(off, covariance)
    assert ("readout" in fixed) != ("focal" in fixed)


def test_estimates_without_a_parameter_are_those_of_a_model_without_it():
    rows, place = rows_of(300), LAYOUT["principal_point"]
    off, covariance = estimate(wrong(focal=0.01, principal_point=3), rows)
    index = np.arange(LAYOUT.size)[place]
    others = np.setdiff1d(np.arange(LAYOUT.size), index)
    less = rows[:, others]
    measured = rows @ wrong(focal=0.01, principal_point=3) + np.random.default_rng(0).normal(size=300)
    expected = np.linalg.inv(less.T @ less + np.diag(SIGMA[others] ** -2.0))
    found, spread = fixed_calibration._without(off, covariance, index)
    np.testing.assert_allclose(found[others], expected @ less.T @ measured, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(spread[np.ix_(others, others)], expected, rtol=1e-6, atol=1e-12)


def held_off(true, rows, held, seed):
    """By how much numbers that are held would move all others, and what they should be, were they free: a twin."""
    index = np.arange(LAYOUT.size)[LAYOUT[held]]
    others = np.setdiff1d(np.arange(LAYOUT.size), index)
    off, covariance = estimate(true, rows, seed=seed)
    without = np.zeros(LAYOUT.size)
    without[others] = fixed_calibration._without(off, covariance, index)[0][others]
    known = fixed_calibration.Precision(covariance=covariance, plain=covariance, per_pixel=1.0)
    return off - without, without, known


@pytest.mark.parametrize("size", [0.0, 0.5, 4.0])
def test_what_is_promised_with_a_number_held_covers_what_is_wrong_with_it(size):
    """A camera that is turned looks much like a principal point: held, that turns the camera."""
    rows = rows_of(300)
    place, turn = LAYOUT["principal_point"].start, LAYOUT["scan_from_camera"].start
    alike = rows[:, turn] * SIGMA[turn] + np.random.default_rng(4).normal(size=300) * 0.3
    rows[:, place] = alike / SIGMA[place]
    true, ratios, parts = wrong(principal_point=(size, 0)), [], []
    for seed in range(60):
        step, without, known = held_off(true, rows, "principal_point", seed)
        part = fixed_calibration.significant_fraction(step, known, ["principal_point"])
        promised = known.covariance[turn, turn] + part * step[turn] ** 2
        ratios.append((without[turn] - true[turn]) ** 2 / promised)
        parts.append(part)
    assert np.mean(ratios) < 1.5
    assert {0.0: np.mean(parts) < 0.3, 0.5: np.mean(parts) < 0.6, 4.0: np.mean(parts) > 0.8}[size]


def test_a_camera_of_which_another_number_is_refuted_is_not_trusted():
    """A principal point that is four standard deviations off: corrected beside a focal length that is wrong, else not."""
    rows, made = rows_of(300), []
    for focal in (0.01, 0.0):
        counts = 0
        for seed in range(40):
            off, covariance = estimate(wrong(focal=(focal, 0), principal_point=(1.2, 0)), rows, seed=seed)
            counts += "principal_point" not in insignificant(off, covariance)
        made.append(counts)
    assert made[0] > 30
    assert made[1] < 10
    chance = [
        "principal_point" not in insignificant(*estimate(wrong(focal=(0.01, 0)), rows, seed=seed))
        for seed in range(200)
    ]
    assert np.mean(chance) < 0.1, "right ones stay, but for chance"


def test_what_interpolation_does_to_a_held_number_is_doubted_in_a_camera_that_is_refuted():
    step, _, known = held_off(wrong(principal_point=(4, 0)), rows_of(300), "principal_point", 0)
    coarse = fixed_calibration.Precision(covariance=known.covariance, plain=known.plain, per_pixel=1e9)
    trusted = (*fixed_calibration.INTRINSICS, "readout")
    assert fixed_calibration.significant_fraction(step, coarse, ["principal_point"]) > 0.9
    assert fixed_calibration.significant_fraction(step, coarse, trusted) == 0.0


def test_what_interpolation_does_to_a_held_number_is_no_doubt():
    step, _, known = held_off(wrong(principal_point=(4, 0)), rows_of(300), "principal_point", 0)
    held = fixed_calibration.INTRINSICS
    part = fixed_calibration.significant_fraction(step, known, held)
    coarse = fixed_calibration.Precision(covariance=known.covariance, plain=known.plain, per_pixel=1e9)
    assert part > 0.5
    assert fixed_calibration.significant_fraction(step, coarse, held) == 0.0


def test_held_means_at_the_reference():
    claimed = information(LAYOUT, PriorConfig().sigma)
    prior = SharedPrior(Calibration(np.eye(4)), claimed, 3 * claimed)
    fixed = fixed_calibration.with_fixed(prior, ["readout"])
    assert fixed.information[LAYOUT["readout"], LAYOUT["readout"]] == 1e8 / 0.02**2
    others = np.arange(LAYOUT.size) != LAYOUT["readout"].start
    np.testing.assert_array_equal(
        fixed.information[np.ix_(others, others)], 3 * claimed[np.ix_(others, others)]
    )
    assert fixed.reference is prior.reference


def test_what_moves_patches_by_less_than_interpolation_must_be_told_from_all_others():
    """A lens that looks much like another focal length: one of the two is corrected where patches move enough."""
    rows, focal = rows_of(300), LAYOUT["focal"].start
    lens = np.arange(LAYOUT.size)[LAYOUT["distortion"]]
    alike = rows[:, focal] * SIGMA[focal]
    rows[:, lens] = 0.0
    rows[:, lens[0]] = (alike + 0.2 * np.random.default_rng(3).normal(size=300)) / SIGMA[lens[0]]
    off, covariance = estimate(wrong(distortion=(0.01, 0, 0, 0)), rows)
    alone = fixed_calibration._without(off, covariance, np.arange(LAYOUT.size)[LAYOUT["focal"]])
    squared = fixed_calibration._squared(*alone, lens)
    assert fixed_calibration._chance(*alone, lens) < fixed_calibration.CHANCE
    assert fixed_calibration._chance(off, covariance, lens) > fixed_calibration.APART
    bias = fixed_calibration.AMBIGUOUS_PX
    corrected = set(fixed_calibration.CORRECTIONS) - set(
        insignificant(off, covariance, squared / (2 * bias) ** 2)
    )
    assert corrected in ({"distortion"}, {"focal"})
    assert insignificant(off, covariance, squared / (0.5 * bias) ** 2) == fixed_calibration.CORRECTIONS


@pytest.mark.parametrize(("moved", "made"), [(1.5, True), (0.7, False)])
def test_a_small_correction_that_is_told_from_all_others_is_made_unless_interpolation_does_as_much(
    moved, made
):
    off, covariance = estimate(wrong(focal=(0.01, 0)), rows_of(300))
    squared = fixed_calibration._squared(off, covariance, np.arange(LAYOUT.size)[LAYOUT["focal"]])
    per_pixel = squared / (moved * fixed_calibration.BIAS_PX) ** 2
    assert fixed_calibration.BIAS_PX * moved < fixed_calibration.AMBIGUOUS_PX
    assert ("focal" not in insignificant(off, covariance, per_pixel)) == made
