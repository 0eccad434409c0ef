"""The gate judges each part by itself: gains are accepted; losses, chance and what cannot be judged are not."""

from types import SimpleNamespace

import numpy as np
import pytest
from image_scores import scores_of

from lvba.products.evaluate import Scores
from lvba.products.map_quality import EntropyBlocks, EntropyChange
from lvba.steps import acceptance, scan_acceptance, scan_gate
from lvba.steps import evaluate as evaluate_steps
from lvba.steps.acceptance import (
    CARRIED,
    EXPOSED,
    FUSED,
    FUSED_CARRIED,
    FUSED_EXPOSED,
    FUSED_POSED,
    POSED,
    ROUGH,
    VISUAL,
    Figure,
    GateConfig,
    Verdict,
)
from lvba.steps.camera_agreement import Apart
from lvba.steps.outcomes import LidarStage, ScanPoses, VisualStage
from lvba.visual.calibration_prior import NO_CHANGE, ExtrinsicChange

CONFIG = GateConfig()
BASE = np.array([20.0, 22.0, 24.0, 21.0, 25.0])
CHANCE = np.array([0.5, -0.4, 0.3, -0.5, 0.2])
WEAK = 0.5 + CHANCE
"""A gain of 2.6 standard errors."""


def scores(psnr, common=None, ssim=0.5):
    psnr = np.asarray(psnr, float)
    common = psnr if common is None else np.asarray(common, float)
    ssim = np.broadcast_to(np.asarray(ssim, float), psnr.shape)
    per_image = {
        "psnr_leave_one_out": psnr,
        "psnr_compared": common,
        "ssim_leave_one_out": ssim,
        "ssim_compared": ssim,
    }
    return scores_of(per_image)


def entropy(before, after, error=0.005):
    return acceptance.entropy_figure(EntropyChange(before, after, before - after, error), CONFIG)


def images(before, after):
    return acceptance.image_figures(before, after, CONFIG)


@pytest.mark.parametrize(
    ("before", "after", "error", "accepted", "word"),
    [
        (-3.0, -3.1, 0.005, True, "accepted"),
        (-3.0, -3.1, np.nan, True, "accepted"),
        (-3.0, -3.1, 0.06, False, "chance"),
        (-3.0, -3.0, 0.005, False, "not sharper"),
        (-3.0, -3.019, 0.001, False, "not sharper by 0.02 nats"),
        (-3.0, -2.9, 0.005, False, "not sharper"),
        (np.nan, -3.0, np.nan, False, "too thin"),
        (-3.0, np.nan, np.nan, False, "too thin"),
    ],
)
def test_scans_without_images(before, after, error, accepted, word):
    verdict = scan_gate.judge_scans(entropy(before, after, error), (), CONFIG)
    assert verdict.accepted is accepted
    assert word in verdict.reason


@pytest.mark.parametrize(
    ("psnr", "common", "ssim", "accepted"),
    [
        (1.0, 1.0, 0.5, True),
        (-0.09, -0.09, 0.496, True),
        (-1.0, -1.0, 0.5, False),
        (-1.0, -1.0, 0.4, False),
        (-1.0, -1.0, 0.6, True),
        (-1.0, 0.0, 0.5, True),
        (1.0, 1.0, 0.4, True),
        (CHANCE, CHANCE, 0.4, True),
    ],
)
def test_images_may_contradict_a_sharper_map(psnr, common, ssim, accepted):
    """By PSNR over own and common pixels, not against SSIM; losses that mean nothing do not.

    SSIM alone may not: at cameras that are not refined it punishes a sharp map more than a blurred one.
    """
    told = images(scores(BASE), scores(BASE + psnr, BASE + common, ssim))
    verdict = scan_gate.judge_scans(entropy(-3.0, -3.1), told, CONFIG)
    assert verdict.accepted is accepted
    assert accepted or "predicted worse" in verdict.reason
    assert [figure.name for figure in verdict.figures][:2] == ["map_entropy", "psnr_leave_one_out"]


