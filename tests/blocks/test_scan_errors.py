"""Errors of the range sensor of a recording: found, taken out, and nothing corrected where there is none."""

import math
from functools import cache

import numpy as np
import pytest

from lvba.blocks import decoded_scans, scan_errors, scan_windows, split
from lvba.blocks.split import SplitConfig
from lvba.geometry import closest_rotation
from lvba.io import dataset as recordings
from lvba.io import reference
from lvba.io.dataset import open_dataset
from lvba.lidar import bundle_adjustment, incidence
from lvba.lidar.config import LidarConfig
from lvba.lidar.range_errors import DEPTH, DIRECTION
from lvba.simulate.disturbances import Disturbances
from lvba.simulate.simulation import simulate
from lvba.steps import report_data
from lvba.steps.lidar import solve_lidar
from lvba.trajectory import pose_error

SMALL = {"frames": 2, "scans": 36, "seed": 11, "width": 64, "height": 48}


class Recordings:
    """Recordings of one walk, and what several tests ask of one: made once. Nobody changes them."""

    def __init__(self, folder):
        self._folder = folder
        self.made, self.measured, self.clean_error = map(
            cache, (self._made, self._measured, self._clean_error)
        )

    def _made(self, lidar, points, **disturb):
        folder = self._folder / f"{lidar}-{points}-{disturb}"
        disturbances = Disturbances(**disturb)
        simulate("courtyard", folder, lidar=lidar, disturb=disturbances, points_per_scan=points, **SMALL)
        return open_dataset(folder)

    def _measured(self, lidar, points, **disturb):
        """Errors found in a recording."""
        return scan_errors.measure(self.made(lidar, points, **disturb), LidarConfig())

    def _clean_error(self, lidar, points):
        """Of refined scan poses where the sensor has no error."""
        return error(self.made(lidar, points))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return Recordings(tmp_path_factory.mktemp("recorded"))


def refined(dataset, errors=None):
    """Scan poses."""
    piece = decoded_scans.decode_scans(dataset, (0, 36), errors)
    points = [piece.points[a:b] for a, b in zip(piece.offsets[:-1], piece.offsets[1:], strict=True)]
    return bundle_adjustment.refine(
        points, dataset.scans.world_from_sensor, sensor_position=dataset.sensor_position_scan
    ).world_from_scan


def true_scans(dataset):
    return reference.read_reference(f"{dataset.root}/reference").scans.world_from_sensor


def error(dataset, errors=None):
    """Of refined scan poses."""
    return pose_error(refined(dataset, errors), true_scans(dataset))


@pytest.mark.parametrize(
    ("lidar", "points", "disturbance", "value", "name", "expected"),
    [
        ("spinning", 6000, "elevation_bias", 0.3, "elevation", math.radians(0.3)),
        ("spinning", 10000, "incidence_bias", 0.03, "incidence", 0.03),
        ("non_repetitive", 6000, "depth_distortion", 0.02, "distortion", 0.02),
        ("non_repetitive", 6000, "elevation_bias", 0.3, "elevation", math.radians(0.3)),
    ],
)
def test_an_error_is_found_and_taken_out(recorded, lidar, points, disturbance, value, name, expected):
    disturb = {disturbance: value}
    dataset = recorded.made(lidar, points, **disturb)
    errors = recorded.measured(lidar, points, **disturb)
    assert errors.ranges.corrected == (name,)
    # elevation and range errors are corrected to first order
    assert errors.ranges.values[name] == pytest.approx(
        expected, abs=5 * errors.ranges.sigma[name] + 0.03 * expected
    )
    best = recorded.clean_error(lidar, points)
    before, after = error(dataset), error(dataset, errors)
    # beams of a sensor that looks ahead that go higher turn its scans, and hardly move them
    assert max(before.ate_m / best.ate_m, before.rotation_deg / best.rotation_deg) > 2
    assert after.ate_m < 1.6 * best.ate_m
    assert after.rotation_deg < 1.6 * best.rotation_deg + 0.01


