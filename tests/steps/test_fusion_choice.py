"""Whether scans follow the cameras in all, or along what planes leave open alone: the map's sharpness says."""

from dataclasses import replace

import numpy as np
import pytest

from lvba.products.map_quality import EntropyBlocks
from lvba.steps import scan_acceptance
from lvba.steps.acceptance import GateConfig, Verdict
from lvba.steps.outcomes import FusionStage, ScanPoses
from lvba.steps.pose_fusion import Fused
from lvba.steps.scan_acceptance import FusedEntropy

BLOCKS = 20
BEFORE = np.tile(np.eye(4), (3, 1, 1))


def moved(by, only_slid=False, slid=None):
    poses = BEFORE.copy()
    poses[:, 0, 3] += by
    return Fused(
        world_from_scan=poses, covariance=np.zeros((3, 6, 6)), moved_m=np.full(3, by), interpolation_error_scale=0.1,
        variance_factor=1.0, contradicted=0, only_slid=only_slid, slid=slid,
    )  # fmt: skip


SLID = moved(0.1, only_slid=True)
WHOLE = moved(0.2, slid=SLID)


def blocks(entropy):
    """Of a map whose blocks differ by chance, alike in all maps."""
    values = entropy + 0.3 * np.random.default_rng(0).normal(size=BLOCKS)
    return EntropyBlocks(np.arange(BLOCKS), np.stack([100 * values, np.full(BLOCKS, 100.0)], axis=1))


def in_use(fused, whole, slid, config=None, drawn=None, rough=-3.0):
    """What is chosen, and the poses in use, by the entropies of the two maps; -4 before.

    drawn: of the map at poses as likely as those before; rough: at the input's
    """
    config, own = config or GateConfig(), blocks(-4.0)
    scans = ScanPoses(BEFORE, Verdict(True, "accepted"), rough, own.mean, own)
    maps = [None if each is None else blocks(each) for each in (slid, drawn)]
    entropies = [FusedEntropy(blocks(whole), *maps), None]
    chosen = scan_acceptance.choose_fusion(scans, FusionStage(fused), entropies, config)
    return chosen.result, scan_acceptance.judge_fusion(scans, chosen, entropies, config)


@pytest.mark.parametrize(
    ("whole", "slid", "chosen", "accepted"),
    [
        (-4.1, -4.2, WHOLE, True),  # as sharp with all that the cameras say
        (-3.7, -4.0, SLID, True),
        (-3.7, -3.6, SLID, False),
    ],
)
def test_what_blurs_the_map_is_not_followed_and_slides_that_do_not_are(whole, slid, chosen, accepted):
    result, scans = in_use(WHOLE, whole, slid)
    assert result is chosen
    assert scans.verdict.accepted == accepted
    expected = chosen.world_from_scan if accepted else BEFORE
    np.testing.assert_array_equal(scans.world_from_scan, expected)


@pytest.mark.parametrize(
    ("whole", "drawn", "accepted"),
    [
        (-3.99, -3.985, True),  # sharper than at poses as likely
        (-3.99, -3.99, True),
        (-3.99, -3.995, False),  # less sharp, beyond chance
        (-3.99, None, False),
        (-3.97, -3.95, False),  # more than means little
    ],
)
def test_where_the_input_was_as_good_the_map_may_be_as_sharp_as_at_poses_as_likely(whole, drawn, accepted):
    assert (
        in_use(replace(WHOLE, slid=None), whole, None, drawn=drawn, rough=-3.99)[1].verdict.accepted
        == accepted
    )


def test_the_verdict_on_fused_scans_has_the_figure_that_it_depends_on():
    _, scans = in_use(replace(WHOLE, slid=None), -3.99, None, drawn=-3.985, rough=-3.99)
    assert [each.name for each in scans.verdict.figures] == ["map_entropy", "map_entropy_drawn"]
    assert [each.gain for each in scans.verdict.figures] == pytest.approx([-0.01, 0.005], abs=1e-6)


def test_where_nothing_is_open_there_is_no_choice():
    result, scans = in_use(replace(WHOLE, slid=None), -3.7, None)
    assert result.slid is None
    assert not scans.verdict.accepted
    nothing = FusionStage(None, "too few cameras")
    assert scan_acceptance.choose_fusion(scans, nothing, [None], GateConfig()) is nothing


def test_unjudged_the_cameras_are_followed_in_all():
    assert in_use(WHOLE, -3.0, -4.0, GateConfig(enabled=False))[0] is WHOLE