@pytest.mark.parametrize(
    ("after", "error", "psnr", "common", "ssim", "accepted"),
    [
        (-3.1, 0.06, 1.0, 1.0, 0.5, True),
        (-3.1, 0.06, 1.0, 0.0, 0.5, False),
        (-3.1, 0.06, CHANCE, CHANCE, 0.5, False),
        (-3.1, 0.06, 1.0, 1.0, 0.4, True),
        (-3.1, 0.06, 1.0 + CHANCE, 1.0 + CHANCE, 0.4, True),
        (-3.1, 0.06, WEAK, WEAK, 0.5, True),
        (-3.1, 0.06, WEAK, WEAK, 0.4, False),
        (-3.1, 0.06, 0.0, 0.0, 0.6, False),
        (-3.015, 0.001, 1.0, 1.0, 0.5, True),
        (-3.015, 0.013, 1.0, 1.0, 0.5, True),
        (-3.015, 0.016, 1.0, 1.0, 0.5, True),
        (-3.015, 0.016, 1.0, 0.0, 0.5, False),
        (-3.015, np.nan, 1.0, 1.0, 0.5, True),
        (-2.99, 0.012, 1.0, 1.0, 0.5, True),
        (-2.99, 0.012, CHANCE, CHANCE, 0.5, False),
        (-2.99, 0.012, 0.09, 0.09, 0.5, False),  # rendering alone makes as much
        (-3.1, 0.06, 0.09, 0.09, 0.5, True),
        (-2.99, 0.008, 1.0, 1.0, 0.5, False),
        (-2.99, np.nan, 1.0, 1.0, 0.5, False),
        (-2.9, 0.06, 1.0, 1.0, 0.5, False),
        (-2.9, 0.005, 1.0, 1.0, 0.5, False),
    ],
)
def test_images_may_speak_for_a_map_that_is_as_sharp_within_chance(
    after, error, psnr, common, ssim, accepted
):
    """By PSNR over own and common pixels, against SSIM only if far beyond chance; not for a map that loses more than its
    standard error."""
    told = images(scores(BASE), scores(BASE + psnr, BASE + common, ssim))
    verdict = scan_gate.judge_scans(entropy(-3.0, after, error), told, CONFIG)
    assert verdict.accepted is accepted
    assert verdict.reason.startswith("accepted") is accepted


@pytest.mark.parametrize(
    ("after", "error", "shift", "psnr", "word"),
    [
        (-3.005, 0.01, scan_gate.Shift(0.005, 0.001), 0.0, "the map is as sharp"),
        (-2.995, 0.01, scan_gate.Shift(0.005, 0.001), 0.0, "expected to be 1.0 mm off"),
        (-3.005, np.nan, scan_gate.Shift(0.005, 0.001), 0.0, "5.0 mm from these"),
        (-3.005, 0.01, scan_gate.Shift(0.002, 0.001), 0.0, "kept"),
        (-3.005, 0.01, None, 0.0, "kept"),
        (-2.985, 0.01, scan_gate.Shift(0.005, 0.001), 0.0, "kept"),
        (-2.9, 0.01, scan_gate.Shift(0.005, 0.001), 0.0, "kept"),
        (-3.005, 0.01, scan_gate.Shift(0.005, 0.001), -1.0, "as sharp (mean map entropy"),
    ],
)
def test_where_the_map_does_not_tell_scans_are_used_from_which_the_input_s_are_far_off(
    after, error, shift, psnr, word
):
    """Farther than they are expected to be off themselves, unless images contradict, or the map loses."""
    told = images(scores(BASE), scores(BASE + psnr))
    figure = entropy(-3.0, after, error)
    verdict = scan_gate.judge_scans(figure, told, CONFIG, shift=shift)
    assert word in verdict.reason
    assert verdict.accepted is ("kept" not in verdict.reason)
    assert scan_gate.may_be_better(figure) is (after < -2.99)


