"""What images say of scans depends on how the camera is calibrated: by how much is an error of it."""

from dataclasses import replace

import numpy as np
import pytest
from image_scores import scores_of
from needed_steps import needed
from scipy.spatial.transform import Rotation

from lvba import geometry, pipeline, plan
from lvba.camera import Camera
from lvba.io.dataset import open_dataset
from lvba.products import evaluate
from lvba.products.map_quality import EntropyChange
from lvba.products.views import Views
from lvba.steps import acceptance, other_calibrations, part_scores, scan_gate
from lvba.steps.acceptance import CARRIED, ROUGH, GateConfig
from lvba.visual.prior_config import PriorConfig

CONFIG = GateConfig()
PER_IMAGE = evaluate._FIGURES


def scores(gain, count=20, seed=0):
    psnr = 20.0 + gain + 0.2 * np.random.default_rng(seed).normal(size=count)
    per_image = {name: psnr if "psnr" in name else 0.5 + 0 * psnr for name in PER_IMAGE}
    return scores_of(per_image)


def asked(gain, others=()):
    """Scores of both states, and with other calibrations; gains by these."""
    known = {ROUGH: scores(0.0), CARRIED: scores(gain, seed=1)}
    for number, other in enumerate(others):
        known[other_calibrations.name(ROUGH, number)] = scores(0.0)
        known[other_calibrations.name(CARRIED, number)] = scores(other, seed=1)
    return known


def judged(gain, others=()):
    known = asked(gain, others)
    images = acceptance.image_figures(known[ROUGH], known[CARRIED], CONFIG)
    images = other_calibrations.counted(images, known, (ROUGH, CARRIED), CONFIG)
    entropy = acceptance.entropy_figure(EntropyChange(-3.0, -4.5, 1.5, 0.02), CONFIG)
    return scan_gate.judge_scans(entropy, images, CONFIG), images


def test_images_that_say_otherwise_with_other_calibrations_do_not_contradict_scans():
    assert not judged(-0.6)[0].accepted
    verdict, images = judged(-0.6, (0.2, -0.9, -0.3, -0.1))
    assert verdict.accepted
    assert images[0].calibration == pytest.approx(np.sqrt(np.mean(np.square([0.8, 0.3, 0.3, 0.5]))))
    assert images[0].error == pytest.approx(np.hypot(judged(-0.6)[1][0].error, images[0].calibration))


def test_images_that_say_the_same_with_all_calibrations_contradict_them():
    verdict, images = judged(-0.6, (-0.55, -0.65, -0.6, -0.7))
    assert not verdict.accepted
    assert 0.04 < images[0].calibration < 0.08


def test_fewer_images_with_other_calibrations_are_compared_with_themselves():
    known = asked(-0.6, (-0.6,))
    few = np.arange(0, 20, 4, dtype=np.int32)
    for state in (ROUGH, CARRIED):
        name = other_calibrations.name(state, 0)
        rows = {figure: values[few] for figure, values in known[name].per_image.items()}
        known[name] = replace(known[name], images=few, per_image=rows)
    images = acceptance.image_figures(known[ROUGH], known[CARRIED], CONFIG)
    counted = other_calibrations.counted(images, known, (ROUGH, CARRIED), CONFIG)
    assert counted[0].calibration == pytest.approx(0.0, abs=1e-12)


def test_parts_that_did_not_ask_say_nothing_of_other_calibrations():
    """One of two parts asked: the whole is judged by its images, too."""
    first, second = asked(-0.6, (0.2, -0.9, -0.3, -0.1)), asked(-0.6)
    second = {name: replace(each, images=each.images + 20) for name, each in second.items()}
    for order in ((first, second), (second, first)):
        known = part_scores.together(order, {})
        assert len(known[CARRIED].images) == 40
        images = acceptance.image_figures(known[ROUGH], known[CARRIED], CONFIG)
        images = other_calibrations.counted(images, known, (ROUGH, CARRIED), CONFIG)
        assert images[0].calibration == pytest.approx(judged(-0.6, (0.2, -0.9, -0.3, -0.1))[1][0].calibration)


@pytest.mark.parametrize("contradicted", [True, False])
def test_a_run_asks_where_images_contradict(tiny_recording, monkeypatch, contradicted):
    monkeypatch.setattr(acceptance, "contradicted", lambda images: contradicted)
    work = pipeline.refine(open_dataset(tiny_recording), pipeline.Config(refine_cameras=False))
    store = plan.run(needed(work, "lidar-gate"), {})
    [gate] = [store[key] for key, step in work.steps.items() if step.name == "lidar-gate"]
    calibration = {each.name: each.calibration for each in gate.verdict.figures}
    assert calibration["map_entropy"] == 0.0
    assert (calibration["psnr_leave_one_out"] > 0.0) == contradicted


def test_cameras_go_where_the_other_calibrations_have_them():
    """Along their path by the clock, and about it by the extrinsic, by a standard deviation of each."""
    times = np.arange(10) * 0.1
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = 3.0 * times
    views = Views(
        load=lambda _: np.zeros((4, 4, 3), np.uint8),
        camera=Camera(4, 4, 2.0, 2.0, 2.0, 2.0, (0.0,) * 4),
        times=times,
        world_from_camera=poses,
        log_exposure=np.zeros(10),
    )
    prior = PriorConfig(extrinsic_position_m=0.02, extrinsic_rotation_deg=0.5, time_offset_s=0.03)
    off = []
    for number in range(other_calibrations.COUNT):
        moved = other_calibrations.views(views, number, prior)
        step = geometry.log(geometry.inverse(poses[3:6]) @ moved.world_from_camera[3:6])
        np.testing.assert_allclose(step, np.tile(step[:1], (3, 1)), atol=1e-9)
        off.append(step[0])
    off = np.array(off)
    np.testing.assert_allclose(np.abs(off[:, :3]), np.radians(0.5), rtol=1e-6)
    assert set(np.round(np.abs(off[:, 3]), 3)) <= {0.07, 0.11}, "3 m/s for 0.03 s, and 0.02 m"
    angle = Rotation.from_rotvec(off[:, :3]).magnitude()
    np.testing.assert_allclose(angle, np.sqrt(3) * np.radians(0.5), rtol=1e-6)
    signs = other_calibrations._SIGNS
    assert set(np.abs(signs).ravel()) == {1}
    np.testing.assert_array_equal(signs @ signs.T - 7 * np.eye(4), -np.ones((4, 4)) + np.eye(4))
