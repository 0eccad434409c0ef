"""Errors against a reference: alignment, matching by time, the scale of exposures."""

import numpy as np
import pytest

from lvba import geometry
from lvba.io.exposures import Exposures
from lvba.io.reference import Reference
from lvba.products import reference
from lvba.steps import uncertainty
from lvba.trajectory import Trajectory

RNG = np.random.default_rng(0)
TIMES = np.arange(20.0)
SCANS = geometry.exp(np.cumsum(RNG.normal(0, 0.3, (20, 6)), axis=0))
CAMERAS = SCANS @ geometry.exp(np.array([0.1, 1.5, 0.2, 0.1, 0.0, -0.1]))
SHIFT = geometry.exp(np.array([0.5, -1.0, 2.0, 10.0, 20.0, -3.0]))


def truth(scans=SCANS, cameras=CAMERAS, exposures=None):
    return Reference(Trajectory(TIMES, SHIFT @ scans), Trajectory(TIMES + 0.5, SHIFT @ cameras), exposures)


def test_another_world_frame_is_no_error():
    facts = reference.compare(truth(), Trajectory(TIMES, SCANS), Trajectory(TIMES + 0.5, CAMERAS))
    for part in ("lidar", "camera", "camera_aligned"):
        assert facts[part]["ate_m"] < 1e-9
        assert facts[part]["rotation_deg"] < 1e-6
        assert facts[part]["frames"] == 20
    assert "exposure" not in facts


def test_what_the_alignment_was_found_from_is_said():
    """A path of meters by its positions, one of decimeters also by its orientations."""
    for size, by in ((10.0, "positions"), (0.1, "positions and orientations")):
        scans, cameras = SCANS.copy(), CAMERAS.copy()
        for poses in (scans, cameras):
            poses[:, :3, 3] *= size
        given = truth(scans, cameras)
        facts = reference.compare(given, Trajectory(TIMES, scans), Trajectory(TIMES + 0.5, cameras))
        assert facts["lidar"]["aligned_by"] == by
        assert facts["camera"]["aligned_by"] == f"scans, {by}"
        assert facts["camera_aligned"]["aligned_by"] == by


def test_a_reference_whose_positions_drift_says_nothing_of_orientations():
    """Positions that a receiver has turned by a degree turn all poses; their orientations are as far off as they are."""
    scans = SCANS.copy()
    scans[:, :3, 3] *= 10.0
    drifted, turn = scans.copy(), geometry.exp(np.array([0.0, 0.0, np.radians(1.0), 0, 0, 0]))
    drifted[:, :3, 3] = drifted[:, :3, 3] @ turn[:3, :3].T
    jitter = np.radians(0.1) * np.resize([1.0, -1.0], (20, 1)) * [[1.0, 0, 0, 0, 0, 0]]
    found = Trajectory(TIMES, geometry.retract(scans, jitter))
    error = reference.compare(truth(drifted), found, Trajectory(TIMES + 0.5, CAMERAS))["lidar"]
    assert error["aligned_by"] == "positions"
    assert error["rotation_deg"] == pytest.approx(1.0, abs=0.02)
    assert error["rotation_alone_deg"] == pytest.approx(0.1, rel=0.02)
    assert error["ate_m"] < 1e-6


def test_cameras_are_judged_in_the_frame_of_the_scans():
    moved = CAMERAS.copy()
    moved[:, :3, 3] += [0.05, 0, 0]
    facts = reference.compare(truth(), Trajectory(TIMES, SCANS), Trajectory(TIMES + 0.5, moved))
    assert facts["lidar"]["ate_m"] < 1e-9
    assert facts["camera"]["ate_m"] == pytest.approx(0.05)
    assert facts["camera_aligned"]["ate_m"] < 1e-9


def test_few_frames_that_are_far_off_show_in_the_root_mean_square_not_in_the_median():
    moved, angle = CAMERAS.copy(), np.radians(2.0)
    moved[3] = moved[3] @ geometry.exp(np.array([angle, 0, 0, 0, 0.2, 0]))
    error = reference.compare(truth(), Trajectory(TIMES, SCANS), Trajectory(TIMES + 0.5, moved))["camera"]
    assert error["ate_median_m"] < 1e-9
    assert error["rotation_median_deg"] < 1e-5
    # the nineteenth of twenty and the one that is off, a twentieth of the way to it
    assert error["ate_p95_m"] == pytest.approx(0.05 * error["ate_max_m"])
    assert error["rotation_p95_deg"] == pytest.approx(0.05 * 2.0, abs=1e-4)
    assert error["ate_m"] == pytest.approx(error["ate_max_m"] / np.sqrt(20))