def test_how_far_the_input_s_scans_are_is_known_where_planes_determine_refined_ones():
    rough = np.tile(np.eye(4), (20, 1, 1))
    rough[:, :3, 3] = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    refined = rough.copy()
    refined[::2, 0, 3] += 0.004
    covariance = np.tile(np.diag([1e-6] * 3 + [1e-6, 2e-6, 1e-6]), (20, 1, 1))
    result = SimpleNamespace(
        world_from_scan=refined,
        converged=True,
        degenerate_directions=(),
        shared_factor=1.0,
        whole_covariance=SimpleNamespace(marginal=covariance),
    )
    shift = scan_acceptance.shift_of(rough, LidarStage(result))
    assert shift.shift_m == pytest.approx(0.002, rel=0.1)
    assert shift.expected_m == pytest.approx(0.002)
    result.shared_factor = 4.0
    assert scan_acceptance.shift_of(rough, LidarStage(result)).expected_m == pytest.approx(0.004)
    result.converged = False
    assert scan_acceptance.shift_of(rough, LidarStage(result)) is None
    assert scan_acceptance.shift_of(rough, LidarStage(None)) is None


@pytest.mark.parametrize(
    ("after", "gain", "agree"),
    [
        (-3.1, WEAK, True),
        (-3.1, CHANCE + 0.1, False),
        (-3.1, WEAK - 1, False),
        (-3.001, WEAK, False),
        (-3.1, np.nan, False),
    ],
)
def test_few_images_do_where_they_speak_for_a_sharper_map(after, gain, agree):
    told = images(scores(BASE), scores(BASE + gain))
    assert scan_gate.images_agree(entropy(-3.0, after), told) is agree


@pytest.mark.parametrize(
    ("psnr", "common", "ssim", "accepted"),
    [
        (CHANCE - 0.2, CHANCE - 0.2, 0.5, False),
        (CHANCE + 0.2, CHANCE + 0.2, 0.5, True),
        (CHANCE - 0.2, CHANCE + 0.2, 0.5, True),
        (CHANCE - 0.2, CHANCE - 0.2, 0.6, True),
        (np.nan, np.nan, np.nan, True),
    ],
)
def test_where_surfaces_leave_motions_open_the_likelier_poses_by_images_are_used(
    psnr, common, ssim, accepted
):
    """The map is as sharp whatever these motions are. A loss that is chance else contradicts nothing."""
    judged_by = images(scores(BASE), scores(BASE + psnr, BASE + common, ssim))
    assert scan_gate.judge_scans(entropy(-3.0, -3.1), judged_by, CONFIG).accepted
    verdict = scan_gate.judge_scans(entropy(-3.0, -3.1), judged_by, CONFIG, open_motions=40)
    assert verdict.accepted is accepted
    assert accepted or "40 motions" in verdict.reason


def test_images_that_cannot_be_judged_contradict_nothing():
    nothing = scores(np.full(5, np.nan), ssim=np.nan)
    assert scan_gate.judge_scans(entropy(-3.0, -3.1), images(nothing, nothing), CONFIG).accepted


@pytest.mark.parametrize(
    ("rough_gain", "before", "after", "error", "accepted"),
    [
        (0.4, -3.0, -3.1, 0.005, True),
        (0.4, -3.0, -3.0, 0.005, True),
        (0.4, -3.0, -2.981, 0.005, True),
        (0.4, -3.0, -2.979, 0.005, False),
        (0.0, -2.6, -2.5995, 0.0005, True),
        (0.0, -2.6, -2.598, 0.0005, False),
        (0.4, np.nan, -3.0, np.nan, False),
        (0.4, -3.0, np.nan, np.nan, False),
    ],
)
def test_scans_that_cameras_moved(rough_gain, before, after, error, accepted):
    """A twentieth of what refining gained may be lost, or what is chance."""
    verdict = acceptance.judge_fusion(rough_gain, [entropy(before, after, error)], (), CONFIG)
    assert verdict.accepted is accepted
    assert ("accepted" if accepted else "less sharp") in verdict.reason


def test_scans_that_cameras_moved_may_be_contradicted_by_images():
    told = images(scores(BASE), scores(BASE - 1))
    assert not acceptance.judge_fusion(0.4, [entropy(-3.0, -3.0)], told, CONFIG).accepted


