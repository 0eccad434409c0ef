"""The whole visual stage in a small room: images, scans and rough trajectories in, refined cameras out."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room
from textured_room import CAMERA, COUNT

from lvba import geometry, trajectory
from lvba.errors import DegenerateProblemError
from lvba.lidar.covariance import Covariance
from lvba.visual import calibration_prior, image, refine, visibility
from lvba.visual.scene_points import Observations
from lvba.visual.variant import Variant


@pytest.fixture(scope="module")
def room():
    return textured_room.make()


@pytest.fixture(scope="module")
def refined(room):
    return refine.refine(refine.Inputs(**room[0]))


def error(poses: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    found = trajectory.pose_error(poses, truth, aligned=np.eye(4))
    return 1e3 * found.ate_m, found.rotation_deg


def test_cameras_and_exposures_end_at_the_truth(room, refined):
    problem, truth, log_exposure = room
    before = error(problem["images"].world_from_sensor, truth)
    after = error(refined.world_from_camera, truth)
    assert after[0] < 2.0 < 8.0 < before[0]
    assert after[1] < 0.03 < 0.2 < before[1]
    assert refined.log_exposure == pytest.approx(log_exposure, abs=0.01)
    assert refined.converged
    assert refined.cost_final < 0.5 * refined.cost_initial


def test_the_reported_covariance_covers_the_error(room, refined):
    wrong = geometry.log(geometry.inverse(refined.world_from_camera) @ room[1])
    nees = np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(refined.covariance), wrong) / 6
    # one small scene: 12 images of six planes. Its scans are exact, which the prior never takes them for (1 mm, 0.01
    # degrees), so four times the error may be promised
    assert 0.06 < nees.mean() < 6


def test_the_account_of_the_levels_goes_from_coarse_to_fine(refined):
    assert [level.level for level in refined.levels] == [1, 0]
    for level in refined.levels:
        assert level.local_pairs > 100
        assert len(level.iterations) > 0
        assert 1.0 < level.sigma < 4.0
    assert refined.degenerate.shape == (COUNT,)
    assert len(refined.degenerate_common) == 0
    assert abs(refined.calibration.time_offset) < 0.005
    assert refined.calibration.clock_rate == 0.0


def test_images_that_see_the_same_are_of_one_group(refined):
    assert refined.group.shape == (COUNT,)
    assert len(set(refined.group)) == 1


def test_the_same_input_gives_the_same_bytes(room, refined):
    again = refine.refine(refine.Inputs(**room[0]))
    assert again.world_from_camera.tobytes() == refined.world_from_camera.tobytes()
    assert again.log_exposure.tobytes() == refined.log_exposure.tobytes()


def test_images_between_keyframes_are_carried_along(room):
    problem, truth, _ = room
    chosen = np.arange(0, COUNT, 2)
    pyramid = problem["pyramid"]
    thinned = replace(pyramid, levels=tuple(np.ascontiguousarray(level[chosen]) for level in pyramid.levels))
    found = refine.refine(refine.Inputs(**(problem | {"pyramid": thinned, "keyframes": chosen})))
    between = np.setdiff1d(np.arange(COUNT), chosen)
    assert error(found.world_from_camera[between], truth[between])[0] < 3.0
    assert error(problem["images"].world_from_sensor[between], truth[between])[0] > 7.0
    assert len(found.covariance) == len(found.degenerate) == COUNT


@pytest.mark.parametrize(
    "options",
    [
        {"prior": False},
        {"exposures": "joint"},
        {"global_points": False},
        {"score": "as printed"},
    ],
    ids=["no prior", "joint exposures", "no global points", "score as printed"],
)
def test_variants_still_improve(room, options):
    problem, truth, _ = room
    found = refine.refine(refine.Inputs(**problem), variant=Variant(**options))
    assert (
        error(found.world_from_camera, truth)[0] < 0.7 * error(problem["images"].world_from_sensor, truth)[0]
    )


def test_without_exposures_all_images_count_as_equally_exposed(room):
    found = refine.refine(refine.Inputs(**room[0]), variant=Variant(exposures="none"))
    assert (found.log_exposure == 0).all()


def test_images_that_show_nothing_are_an_error_that_says_so(room):
    blank = np.full_like(room[0]["pyramid"].levels[0], 128)
    with pytest.raises(DegenerateProblemError, match="scene point"):
        refine.refine(refine.Inputs(**(room[0] | {"pyramid": image.build_pyramid(blank, CAMERA, 2)})))


def test_a_level_at_which_nothing_is_seen_twice_is_passed_over(room, monkeypatch):
    find = visibility.find

    def near_sighted(level, *others, **more):
        points, observations = find(level, *others, **more)
        if level.camera.width < CAMERA.width:
            observations = Observations(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, bool))
        return points, observations

    monkeypatch.setattr(visibility, "find", near_sighted)
    found = refine.refine(refine.Inputs(**room[0]))
    assert [level.level for level in found.levels] == [0]
    assert error(found.world_from_camera, room[1])[0] < 3.0


def torn(problem: dict, levels: int) -> refine.Inputs:
    """The second half of scans and images shifted by 39 cm, and a covariance that knows: each scan is well held by its
    neighbors, the second half as a whole is not."""
    off = np.eye(4)
    off[:3, 3] = [0.2, 0.3, 0.15]
    scans, images = problem["refined_scans"].copy(), problem["images"].world_from_sensor.copy()
    scans[COUNT:] = off @ scans[COUNT:]
    images[COUNT // 2 :] = off @ images[COUNT // 2 :]
    well = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
    marginal = np.repeat([well, np.diag([1e-4] * 3 + [0.08] * 3) ** 2], COUNT, axis=0)
    known = Covariance(marginal, np.repeat(well[None], 2 * COUNT, axis=0), marginal)
    pyramid = problem["pyramid"]
    return refine.Inputs(
        **(problem | {
            "pyramid": image.build_pyramid(pyramid.levels[0], CAMERA, levels),
            "images": replace(problem["images"], world_from_sensor=images),
            "scans": replace(problem["scans"], world_from_sensor=scans),
            "refined_scans": scans,
        }),
        scan_covariance=known,
    )  # fmt: skip


def test_coarse_images_tie_a_group_that_came_off(room):
    problem, truth, _ = room
    few, enough = (refine.refine(torn(problem, levels)).world_from_camera for levels in (1, 2))
    assert error(few, truth)[0] > 30.0
    assert error(enough, truth)[0] < 3.0


def mounted_wrong(problem: dict, degrees: float) -> refine.Inputs:
    """Rough cameras and the calibrated extrinsic turned by so many degrees, alike."""
    turn = geometry.exp(np.radians([0.6 * degrees, 0.8 * degrees, 0, 0, 0, 0]))
    images = replace(problem["images"], world_from_sensor=problem["images"].world_from_sensor @ turn)
    extrinsic = geometry.inverse(turn) @ problem["camera_from_scan"]
    pyramid = image.build_pyramid(problem["pyramid"].levels[0], CAMERA, 3)
    return refine.Inputs(**(problem | {"images": images, "camera_from_scan": extrinsic, "pyramid": pyramid}))


def test_cameras_begin_anew_where_the_extrinsic_is_found_far_off(room, caplog):
    problem, truth, _ = room
    with caplog.at_level("INFO", "lvba.visual.refine"):
        found = refine.refine(mounted_wrong(problem, 4.0))
    assert "cameras begin anew" in caplog.text
    assert error(found.world_from_camera, truth)[0] < 3.0
    caplog.clear()
    with caplog.at_level("INFO", "lvba.visual.refine"):
        refine.refine(refine.Inputs(**problem))
    assert "cameras begin anew" not in caplog.text


def test_all_levels_are_solved_anew_where_the_calibration_proves_to_claim_too_much(room, caplog, monkeypatch):
    """As images say it, whatever they are: that they do is tested beside `granted`."""
    problem, truth, _ = room
    with caplog.at_level("INFO", "lvba.visual.refine"):
        refine.refine(refine.Inputs(**problem))
        assert "all levels anew" not in caplog.text
        monkeypatch.setattr(calibration_prior, "granted", lambda said, spread, claims: claims / 16)
        found = refine.refine(mounted_wrong(problem, 4.0))
    assert caplog.text.count("all levels anew") == 1
    assert [level.level for level in found.levels] == [2, 1, 0]
    assert error(found.world_from_camera, truth)[0] < 3.0


@pytest.mark.parametrize("wrong", [{"patch": 8}, {"levels": 7}])
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        refine.VisualConfig(**wrong)
