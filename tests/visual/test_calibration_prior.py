"""What the calibration counts beside images that overstate what they tell of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm
from test_trajectory_prior import moved, problem

from lvba.optim.linear_solver import Covariance
from lvba.visual import calibration_prior, planes_off, trajectory_prior
from lvba.visual.calibration_prior import Evidence
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration

CLAIMS = calibration_prior.build(Calibration(np.eye(4)), PriorConfig().sigma).claimed

SIZE = len(CLAIMS)
EXTRINSIC = Calibration.layout()["scan_from_camera"]


def told(seed: int, strength: float) -> np.ndarray:
    """(SIZE, SIZE): information of images, so many times that of the calibration, with axes of their own."""
    factor = np.random.default_rng(seed).normal(size=(SIZE, 40)) / np.sqrt(40)
    root = np.sqrt(CLAIMS)
    return np.asarray(strength * root @ factor @ factor.T @ root)


def test_claims_are_the_inverse_variances():
    mounting = [np.radians(0.3)] * 3 + [0.01] * 3 + [0.02]
    intrinsics = [0.01, 0.001, 5.0, 5.0, 0.02, 0.02, 0.002, 0.002]
    sigma = np.array([*mounting, *intrinsics, 0.02, 0.001])
    assert np.diag(CLAIMS) == pytest.approx(1 / sigma**2)
    assert np.count_nonzero(CLAIMS) == SIZE


@pytest.mark.parametrize("overstated", [0.1, 1.0])
def test_images_that_keep_what_they_promise_leave_the_calibration_as_it_is(overstated):
    images = told(0, 50.0)
    assert calibration_prior.weighed(images, overstated * images, CLAIMS) == pytest.approx(
        CLAIMS, rel=1e-6, abs=1e-3
    )


def test_images_that_overstate_all_alike_meet_the_calibration_where_honest_ones_would():
    images = told(1, 50.0)
    wants = np.random.default_rng(3).normal(size=SIZE) / np.sqrt(np.diag(CLAIMS))
    counts = calibration_prior.weighed(images, 30 * images, CLAIMS)
    assert counts == pytest.approx(30 * CLAIMS, rel=1e-6, abs=1e-3)
    met = np.linalg.solve(images + counts, images @ wants)
    assert met == pytest.approx(np.linalg.solve(images / 30 + CLAIMS, images @ wants / 30))


def test_walls_that_contradict_each_other_in_one_direction_are_doubted_there_alone():
    images = 1000 * CLAIMS
    contradiction = np.zeros(SIZE)
    contradiction[3] = np.sqrt(400 * images[3, 3])
    spread = 0.5 * images + np.outer(contradiction, contradiction)
    counts = calibration_prior.weighed(images, spread, CLAIMS)
    assert counts[3, 3] == pytest.approx(400.5 * CLAIMS[3, 3])
    others = np.delete(np.arange(SIZE), 3)
    assert counts[np.ix_(others, others)] == pytest.approx(CLAIMS[np.ix_(others, others)])


@pytest.mark.parametrize("seed", range(5))
def test_the_calibration_never_counts_less_than_it_claims(seed):
    counts = calibration_prior.weighed(told(seed, 20.0), told(seed + 100, 300.0), CLAIMS)
    assert np.linalg.eigvals(np.linalg.solve(CLAIMS, counts)).real.min() > 1 - 1e-9
    assert counts == pytest.approx(counts.T)


@pytest.mark.parametrize("seed", range(8))
def test_no_direction_of_the_extrinsic_is_less_certain_than_calibrated(seed):
    """One contradiction along an axis that neither images nor calibration share, 3,000 times what noise explains: by the
    variance of the estimate, written out. Without the limit it is 80 to 110 times that of the calibration."""
    images = told(seed, 300.0)
    axis = np.sqrt(300 * np.diag(CLAIMS)) * np.random.default_rng(seed + 50).normal(size=SIZE)
    spread = images + 3000 * np.outer(axis, axis)
    counts = calibration_prior.weighed(images, spread, CLAIMS)
    back = np.linalg.inv(images + counts)
    variance = back @ (spread + counts @ np.linalg.inv(CLAIMS) @ counts) @ back
    root = np.sqrt(CLAIMS)
    assert np.linalg.eigvalsh((root @ variance @ root)[:6, :6]).max() < 1.02


def test_errors_of_ranges_that_planes_share_leave_the_extrinsic_to_its_calibration():
    """Images that know the extrinsic ten times better than its calibration, over planes that are off together by
    twice as much as that claims: what is left of their word is that of planes 2 cm off, so a fifth of the way is gone."""
    prior, _ = problem()
    extrinsic = Calibration.layout()["scan_from_camera"]
    said = Evidence(100 * CLAIMS, 100 * CLAIMS, np.zeros(SIZE))
    off = np.diag(np.repeat(np.square([2 * float(np.radians(0.3)), 0.02]), 3))
    alone = trajectory_prior.weighed(prior, said).calibration
    shared = trajectory_prior.weighed(replace(prior, planes_off=off), said).calibration
    wants = np.zeros(SIZE)
    wants[extrinsic] = 1.0
    for known, part in ((alone, 100 / 101), (shared, 0.2)):
        found = np.linalg.solve(said.information + known.information, said.information @ wants)
        assert found[extrinsic] == pytest.approx(np.full(6, part), rel=0.02)
    others = np.setdiff1d(np.arange(SIZE), np.arange(SIZE)[extrinsic])
    assert shared.information[np.ix_(others, others)] == pytest.approx(CLAIMS[np.ix_(others, others)])


@pytest.mark.parametrize("strength", [0.1, 1.0, 30.0])
def test_cameras_that_images_hold_move_with_planes_that_errors_of_ranges_move(strength):
    """By a dense system: images say where cameras are on planes, which are all off the sensor by the same, so the
    solution is off what it would be by the pull of that."""
    prior, state = problem()
    factor = np.random.default_rng(5).normal(size=(3, 3, 40))
    off = 1e-5 * factor[0] @ factor[0].T
    moments = np.block([[off, 0.1 * off], [0.1 * off, 2 * off]])
    prior = replace(prior, planes_off=moments)
    cameras = len(state.cameras.world_from_camera)
    equations = trajectory_prior.linearize(prior, state)
    by_prior = equations.sparse().toarray()
    images = np.zeros_like(by_prior)
    for camera in range(cameras):
        mine = slice(7 * camera, 7 * camera + 6)
        images[mine, mine] = strength * by_prior[mine, mine] * np.random.default_rng(camera).uniform(0.5, 2)
        images[mine.stop, mine.stop] = 1.0  # its exposure
    inverse = np.linalg.inv(by_prior + images)
    following = np.zeros((len(inverse), 6))
    for axis in range(6):
        following[np.arange(cameras) * 7 + axis, axis] = 1.0
    moved = inverse @ images @ following
    expected = moved @ moments @ moved.T

    def blocks(matrix):
        square = matrix[: 7 * cameras, : 7 * cameras].reshape(cameras, 7, cameras, 7)
        corner = matrix[7 * cameras :, 7 * cameras :]
        with_shared = matrix[: 7 * cameras, 7 * cameras :].reshape(cameras, 7, -1)
        return Covariance(square[np.arange(cameras), :, np.arange(cameras)], with_shared, corner)

    known = blocks(inverse)
    more = planes_off.with_planes_off(known, known, prior, state.calibration)
    for name in ("blocks", "with_shared", "shared"):
        added = getattr(more, name) - getattr(known, name)
        assert added == pytest.approx(getattr(blocks(expected), name), rel=5e-3, abs=1e-8)
    by_calibration = planes_off.of_calibration(known.shared, prior, state.calibration)
    assert by_calibration == pytest.approx(more.shared - known.shared, rel=1e-6, abs=1e-12)


def seen(sigmas: float, information: np.ndarray, spread: np.ndarray) -> Evidence:
    """Images that see each number of the extrinsic so many claimed standard deviations off, all else as calibrated."""
    off = np.zeros(SIZE)
    off[EXTRINSIC] = sigmas / np.sqrt(np.diag(CLAIMS)[EXTRINSIC])
    return Evidence(information, spread, information @ off)


@pytest.mark.parametrize(("sigmas", "factor"), [(0.5, 1.0), (1.0, 1.0), (5.0, (6 * 25 + 1) / 7)])
def test_an_extrinsic_that_is_seen_further_off_than_it_claims_is_good_for_less(sigmas, factor):
    """As the mean of squares has it, of six numbers that are seen and one that is supposed."""
    certain = 1e6 * CLAIMS
    said = seen(sigmas, certain, certain)
    good = calibration_prior.granted(said, said.spread, CLAIMS)
    assert good[EXTRINSIC, EXTRINSIC] == pytest.approx(CLAIMS[EXTRINSIC, EXTRINSIC] / factor, rel=1e-3)
    assert np.diag(good)[EXTRINSIC.stop :] == pytest.approx(np.diag(CLAIMS)[EXTRINSIC.stop :])


@pytest.mark.parametrize("seed", range(4))
def test_an_extrinsic_as_good_as_it_claims_stays_so(seed):
    """Drawn as it claims, seen by images that are ten times more certain: the mean over draws, and no large factor."""
    rng, certain = np.random.default_rng(seed), 100 * CLAIMS
    factors = []
    for _ in range(200):
        off = (np.sqrt(1.01) * rng.normal(size=SIZE)) / np.sqrt(np.diag(CLAIMS))
        good = calibration_prior.granted(Evidence(certain, certain, certain @ off), certain, CLAIMS)
        factors.append(CLAIMS[0, 0] / good[0, 0])
    assert 1.0 <= np.mean(factors) < 1.3
    assert np.quantile(factors, 0.95) < 2.2


def test_images_that_contradict_themselves_do_not_tell_a_calibration_that_it_is_wrong():
    """A Kinect's: they see it five standard deviations off, and are no more certain than it is."""
    information = 50 * CLAIMS
    said = seen(5.0, information, 2500 * CLAIMS)
    assert calibration_prior.granted(said, said.spread, CLAIMS) == pytest.approx(CLAIMS)
    sure = replace(said, spread=information)
    assert calibration_prior.granted(sure, sure.spread, CLAIMS)[0, 0] < 0.1 * CLAIMS[0, 0]


