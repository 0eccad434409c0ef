"""The camera is used as images correct it, unless images are predicted better by it as calibrated."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from image_scores import scores_of

from lvba import geometry, pipeline, plan, simulate
from lvba.io.dataset import open_dataset
from lvba.pipeline import Config
from lvba.products import evaluate
from lvba.simulate.disturbances import Disturbances
from lvba.steps import camera_choice
from lvba.steps.acceptance import GateConfig
from lvba.steps.camera_choice import CALIBRATED, CORRECTED
from lvba.visual.fixed_calibration import CORRECTIONS


@dataclass(frozen=True)
class Result:
    """As much of a visual result as is looked at."""

    name: str
    warnings: tuple[str, ...] = ("what was said before",)


@dataclass(frozen=True)
class Stage:
    result: Result


def stage(name):
    return Stage(Result(name))


def scores(psnr, ssim, count=12, seed=0):
    rng = np.random.default_rng(seed)
    per_image = {
        name: (psnr if "psnr" in name else ssim)
        + (0.05 if "psnr" in name else 0.002) * rng.normal(size=count)
        for name in evaluate._FIGURES
    }
    return scores_of(per_image)


@pytest.mark.parametrize(
    ("psnr", "ssim", "kept"),
    [(1.0, 0.02, True), (0.0, 0.0, True), (-0.7, -0.01, False), (-0.7, 0.0, False), (-0.7, 0.04, True)],
)
def test_a_corrected_camera_that_predicts_images_worse_is_not_used(psnr, ssim, kept):
    corrected, calibrated = (stage(name) for name in ("corrected", "calibrated"))
    compared = [{CALIBRATED: scores(20.0, 0.5), CORRECTED: scores(20.0 + psnr, 0.5 + ssim, seed=1)}]
    chosen = camera_choice.choose(corrected, calibrated, compared, GateConfig())
    assert chosen.result.name == ("corrected" if kept else "calibrated")
    assert len(chosen.result.warnings) == (1 if kept else 2)
    accepting = camera_choice.choose(corrected, calibrated, compared, GateConfig(enabled=False))
    assert accepting is corrected


def test_parts_decide_together():
    """One that tells nothing follows the others, and one whose camera was not corrected stays."""
    compared = [{}, {CALIBRATED: scores(20.0, 0.5), CORRECTED: scores(19.0, 0.5, seed=1)}]
    corrected = stage("corrected")
    assert (
        camera_choice.choose(corrected, stage("calibrated"), compared, GateConfig()).result.name
        == "calibrated"
    )
    assert camera_choice.choose(corrected, None, compared, GateConfig()) is corrected
    assert camera_choice.choose(corrected, stage("calibrated"), [{}], GateConfig()) is corrected


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Artifacts by the name of their steps, of a courtyard whose calibration has a wrong focal length and of one that is
    right."""
    made = []
    for name, wrong in (("wrong", 0.01), ("right", 0.0)):
        folder = tmp_path_factory.mktemp("camera") / name
        simulate.simulate(
            "courtyard", folder, frames=16, scans=16, seed=4, width=320, height=240, points_per_scan=8000,
            disturb=Disturbances(focal=wrong),
        )  # fmt: skip
        work = pipeline.refine(open_dataset(folder), Config())
        store = plan.run(until(work, "visual-choice"), {})
        made.append({step.name: store[step.key] for step in work.steps.values() if step.key in store})
    return made


def until(work, name):
    """A plan with the steps up to one."""
    names = [step.name for step in work.steps.values()]
    kept = dict(list(work.steps.items())[: names.index(name) + 1])
    return replace(work, steps=kept)


def test_a_correction_that_is_right_predicts_images_better(runs):
    wrong, _ = runs
    corrected, calibrated = wrong["visual"].result, wrong["visual-as-calibrated"].result
    assert corrected.calibration.focal[0] == pytest.approx(-0.01, rel=0.1)
    for name in CORRECTIONS:
        assert np.array_equal(getattr(calibrated.calibration, name), 0 * getattr(corrected.calibration, name))
    found = wrong["visual-compared"]
    assert found[CORRECTED].psnr_leave_one_out > found[CALIBRATED].psnr_leave_one_out
    assert wrong["visual-choice"].result.calibration.focal[0] == corrected.calibration.focal[0]


def test_what_images_want_of_a_camera_that_is_held_counts_as_an_error(runs):
    wrong, _ = runs
    corrected, calibrated = (
        np.sqrt(wrong[name].result.covariance[:, 3:, 3:].trace(axis1=1, axis2=2).mean())
        for name in ("visual", "visual-as-calibrated")
    )
    assert calibrated > 2 * corrected


def test_a_right_camera_is_solved_for_once(runs):
    _, right = runs
    assert right["visual-as-calibrated"] is None
    assert right["visual-compared"] == {}
    assert set(right["visual"].tuning.fixed) == set(CORRECTIONS)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Artifacts of a courtyard whose images are read row by row."""
    folder = tmp_path_factory.mktemp("rows") / "courtyard"
    simulate.simulate(
        "courtyard", folder, frames=16, scans=16, seed=4, width=320, height=240, points_per_scan=8000,
        disturb=Disturbances(rolling_shutter=0.03),
    )  # fmt: skip
    work = pipeline.refine(open_dataset(folder), Config())
    store = plan.run(until(work, "visual-gate"), {})
    return {step.name: store[step.key] for step in work.steps.values() if step.key in store}


def test_images_that_were_read_row_by_row_are_seen_as_if_at_once(rows):
    """Turns are those of the path while the rows are read; without them, right cameras predict images worse."""
    result, found = rows["visual-choice"].result, rows["visual-compared"]
    assert result.calibration.readout == pytest.approx(0.03, abs=0.002)
    steps = geometry.log(geometry.inverse(result.world_from_camera[:-1]) @ result.world_from_camera[1:])
    mean = 0.5 * (result.turns[:-1] + result.turns[1:])
    size = np.linalg.norm(mean, axis=1)
    # from image to image the path turns 30 to 40 times as far
    ratio = np.sum(mean * steps[:, :3]) / np.sum(mean**2)
    assert np.linalg.norm(steps[:, :3] - ratio * mean, axis=1).max() < 0.6 * ratio * size.max()
    assert found[CORRECTED].psnr_leave_one_out > found[CALIBRATED].psnr_leave_one_out
    accepted = rows["visual-gate"]
    np.testing.assert_array_equal(accepted.turns, result.turns)