def test_an_error_by_brightness_is_found_and_taken_out(recorded):
    """Ranges are right for a surface of half the radiance, of which an intensity of 50 returns straight on."""
    dataset = recorded.made("spinning", 10000, intensity_bias=0.03)
    ranges = (errors := scan_errors.measure(dataset, LidarConfig())).ranges
    assert "brightness" in ranges.corrected
    assert set(ranges.corrected) <= {"brightness", "offset"}
    usual = 0.03 * ranges.beams.usual / 100
    assert ranges.values["brightness"] == pytest.approx(
        usual, abs=4 * ranges.sigma["brightness"] + 0.03 * usual
    )
    assert ranges.values["offset"] == pytest.approx(usual - 0.015, abs=4 * ranges.sigma["offset"])
    best, before = recorded.clean_error("spinning", 10000), error(dataset)
    after = error(dataset, errors)
    assert before.ate_m > 1.3 * best.ate_m
    assert after.ate_m < 1.6 * best.ate_m
    assert after.rotation_deg < 1.6 * best.rotation_deg + 0.01


@pytest.mark.parametrize("lidar", ["spinning", "non_repetitive"])
def test_a_right_sensor_is_left_alone(recorded, lidar):
    dataset = recorded.made(lidar, 6000)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert not errors.corrected
    assert not errors.ranges.problem
    sigma = np.array(list(errors.ranges.sigma.values()))
    assert (np.abs(list(errors.ranges.values.values())) < 4 * sigma).all()
    turn, off = np.split(np.sqrt(np.diagonal(errors.planes_off)), 2)  # by what they may be
    assert 0 < turn.max() < 1e-3
    assert 1e-4 < off.max() < 4e-3
    piece = decoded_scans.decode_scans(dataset, (0, 3), errors)
    np.testing.assert_array_equal(piece.points, np.concatenate(recordings.load_scans(dataset)[:3]))
    assert piece.errors is None


def test_an_error_that_planes_do_not_show_clearly_stays_and_is_in_what_is_promised(recorded):
    dataset = recorded.made("non_repetitive", 6000, incidence_bias=0.01)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert not errors.corrected
    assert not errors.ranges.noticed
    assert 1e-3 < np.sqrt(np.diagonal(errors.planes_off)).max() < 1e-2
    shift = errors.ranges.poses_off[1]
    assert error(dataset).ate_m < recorded.clean_error("non_repetitive", 6000).ate_m + 3 * shift


def test_an_error_of_another_form_is_noticed_and_not_taken_for_one_that_is_known(recorded):
    """Ranges of a sensor that turns, too long but ahead: beams that go lower explain some of it."""
    dataset = recorded.made("spinning", 6000, depth_distortion=0.03)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert errors.ranges.noticed == (DIRECTION,)
    assert not errors.corrected
    assert errors.ranges.values[DIRECTION] > 5e-3
    part, off = np.sqrt(np.diagonal(errors.planes_off))[[0, 3]]
    assert off == pytest.approx(errors.ranges.values[DIRECTION], abs=1e-4)
    # of ranges of a courtyard
    assert off / 20 < part < off / 2
    assert "depends on the beam's direction" in report_data.warnings_of_errors(errors)[0]
    # scans are promised with what it makes of them, but for the scale, of which planes tell nothing
    _, shift = errors.ranges.poses_off
    assert 0.003 < off_but_for_scale(dataset, refined(dataset)) < 3 * shift
    assert shift < 0.05


def off_but_for_scale(dataset, poses):
    """m, root mean square, that refined scans are off."""
    there, truth = poses[:, :3, 3], true_scans(dataset)[:, :3, 3]
    there, truth = there - there.mean(axis=0), truth - truth.mean(axis=0)
    there = there @ closest_rotation(truth.T @ there).T
    return np.sqrt(np.mean(np.sum((there * (there * truth).sum() / (there**2).sum() - truth) ** 2, axis=1)))


def test_a_known_error_is_taken_out_beside_one_of_another_form(recorded):
    dataset = recorded.made("spinning", 6000, depth_distortion=0.005, elevation_bias=0.3)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert errors.ranges.corrected == ("elevation",)
    assert errors.ranges.noticed == (DIRECTION,)
    expected = math.radians(0.3)
    assert errors.ranges.values["elevation"] == pytest.approx(
        expected, abs=5 * errors.ranges.sigma["elevation"] + 0.03 * expected
    )


