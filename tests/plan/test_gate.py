"""The gate accepts gains and refuses losses, chance, and what cannot be judged."""

from dataclasses import fields

import numpy as np
import pytest

from lvba import gate
from lvba.gate import CARRIED, EXPOSED, VISUAL, GateConfig
from lvba.products.evaluate import Scores


def _mean(values):
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan


def scores(psnr, common=None):
    psnr = np.asarray(psnr, float)
    common = psnr if common is None else np.asarray(common, float)
    given = {
        "psnr_leave_one_out": _mean(psnr),
        "psnr_common": _mean(common),
        "images": np.arange(len(psnr)),
        "per_image": {"psnr_leave_one_out": psnr, "psnr_common": common},
    }
    return Scores(**{f.name: given.get(f.name, 0.0) for f in fields(Scores)})


BASE = np.array([20.0, 22.0, 24.0, 21.0, 25.0])


@pytest.mark.parametrize(
    ("before", "after", "accepted", "word"),
    [
        (-3.0, -3.1, True, "accepted"),
        (-3.0, -3.0, False, "not crisper"),
        (-3.0, -3.0005, False, "not crisper"),
        (-3.0, -2.9, False, "not crisper"),
        (np.nan, -3.0, False, "too thin"),
        (-3.0, np.nan, False, "too thin"),
    ],
)
def test_scans(before, after, accepted, word):
    verdict = gate.judge_scans(before, after, GateConfig())
    assert verdict.accepted is accepted
    assert word in verdict.reason


@pytest.mark.parametrize(
    ("before", "after", "accepted", "word"),
    [
        (-3.0, -3.1, True, "accepted"),
        (-3.0, -3.0, True, "accepted"),
        (-3.0, -2.981, True, "accepted"),
        (-3.0, -2.979, False, "less crisp"),
        (-2.6, -2.5995, True, "accepted"),
        (-2.6, -2.598, False, "less crisp"),
        (np.nan, -3.0, False, "less crisp"),
        (-3.0, np.nan, False, "less crisp"),
    ],
)
def test_scans_that_cameras_moved(before, after, accepted, word):
    """A twentieth of what refining gained (from -2.6) may be lost, or what says nothing."""
    verdict = gate.judge_fusion(-2.6, before, after, GateConfig())
    assert verdict.accepted is accepted
    assert word in verdict.reason
    assert gate.judge_fusion(-2.6, before, after, GateConfig(enabled=False)).accepted


def judge(carried, exposed, visual, config=GateConfig()):  # noqa: B008
    poses, exposures = gate.judge_cameras({CARRIED: carried, EXPOSED: exposed, VISUAL: visual}, config)
    return poses.accepted, exposures.accepted


def test_gain_is_accepted():
    assert judge(scores(BASE), scores(BASE + 1), scores(BASE + 2)) == (True, True)


def test_poses_are_judged_apart_from_exposures():
    assert judge(scores(BASE), scores(BASE + 3), scores(BASE + 2)) == (False, True)


def test_loss_is_refused():
    assert judge(scores(BASE), scores(BASE - 1), scores(BASE - 1)) == (False, False)


def test_gain_within_chance_is_refused():
    chance = np.array([0.5, -0.4, 0.3, -0.5, 0.2])
    assert judge(scores(BASE), scores(BASE + 1), scores(BASE + 1 + chance)) == (False, True)
    assert chance.mean() > 0


def test_gain_only_by_covering_less_is_refused():
    assert judge(scores(BASE), scores(BASE + 1), scores(BASE + 2, BASE + 0.5)) == (False, True)


def test_poses_fall_with_the_exposures_they_were_judged_with():
    assert judge(scores(BASE), scores(BASE - 3), scores(BASE - 1)) == (False, False)


def test_nothing_to_judge_by():
    nothing = scores(np.full(5, np.nan))
    assert judge(nothing, nothing, nothing) == (False, False)
    assert judge(scores([20.0]), scores([21.0]), scores([22.0])) == (False, False)


def test_switched_off_everything_is_accepted():
    config = GateConfig(enabled=False)
    assert judge(scores(BASE), scores(BASE - 1), scores(BASE - 2), config) == (True, True)
    assert gate.judge_scans(-3.0, -2.0, config).accepted
    assert gate.judge_all(scores(BASE), scores(BASE - 5), config).accepted


def test_images_may_contradict_a_crisper_map():
    chance = np.array([0.5, -0.4, 0.3, -0.5, 0.0])
    assert gate.judge_all(scores(BASE), scores(BASE + 1), GateConfig()).reason == ""
    assert not gate.judge_all(scores(BASE), scores(BASE - 1 + chance), GateConfig()).accepted
    within = gate.judge_all(scores(BASE), scores(BASE + chance), GateConfig())
    assert within.accepted
    assert "within chance" in within.reason


@pytest.mark.parametrize("name", ["min_entropy_gain", "confidence", "contradiction"])
def test_ranges(name):
    with pytest.raises(ValueError, match=name):
        GateConfig(**{name: -1.0})