@pytest.mark.parametrize(("gained", "accepted"), [(5.0, False), (20.0, True)])
def test_a_tenth_of_what_cameras_gained_may_be_given_back(gained, accepted):
    told = images(scores(BASE), scores(BASE - 1))
    of_cameras = images(scores(BASE - gained), scores(BASE))
    assert {each.finding for each in told} >= {"worse"}
    verdict = acceptance.judge_fusion(0.4, [entropy(-3.0, -3.0)], told, CONFIG, of_cameras)
    assert verdict.accepted is accepted


def poses(figures=(), accepted=False):
    blocks = EntropyBlocks(np.arange(2), np.array([[-3.0, 1.0], [-3.0, 1.0]]))
    return ScanPoses(np.eye(4)[None], Verdict(accepted, "", "", figures), -2.6, -3.0, blocks)


def judged(
    carried=BASE,
    exposed=BASE + 1,
    posed=BASE + 1,
    visual=BASE + 2,
    fused=None,
    config=CONFIG,
    extrinsic=NO_CHANGE,
):
    """States given by PSNR, or by scores, with the stages they are from: what decides among them is given."""
    given = {ROUGH: BASE, CARRIED: carried, EXPOSED: exposed, POSED: posed, VISUAL: visual}
    if fused is not None:
        given |= {FUSED_POSED: fused, FUSED: fused}
    states = {name: each if isinstance(each, Scores) else scores(each) for name, each in given.items()}
    with_cameras = poses((entropy(-3.0, -3.0),), accepted=fused is not None)
    found = SimpleNamespace(extrinsic_change=extrinsic)
    return states, poses(accepted=True), with_cameras, VisualStage(found), config


def choose(apart=None, **states):
    return evaluate_steps.choose(*judged(**states), apart)


def verdicts(**states):
    found = choose(**states)
    return found.cameras.accepted, found.exposures.accepted, found.state


def test_gains_are_accepted():
    assert verdicts() == (True, True, VISUAL)


def test_exposures_do_not_hide_what_cameras_lose():
    """Better than the input without exposures in every state that has them, and yet the poses only lose."""
    assert verdicts(exposed=BASE + 5, posed=BASE - 1, visual=BASE + 3) == (False, True, EXPOSED)


def test_cameras_are_not_dropped_with_exposures():
    assert verdicts(exposed=BASE - 3, posed=BASE + 2, visual=BASE + 1) == (True, False, POSED)


def test_exposures_are_judged_at_the_poses_in_use():
    """They gain at poses that are refused, and lose at the carried ones."""
    assert verdicts(exposed=BASE - 1, posed=BASE - 4, visual=BASE - 2) == (False, False, CARRIED)


def test_losses_are_refused():
    assert verdicts(exposed=BASE - 1, posed=BASE - 1, visual=BASE - 2) == (False, False, CARRIED)


def test_gain_within_chance_is_refused():
    assert verdicts(posed=BASE + CHANCE, visual=BASE + 1 + CHANCE) == (False, True, EXPOSED)
    assert CHANCE.mean() > 0


EDGES = np.array([0.01, 0.012, 0.009, 0.011, 0.008])
"""A gain of SSIM of 14 standard errors."""


@pytest.mark.parametrize(
    ("psnr", "ssim", "accepted"),
    [
        (CHANCE, EDGES, True),
        (CHANCE, 0.4 * EDGES, False),  # less than contradicts anything
        (CHANCE, 0.01 + 0.04 * CHANCE, False),  # 1.3 standard errors
        (CHANCE - 0.2, EDGES, False),  # PSNR falls, if within chance
        (CHANCE + 0.3, 0.01 + 0.02 * CHANCE, True),  # 2.6 standard errors, and PSNR by 1.6
        (CHANCE + 0.1, 0.01 + 0.02 * CHANCE, False),  # and PSNR by 0.6
    ],
)
def test_edges_far_more_alike_are_a_gain_where_noise_hides_it_from_psnr(psnr, ssim, accepted):
    posed = scores(BASE + psnr, ssim=0.5 + ssim)
    assert verdicts(posed=posed, visual=scores(BASE + 1 + psnr, ssim=0.5 + ssim))[0] is accepted
    covering_less = scores(BASE + psnr, BASE - 0.1, ssim=0.5 + ssim)
    assert not verdicts(posed=covering_less, visual=covering_less)[0]