def test_beams_that_go_into_surfaces_are_noticed_and_not_taken_for_a_known_error(recorded):
    """As leaves; taken for plain surfaces, they seem to be beams that go lower."""
    dataset = recorded.made("spinning", 10000, foliage=0.05)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert not errors.corrected
    assert errors.ranges.noticed == (DEPTH,)
    # into half of the surfaces, or more where most points are on those
    depth = errors.ranges.values[DEPTH]
    assert 0.01 < depth < 0.05
    off = np.sqrt(np.diagonal(errors.planes_off))[
        3:
    ]  # by that, and by what errors of ranges may be beside it
    assert depth < off.min() < off.max() < 1.2 * depth
    assert "behind some surfaces" in report_data.warnings_of_errors(errors)[0]
    turn, shift = errors.ranges.poses_off
    # but for the scale, of which planes tell nothing
    assert off_but_for_scale(dataset, poses := refined(dataset)) < 3 * shift
    assert pose_error(poses, true_scans(dataset)).rotation_deg < 3 * math.degrees(turn)


def test_an_error_that_no_sensor_has_is_not_corrected(recorded):
    dataset = recorded.made("spinning", 6000, incidence_bias=0.2)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert "incidence" not in errors.ranges.corrected
    # what stays in the points is promised
    assert np.sqrt(np.diagonal(errors.planes_off)).max() > 0.01


def test_what_no_error_explains_is_promised_as_far_as_errors_were_seen(recorded, monkeypatch):
    """The same where rounds do not end: errors are known too little to be taken out, and stay."""
    dataset = recorded.made("spinning", 6000, incidence_bias=0.03)
    monkeypatch.setattr("lvba.lidar.range_errors._FALLS", 0.0)
    errors = scan_errors.measure(dataset, LidarConfig())
    assert errors.ranges.problem
    assert not errors.corrected
    assert np.sqrt(np.diagonal(errors.planes_off)).max() > 1e-3
    assert off_but_for_scale(dataset, refined(dataset)) < 3 * errors.ranges.poses_off[1]


def test_points_meet_the_planes_of_the_map_whatever_a_single_scan_shows(recorded, monkeypatch):
    """Small surfaces far away are met at an angle that a single scan shows wrongly; here, all are."""
    dataset = recorded.made("spinning", 10000, incidence_bias=0.03)
    [part] = split.parts(dataset, SplitConfig(), split.Load(10_000, 0.0))
    errors = recorded.measured("spinning", 10000, incidence_bias=0.03)
    assert errors.ranges.corrected == ("incidence",)
    best = recorded.clean_error("spinning", 10000)
    monkeypatch.setattr(incidence, "cosines", lambda points, _: np.linspace(0.1, 1.0, len(points)))
    piece = decoded_scans.decode_scans(dataset, (0, 36), errors)
    assert piece.cosine.dtype == np.float16
    truth = true_scans(dataset)

    def solved():
        stage = solve_lidar(dataset, part, [((0, 36), lambda: piece)], LidarConfig(), True, errors)
        return pose_error(stage.result.world_from_scan, truth).ate_m

    after = solved()
    monkeypatch.setattr(decoded_scans.ScanReader, "cosines", lambda reader, scans: None)
    assert after < 1.6 * best.ate_m
    assert solved() > 2 * after


def test_nothing_is_measured_where_scans_stay(recorded, monkeypatch):
    dataset = recorded.made("spinning", 6000)
    monkeypatch.setattr(recordings, "load_scan", None)
    assert scan_errors.measure(dataset, LidarConfig(), enabled=False) is None


def test_a_recording_shorter_than_a_window_is_looked_at_once(tmp_path):
    """Twice the same scans would count as twice the evidence."""
    sizes = {"frames": 2, "scans": 9, "seed": 11, "width": 64, "height": 48, "points_per_scan": 300}
    simulate("courtyard", tmp_path / "short", **sizes)
    [window] = scan_windows.probes(open_dataset(tmp_path / "short"))
    np.testing.assert_array_equal(window.numbers, np.arange(9))
