"""The motion left in the scans of a recording: found, taken out, and left alone where there is none."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lvba import geometry
from lvba.blocks import decoded_scans, motion_left, scan_errors, scan_motions, scan_windows
from lvba.dataset import DESKEWED_BY
from lvba.io import dataset as recordings
from lvba.io import reference
from lvba.io.dataset import open_dataset
from lvba.lidar import bundle_adjustment, path_motion
from lvba.lidar.config import LidarConfig
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan_errors import ScanErrors
from lvba.lidar.scan_motion import MotionLeft
from lvba.simulate.disturbances import Disturbances
from lvba.simulate.simulation import simulate
from lvba.steps import report_data, uncertainty
from lvba.steps.lidar import with_errors
from lvba.trajectory import Trajectory, pose_error

SMALL = {"frames": 2, "scans": 36, "seed": 5, "width": 64, "height": 48, "points_per_scan": 4000}
LEFT = 0.4
READOUT = 0.03


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """By the part that is left: the same recording, with times; with no part, as a sensor without times gives it."""
    root = tmp_path_factory.mktemp("left")
    for name, left in (("clean", 1e-12), ("left", LEFT), ("timeless", 0.0)):
        simulate("courtyard", root / name, disturb=Disturbances(motion_left=left), **SMALL)
    return {name: open_dataset(root / name) for name in ("clean", "left", "timeless")}


@pytest.fixture(scope="module")
def found(recording):
    """Of the recording with motion left in its scans."""
    return measured(recording["left"])


def measured(dataset):
    return errors_of(dataset).motion


def errors_of(dataset):
    errors = scan_errors.measure(dataset, LidarConfig())
    assert not errors.ranges.corrected
    return errors


def refined(dataset, points):
    return bundle_adjustment.refine(
        points, dataset.scans.world_from_sensor, sensor_position=dataset.sensor_position_scan
    )


def truth_of(dataset):
    return reference.read_reference(f"{dataset.root}/reference").scans.world_from_sensor


def error_m(dataset, points):
    """Of refined scan poses."""
    return pose_error(refined(dataset, points).world_from_scan, truth_of(dataset)).ate_m


def test_what_is_left_is_found_and_taken_out(recording, found):
    dataset, motion = recording["left"], found
    assert motion is not None
    assert motion.corrected
    assert motion.fraction == pytest.approx(LEFT, abs=5 * motion.sigma + 0.005)
    piece = decoded_scans.decode_scans(dataset, (0, 36), ScanErrors(None, motion))
    points = [piece.points[a:b] for a, b in zip(piece.offsets[:-1], piece.offsets[1:], strict=True)]
    clean = recordings.load_scans(recording["clean"])
    best, before = (error_m(dataset, each) for each in (clean, recordings.load_scans(dataset)))
    result, truth = refined(dataset, points), truth_of(dataset)
    after = pose_error(result.world_from_scan, truth).ate_m
    assert before > 4 * best
    assert after < 2 * best
    knowing = with_errors(result, ScanErrors(None, motion), np.arange(36))
    # cameras are held by what neighboring scans share
    np.testing.assert_array_equal(knowing.covariance, result.covariance)
    np.testing.assert_array_equal(knowing.conditional_covariance, result.conditional_covariance)
    told = knowing.whole_covariance
    times = dataset.scans.times
    nees = [
        uncertainty.against(Trajectory(times, result.world_from_scan), each, Trajectory(times, truth))["nees"]
        for each in (result.covariance, told.marginal)
    ]
    assert nees[0] > 4, "poses at the end of a sweep are as uncertain as the motion during it"
    assert nees[1] < 3
    assert (np.linalg.eigvalsh(told.step - result.step_covariance) > -1e-12).all()


def test_a_jump_of_the_rough_poses_is_no_motion(recording, found):
    """Within a window: the scans beside a jump of a meter were moved as if the sensor had jumped with them."""
    dataset = recording["left"]
    rough = dataset.scans.world_from_sensor.copy()
    rough[18:, :3, 3] += [0.3, -0.5, 0.8]
    jumping = measured(replace(dataset, scans=Trajectory(dataset.scans.times, rough)))
    assert jumping.fraction == pytest.approx(found.fraction, abs=5e-3)
    np.testing.assert_allclose(jumping.motion[:, 3:], found.motion[:, 3:], atol=0.03)
    np.testing.assert_allclose(jumping.motion[:, :3], found.motion[:, :3], atol=0.01)


def deskewed_by(dataset, monkeypatch, of_motion, seed=3, size=(4e-3, 0.1)):
    """The recording with rough poses that are a decimeter off, and scans that were deskewed by them.

    of_motion: (6,) of rotation and translation, by how much of them; size: rad and m that the poses are off
    """
    rng, scans, real = np.random.default_rng(seed), dataset.scans, recordings.load_scan
    truth = truth_of(dataset)
    off = rng.normal(0, np.repeat(size, 3), (len(truth), 6))
    rough = truth @ geometry.exp(off)
    clock = motion_left.clock(dataset, scan_windows.probes(dataset))
    wrong = [path_motion.sweep_twists(scans.times, poses, clock) for poses in (rough, truth)]
    added = (wrong[0] - wrong[1]) * of_motion

    def load(dataset, index):
        scan = real(dataset, index)
        tau = scan.time - dataset.scans.times[index]
        return replace(scan, points=geometry.moved_along(scan.points, tau, added[index]).astype(np.float32))

    monkeypatch.setattr(recordings, "load_scan", load)
    return replace(dataset, scans=Trajectory(scans.times, rough))


@pytest.mark.parametrize("by_rough", [("rotation", "translation"), ("translation",)])
def test_scans_that_were_deskewed_by_rough_poses_are_deskewed_again(recording, monkeypatch, by_rough):
    """With a gyroscope, only the translation is theirs."""
    of_motion = np.repeat([float(name in by_rough) for name in DESKEWED_BY], 3)
    dataset = deskewed_by(recording["clean"], monkeypatch, of_motion)
    motion = measured(dataset)
    assert motion.by_rough == by_rough
    assert motion.fraction == 0
    piece = decoded_scans.decode_scans(dataset, (0, 36), ScanErrors(None, motion))
    points = [piece.points[a:b] for a, b in zip(piece.offsets[:-1], piece.offsets[1:], strict=True)]
    before, after = (error_m(dataset, each) for each in (recordings.load_scans(dataset), points))
    assert after < 0.8 * before
    assert "deskewed by the rough poses" in report_data.warnings_of_motion(motion)[0]
    facts = json.loads(json.dumps(report_data.plain(motion.facts())))
    assert MotionLeft.of_facts(facts).by_rough == by_rough


def test_a_recording_may_say_that_scans_were_deskewed_by_its_poses(recording, monkeypatch):
    """Poses are wrong by so little that planes do not tell it."""
    dataset = deskewed_by(recording["clean"], monkeypatch, np.ones(6), size=(3e-4, 4e-3))
    assert measured(dataset).by_rough == ()
    said = replace(dataset, deskewed_by=DESKEWED_BY)
    motion = measured(said)
    assert motion.by_rough == DESKEWED_BY
    assert motion.fraction == 0
    assert motion.corrected
    errors = ScanErrors(None, motion)
    piece = decoded_scans.decode_scans(said, (0, 36), errors)
    points = [piece.points[a:b] for a, b in zip(piece.offsets[:-1], piece.offsets[1:], strict=True)]
    before, after = (error_m(said, each) for each in (recordings.load_scans(said), points))
    assert after < before
    assert report_data.warnings_of_errors(errors, said.deskewed_by) == []
    assert report_data.warnings_of_errors(errors) != []


def test_rough_poses_that_scans_were_not_deskewed_by_leave_nothing(recording, monkeypatch):
    dataset = deskewed_by(recording["clean"], monkeypatch, np.zeros(6))
    motion = measured(dataset)
    assert motion.by_rough == ()
    assert not motion.corrected


def test_scans_beside_a_jump_of_the_rough_poses_were_not_deskewed_by_it(recording, monkeypatch):
    dataset = deskewed_by(recording["clean"], monkeypatch, np.ones(6))
    rough = dataset.scans.world_from_sensor.copy()
    rough[18:, :3, 3] += [0.3, -0.5, 0.8]
    jumping = measured(replace(dataset, scans=Trajectory(dataset.scans.times, rough)))
    assert jumping.by_rough == DESKEWED_BY
    assert np.linalg.norm(jumping.motion[:, 3:], axis=1).max() < 2


def test_deskewed_scans_keep_their_bytes(recording):
    dataset = recording["clean"]
    motion = measured(dataset)
    assert motion is not None
    assert not motion.corrected
    assert abs(motion.fraction) < 4 * motion.sigma
    piece = decoded_scans.decode_scans(dataset, (0, 36), ScanErrors(None, motion))
    np.testing.assert_array_equal(piece.points, decoded_scans.decode_scans(dataset, (0, 36)).points)
    assert piece.errors is None


def test_scans_without_times_tell_of_no_motion(recording, monkeypatch):
    assert measured(recording["timeless"]) is None
    monkeypatch.setattr(recordings, "load_scan", None)
    assert scan_errors.measure(recording["left"], LidarConfig(), enabled=False) is None


def with_times(monkeypatch, change):
    """Scans with other times. change: of times (N,) and the stamp"""
    real = recordings.load_scan

    def load(dataset, index):
        scan = real(dataset, index)
        return replace(scan, time=change(scan.time, dataset.scans.times[index]))

    monkeypatch.setattr(recordings, "load_scan", load)


def test_times_of_chance_correct_nothing(recording, monkeypatch):
    with_times(monkeypatch, lambda times, stamp: np.random.default_rng(1).permutation(times))
    motion = measured(recording["left"])
    assert motion is not None
    assert not motion.corrected


def test_constant_times_say_nothing_and_long_ones_are_told(recording, monkeypatch):
    with_times(monkeypatch, lambda times, stamp: np.full(len(times), stamp))
    assert measured(recording["left"]) is None
    monkeypatch.undo()
    with_times(monkeypatch, lambda times, stamp: 70 * (times - stamp))
    long = measured(recording["left"])
    assert long is not None
    assert not long.corrected
    assert "no sweep" in long.problem


def test_times_from_the_start_of_the_sweep_find_the_same_part(recording, found, monkeypatch):
    """In whole microseconds. The pose is then that of the middle of the sweep."""
    dataset = recording["left"]
    with_times(monkeypatch, lambda times, stamp: np.round(1e6 * (times - stamp + 0.1)))
    motion = measured(dataset)
    assert motion is not None
    assert motion.clock.unit == 1e-6
    assert motion.fraction == pytest.approx(found.fraction, abs=0.01)


def test_a_scan_of_another_part_is_moved_as_well(recording, found):
    """The reader that finds a scan in no piece reads its file, and moves its points as the pieces' were."""
    dataset = recording["left"]
    whole = decoded_scans.decode_scans(dataset, (0, 6), ScanErrors(None, found))
    few = decoded_scans.decode_scans(dataset, (0, 3), ScanErrors(None, found))
    reader = decoded_scans.ScanReader([((0, 3), lambda: few)], whole=dataset)
    np.testing.assert_array_equal(reader(5), whole.points[whole.offsets[5] :][: len(reader(5))])