def test_evidence_of_parts_about_a_wrong_calibration_adds_up():
    certain = 1e4 * CLAIMS
    part = seen(5.0, certain, certain)
    both = part + part
    one, two = (calibration_prior.granted(said, said.spread, CLAIMS) for said in (part, both))
    assert two == pytest.approx(one, rel=1e-3)


def test_a_wrong_extrinsic_is_left_where_images_see_it_off_and_contradict_each_other_in_one_direction():
    """5 cm and 1.5 degrees off, five times its claims. Held as claimed against a contradiction, the estimate stays
    behind; its variance is that of what it is good for."""
    prior, _ = problem()
    information, axis = 1000 * CLAIMS, np.zeros(SIZE)
    axis[4] = np.sqrt(300 * information[4, 4])
    said = seen(5.0, information, information + np.outer(axis, axis))
    off = np.linalg.solve(information, said.pull)
    weighed = trajectory_prior.weighed(prior, said).calibration
    claimed = calibration_prior.weighed(information, said.spread, CLAIMS)
    left = [
        (off - np.linalg.solve(information + counted, said.pull))[4] / off[4]
        for counted in (claimed, weighed.information)
    ]
    assert left[0] > 0.2
    assert 0 < left[1] < 0.03
    good, counted = weighed.granted, weighed.information
    varies = counted @ np.linalg.inv(good) @ counted
    assert weighed.gradient_variance(weighed.reference) == pytest.approx(varies, abs=1e-6)