@pytest.mark.parametrize(("own", "same", "accepted"), [(0.5, 0.3, True), (0.3, 0.5, True), (0.5, 0.1, False)])
def test_gains_beyond_chance_over_either_kind_of_pixels_and_likely_over_the_other_are_accepted(
    own, same, accepted
):
    """0.1, 0.3 and 0.5 are 0.6, 1.6 and 2.6 standard errors."""
    after = scores(BASE + CHANCE + own, BASE + CHANCE + same)
    assert verdicts(posed=after, visual=after)[0] is accepted


def test_gain_only_by_covering_less_is_refused():
    visual = scores(BASE + 2, BASE + 0.5)
    assert verdicts(posed=scores(BASE + 1, BASE - 0.5), visual=visual)[0] is False


def test_gain_by_psnr_that_ssim_contradicts_is_refused():
    worse = {"posed": scores(BASE + 1, ssim=0.4), "visual": scores(BASE + 2, ssim=0.4)}
    assert verdicts(**worse) == (False, True, EXPOSED)
    assert "worse by SSIM" in choose(**worse).cameras.reason


@pytest.mark.parametrize(
    ("sigmas", "certainty", "used"), [(2.9, 1.0, True), (4.9, 1.1, False), (11.0, 150.0, True)]
)
def test_an_extrinsic_that_left_its_calibration_on_nobodys_word_is_refused(sigmas, certainty, used):
    found = choose(extrinsic=ExtrinsicChange(sigmas, certainty))
    assert (found.cameras.accepted, found.state) == ((True, VISUAL) if used else (False, EXPOSED))
    assert ("left the scans" in found.cameras.reason) != used
    assert choose(
        extrinsic=ExtrinsicChange(sigmas, certainty), config=GateConfig(enabled=False)
    ).cameras.accepted


def test_fusion_is_judged_with_equal_cameras_and_exposures():
    assert choose(fused=BASE + 2).state == FUSED
    assert choose(fused=BASE + 1).state == VISUAL
    assert choose(fused=BASE + 2, exposed=BASE - 1, posed=BASE + 2, visual=BASE + 1).state == FUSED_POSED
    refused = choose(fused=BASE, exposed=BASE + 5, posed=BASE - 1, visual=BASE + 3).fusion
    assert not refused.accepted
    assert "cameras were not accepted" in refused.reason


NEAR, CERTAIN = Apart(5e-4, 0.01, 0.6), ExtrinsicChange(0.2, 8.0)
SAME = {"posed": BASE + CHANCE, "visual": BASE + 1 + CHANCE}
"""Cameras that gain nothing beyond chance."""


@pytest.mark.parametrize(
    ("more", "confirmed"),
    [
        ({}, True),
        ({"extrinsic": NO_CHANGE}, True),
        ({"apart": None}, False),
        ({"apart": Apart(5e-3, 0.1, 2.1)}, False),
        ({"extrinsic": ExtrinsicChange(0.2, 1.2)}, False),  # images know no more than the calibration
        ({"visual": BASE + 2}, False),  # used
        ({"posed": scores(BASE + CHANCE, BASE - 3), "visual": scores(BASE + 1 + CHANCE, BASE - 2)}, False),
        ({"posed": scores(BASE + CHANCE, ssim=0.4), "visual": scores(BASE + 1 + CHANCE, ssim=0.4)}, False),
        (dict.fromkeys(("posed", "visual"), scores(np.full(5, np.nan))), False),
    ],
)
def test_cameras_are_confirmed_by_refined_ones_that_agree_and_gain_nothing(more, confirmed):
    found = choose(**{"apart": NEAR, "extrinsic": CERTAIN, **SAME, **more}).cameras
    assert found.confirmed is confirmed
    assert ("images confirm them: refined ones are 0.50 mm and 0.010 degrees" in found.reason) is confirmed
    assert not (found.confirmed and found.accepted)