@pytest.fixture(scope="module")
def depth_camera(tmp_path_factory):
    """A depth camera that reads its rows one after another, and one that reads them at once.

    Not in rooms: there it faces single walls, and by which way scans slide along them the last bit of a sum decides.
    """
    root = tmp_path_factory.mktemp("rows")
    for name, readout in (("at_once", 0.0), ("rows", READOUT)):
        simulate(
            "courtyard",
            root / name,
            lidar="depth_camera",
            disturb=Disturbances(depth_readout=readout),
            **SMALL | {"scans": 48},
        )
    return {name: open_dataset(root / name) for name in ("at_once", "rows")}


def test_rows_of_a_depth_camera_are_put_where_they_belong(depth_camera):
    dataset = depth_camera["rows"]
    motion = scan_errors.measure(dataset, LidarConfig()).motion
    assert isinstance(motion.clock, RowClock)
    assert motion.corrected
    assert motion.sweep == pytest.approx(READOUT, abs=5 * motion.sigma * motion.clock.sweep + 1e-3)
    given = MotionLeft.of_facts(json.loads(json.dumps(report_data.plain(motion.facts()))))
    np.testing.assert_array_equal(given.clock.down, motion.clock.down)
    errors = ScanErrors(None, given)
    piece = decoded_scans.decode_scans(dataset, (0, 48), errors)
    points = [piece.points[a:b] for a, b in zip(piece.offsets[:-1], piece.offsets[1:], strict=True)]
    best = error_m(depth_camera["at_once"], recordings.load_scans(depth_camera["at_once"]))
    before, after = error_m(dataset, recordings.load_scans(dataset)), error_m(dataset, points)
    assert before > 2 * best
    assert after < 1.5 * best