def test_frames_are_matched_by_time_and_others_are_left_out():
    kept = np.array([0, 3, 4, 7, 12, 19])
    scans = Trajectory(TIMES[kept] + 4e-4, SCANS[kept])
    strangers = Trajectory(TIMES + 0.25, CAMERAS)
    facts = reference.compare(truth(), scans, strangers)
    assert facts["lidar"]["frames"] == 6
    assert facts["lidar"]["ate_m"] < 1e-9
    assert "camera" not in facts


def test_without_scans_cameras_are_aligned_on_their_own():
    only = Reference(None, Trajectory(TIMES, SHIFT @ CAMERAS), None)
    facts = reference.compare(only, Trajectory(TIMES, SCANS), Trajectory(TIMES, CAMERAS))
    assert "lidar" not in facts
    assert facts["camera"]["ate_m"] < 1e-9


def test_one_scale_of_the_exposures_is_free():
    exact = np.exp(RNG.normal(0, 0.5, 20))
    found = Exposures(TIMES, 3.0 * exact)
    both = (Trajectory(TIMES, SCANS), Trajectory(TIMES + 0.5, CAMERAS))
    facts = reference.compare(truth(exposures=Exposures(TIMES, exact)), *both, found)
    assert facts["exposure"]["rms_percent"] < 1e-9
    noisy = Exposures(TIMES, exact * np.exp(np.where(np.arange(20) % 2, 0.01, -0.01)))
    facts = reference.compare(truth(exposures=Exposures(TIMES, exact)), *both, noisy)
    assert facts["exposure"]["rms_percent"] == pytest.approx(1.0, rel=0.01)
    assert facts["exposure"]["frames"] == 20


def test_exposures_of_a_power_of_the_light_are_right_after_it():
    rng = np.random.default_rng(5)
    exact = np.exp(0.3 * rng.standard_normal(20))
    both = Trajectory(TIMES, SCANS), Trajectory(TIMES + 0.5, CAMERAS)
    facts = reference.compare(truth(exposures=Exposures(TIMES, exact)), *both, Exposures(TIMES, exact**0.45))
    assert facts["exposure"]["power"] == pytest.approx(0.45)
    assert facts["exposure"]["rms_percent"] > 5
    assert facts["exposure"]["rms_percent_after_power"] < 1e-6
    same = Exposures(TIMES, np.ones(20))
    assert "power" not in reference.compare(truth(exposures=same), *both, same)["exposure"]
    assert "power" not in reference.compare(truth(exposures=Exposures(TIMES, exact)), *both, same)["exposure"]
    sigma = np.full(20, 0.01)
    noisy = 0.45 * np.log(exact) + 0.01 * rng.standard_normal(20)
    nees = uncertainty.of_exposures(TIMES, noisy, sigma, TIMES, exact)
    assert nees["nees"] > 50
    assert 0.3 < nees["nees_after_power"] < 2


def test_a_common_scale_is_told_apart_from_other_errors():
    """A map that is 1 % too large, about the origin; and one that is bent."""
    larger = [np.array(poses) for poses in (SCANS, CAMERAS)]
    for poses in larger:
        poses[:, :3, 3] *= 1.01
    facts = reference.compare(truth(), Trajectory(TIMES, larger[0]), Trajectory(TIMES + 0.5, larger[1]))
    assert facts["lidar"]["scale"] == pytest.approx(1 / 1.01)
    for part in ("lidar", "camera"):
        assert facts[part]["ate_m"] > 1e-3
        assert facts[part]["scaled_ate_m"] == pytest.approx(0.0, abs=1e-9)
    bent = np.array(SCANS)
    bent[: len(bent) // 2, 2, 3] += 0.1
    facts = reference.compare(truth(), Trajectory(TIMES, bent), Trajectory(TIMES + 0.5, CAMERAS))
    assert facts["lidar"]["scaled_ate_m"] > 0.5 * facts["lidar"]["ate_m"]


@pytest.mark.parametrize(
    ("factor", "used"), [(1.04, True), (0.97, True), (1.3, False), (0.5, False), (-0.5, False)]
)
def test_a_factor_that_is_none_of_ranges_excuses_nothing(factor, used):
    """Positions that are all too far out by so much; errors of a sensor that turns on the spot are like that, too."""
    other = np.array(SCANS)
    center = other[:, :3, 3].mean(axis=0)
    other[:, :3, 3] = center + factor * (other[:, :3, 3] - center)
    facts = reference.compare(truth(), Trajectory(TIMES, other), Trajectory(TIMES + 0.5, CAMERAS))
    assert (facts["lidar"]["scaled_ate_m"] < 1e-9) is used
    assert used or facts["lidar"]["scaled_ate_m"] == pytest.approx(facts["lidar"]["ate_m"])