def test_images_that_tell_nothing_in_some_directions_leave_finite_weights():
    nothing = np.zeros((SIZE, SIZE))
    nothing[0, 0] = CLAIMS[0, 0]
    counts = calibration_prior.weighed(nothing, nothing, CLAIMS)
    assert counts == pytest.approx(CLAIMS, rel=1e-6, abs=1e-3)
    # as rounding leaves it: a little less than nothing
    assert np.isfinite(calibration_prior.weighed(nothing - 1e-9 * CLAIMS, nothing, CLAIMS)).all()


def test_a_calibration_that_counts_more_keeps_derivatives_and_tells_the_spread_it_claims():
    prior, state = problem(scatter=0.004)
    prior = replace(prior, drifting=True)
    known = prior.calibration
    weighed = replace(prior, calibration=replace(known, counted=50 * known.claimed))
    rng = np.random.default_rng(5)
    equations = trajectory_prior.linearize(weighed, state)
    assert equations.border is not None
    step, h = rng.normal(size=SIZE), 1e-6
    ahead = trajectory_prior.linearize(weighed, moved(state, np.zeros((30, 6)), h * step)).cost
    behind = trajectory_prior.linearize(weighed, moved(state, np.zeros((30, 6)), -h * step)).cost
    assert (ahead - behind) / (2 * h) == pytest.approx(equations.border.gradient @ step, rel=1e-5)
    last = slice(210, 210 + SIZE)
    own = [each.dense()[last, last] for each in (trajectory_prior.linearize(prior, state), equations)]
    frames = own[0] - known.hessian(state.calibration)
    spread = trajectory_prior.gradient_variance(weighed, state).dense()[last, last]
    # 50 times the weight on an error of the same size: 2,500 times the variance
    assert spread - frames == pytest.approx(2500 * (own[0] - frames), rel=1e-6, abs=1e-3)
    assert trajectory_prior.gradient_variance(prior, state).dense() == pytest.approx(
        trajectory_prior.linearize(prior, state).dense()
    )


@pytest.mark.parametrize(
    ("axis", "sigmas", "certainty"), [(3, 4.0, 1.0), (3, 0.0, 1.0), (0, 2.0, 5.0), (5, 100.0, 5.0)]
)
def test_how_far_an_extrinsic_moved_and_on_what_word(axis, sigmas, certainty):
    prior = calibration_prior.build(Calibration(np.eye(4)), PriorConfig().sigma)
    step = np.zeros(SIZE)
    step[axis] = sigmas / np.sqrt(CLAIMS[axis, axis])
    moved = prior.reference.retract(step)
    found = calibration_prior.extrinsic_change(moved, prior, np.linalg.inv(CLAIMS) / certainty**2)
    assert found.certainty == pytest.approx(certainty if sigmas else 1.0)
    # of six numbers one is off: as unlikely as fewer standard deviations of a single one
    chance = 2 * norm.sf(found.sigmas)
    assert chance == pytest.approx(max(chi2.sf(sigmas**2, 6), 1e-300), rel=1e-6)