def test_a_depth_camera_that_reads_rows_at_once_keeps_its_points(depth_camera):
    motion = scan_errors.measure(depth_camera["at_once"], LidarConfig()).motion
    assert motion is not None
    assert not motion.corrected
    assert abs(motion.fraction) < 5 * motion.sigma


def looking(likely, away, wider, monkeypatch):
    """A measurement of three scans, of which each look tells deviations of the next of some sizes, and its looks."""
    seen = []

    def look(*_):
        turn = len(seen)
        seen.append(turn)
        return SimpleNamespace(thickness=0.01, away=lambda scale: away[turn] if scale == 0.01 else np.nan)

    def deviations(*_):
        return SimpleNamespace(beside=lambda _: likely[len(seen) - 1])

    monkeypatch.setattr(scan_motions.scan_motion, "deviations", deviations)
    monkeypatch.setattr(
        scan_motions.scan_motion,
        "most_likely",
        lambda value, _: (np.full((3, 12), value), np.full((3, 6, 6), value)),
    )
    moving = SimpleNamespace(
        clock=SimpleNamespace(sweep=0.1), solved=lambda *_: SimpleNamespace(tau=np.zeros(1)), view=look
    )
    measurement = SimpleNamespace(
        moving=moving,
        _most=lambda _: np.full(4, 50.0),
        _wider=lambda *_: wider,
    )
    return measurement, seen