def test_scans_are_refined_with_cameras_that_confirm_those_in_use():
    known = {"apart": NEAR, "extrinsic": CERTAIN} | SAME
    with_exposures = choose(**known, fused=BASE + 1 + CHANCE)
    assert with_exposures.fusion.accepted
    assert with_exposures.state == FUSED_EXPOSED
    without = choose(**known | {"visual": BASE - 1 + CHANCE}, exposed=BASE - 1, fused=BASE + CHANCE)
    assert without.state == FUSED_CARRIED
    lost = choose(**known, fused=BASE - 1)
    assert (lost.fusion.accepted, lost.state) == (False, EXPOSED)
    assert "images would be predicted worse" in lost.fusion.reason
    assert choose(**known | {"apart": None}, fused=BASE + 1 + CHANCE).state == EXPOSED
    assert choose(**known).state == EXPOSED


@pytest.mark.parametrize(
    ("states", "clear"),
    [
        ({}, True),
        ({"fused": BASE + 2}, True),
        ({"visual": BASE + 1 + WEAK}, False),
        ({"carried": BASE + 0.5, "exposed": BASE + 1 + WEAK, "config": GateConfig(confidence=0)}, False),
        ({"posed": BASE + 2, "exposed": BASE + 2 - WEAK}, False),
        ({"fused": BASE + 1.85}, False),
        ({"visual": scores(BASE + 2, ssim=0.494)}, False),
        ({"visual": scores(np.full(5, np.nan))}, False),
        ({"posed": BASE + 2, "visual": BASE - 2, "config": GateConfig(enabled=False)}, True),
    ],
)
def test_more_images_are_asked_unless_every_part_gains_far_beyond_chance(states, clear):
    assert evaluate_steps.is_clear(*judged(**states)) is clear


def test_nothing_to_judge_by():
    nothing = scores(np.full(5, np.nan))
    none = dict.fromkeys(("carried", "exposed", "posed", "visual"), nothing)
    assert verdicts(**none) == (False, False, CARRIED)
    single = {name: scores([20.0 + k]) for k, name in enumerate(none)}
    assert verdicts(**single) == (False, False, CARRIED)


def test_without_an_image_that_can_be_judged_the_input_is_kept():
    """Before, the gate ended in a KeyError."""
    found = evaluate_steps.choose({}, *judged(fused=BASE + 2)[1:])
    assert (found.state, found.cameras.accepted, found.exposures.accepted) == (CARRIED, False, False)
    assert "no image can be judged" in found.cameras.reason
    assert not found.fusion.accepted
    unjudged = evaluate_steps.choose({}, *judged(fused=BASE + 2, config=GateConfig(enabled=False))[1:])
    assert (unjudged.state, unjudged.cameras.accepted) == (FUSED, True)


def test_switched_off_everything_is_accepted():
    config = GateConfig(enabled=False)
    found = choose(exposed=BASE - 1, posed=BASE - 1, visual=BASE - 2, fused=BASE - 5, config=config)
    assert found.state == FUSED
    assert scan_gate.judge_scans(entropy(-3.0, -2.0), (), config).accepted


def test_every_verdict_tells_its_figures():
    (psnr, *_) = choose().cameras.figures
    assert (psnr.name, psnr.finding) == ("psnr_leave_one_out", "better")
    assert (psnr.before, psnr.after, psnr.gain) == pytest.approx((23.4, 24.4, 1.0))
    assert isinstance(choose(fused=BASE + 2).fusion.figures[0], Figure)


def test_standard_error_counts_neighbors_that_are_alike_once():
    """Runs of five equal values tell as much as one of each; independent ones as much as they are."""
    rng = np.random.default_rng(1)
    independent = rng.normal(size=400)
    assert acceptance.standard_error(independent) == pytest.approx(1 / 20, rel=0.2)
    alike = np.repeat(rng.normal(size=80), 5)
    naive = alike.std(ddof=1) / np.sqrt(len(alike))
    assert acceptance.standard_error(alike) > 1.6 * naive


@pytest.mark.parametrize("name", ["min_entropy_gain", "confidence"])
def test_ranges(name):
    with pytest.raises(ValueError, match=name):
        GateConfig(**{name: -1.0})