@pytest.mark.parametrize(
    ("likely", "away", "kept", "looks"),
    [
        ([30.0], [1.0, 1.02], 0.0, 2),  # points are farther from planes: no deviation
        ([1.0, 30.0], [1.0, 0.9, 0.95], 1.0, 3),  # only the second is none
        ([1.0, 1.2, 1.3], [1.0, 0.9, 0.8], 1.2, 3),
        ([1.0, 1.001], [1.0, 0.9], 1.0, 2),  # they stay as they are
        ([0.0], [1.0], 0.0, 1),
        ([60.0], [1.0], 0.0, 1),  # the path moves by less
        ([1.0, 60.0], [1.0, 0.9], 1.0, 2),
    ],
)
def test_deviations_are_as_large_as_the_path_allows_and_leave_points_near_planes(
    likely, away, kept, looks, monkeypatch
):
    measurement, seen = looking(likely, away, np.zeros((3, 2)), monkeypatch)
    deviation, covariance = scan_motions._Measurement._deviations(measurement, None, np.zeros((3, 6)))
    assert (deviation == kept).all()
    assert (covariance == kept).all()
    assert len(seen) == looks


def test_deviations_of_the_first_scan_are_as_large_as_its_points_say(monkeypatch):
    """The path tells its motion from one side only; what it allows others says nothing of it."""
    wider = np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    measurement, seen = looking([200.0, 210.0, 210.0], [1.0, 0.9, 0.8], wider, monkeypatch)
    deviation, covariance = scan_motions._Measurement._deviations(measurement, None, np.zeros((3, 6)))
    assert (deviation[0] == 210.0).all()
    assert (covariance[0] == 210.0).all()
    assert not deviation[1:].any()
    assert not covariance[1:].any()
    assert len(seen) == 3


def test_motions_of_parts_are_those_of_the_whole(recording, found):
    """Parts of a long recording are measured by themselves: a window is of the part that it begins in."""
    dataset, config = recording["left"], LidarConfig()
    shared = scan_errors.measure_shared(dataset, config)
    assert not shared.corrected
    parts = [(0, 18), (18, 20), (20, 36)]
    motions = [scan_motions.measure(dataset, each, shared, config) for each in parts]
    assert [len(each.motion) for each in motions].count(0) < len(parts)
    together = scan_motions.joined(shared, motions).motion
    for name in ("motion", "acceleration", "pose_covariance"):
        np.testing.assert_array_equal(getattr(together, name), getattr(found, name))
    assert scan_motions.measure(dataset, (0, 36), None, config) is None
    assert scan_motions.joined(shared, [None, None]) is shared
