"""Streams whose clocks are far from that of the scans, by when the recorder got their records."""

from dataclasses import replace

import numpy as np
import pytest
import surveys

from lvba.errors import InputError
from lvba.simulate import raw
from lvba.simulate.raw import Sensors
from lvba.sources.importing import clocks, readings, thickness
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions, parse_conventions
from lvba.sources.importing.streams import Streams
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track
from lvba.sources.source import Kind, SourceDescription, Stream

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
CHOSEN = Streams("/lidar", "/image", "/imu", "", "/odometry", "", "", ())
STEPS = np.arange(300) * SECOND // 10
BOOT = 77 * SECOND - T0


def apart(late_ns=0, said=(), **ahead):
    """What is found where stamps of image, imu or odometry are so many ns ahead, and recorded `late_ns` later."""
    stamps = {name: T0 + STEPS + ahead.get(name, 0) for name in ("image", "imu", "odometry")}
    times = {name: (each - T0) * 1e-9 for name, each in stamps.items()}
    kinds = {"lidar": Kind.SCANS, "image": Kind.IMAGES, "imu": Kind.IMU, "odometry": Kind.POSES}
    recorded = {name: T0 + 20_000_000 + (late_ns if name != "lidar" else 0) for name in kinds}
    streams = tuple(
        Stream(f"/{name}", kind, "x", 300, recorded[name], recorded[name] + int(STEPS[-1]))
        for name, kind in kinds.items()
    )
    nothing = np.zeros((300, 3))
    surveyed = surveys.survey(
        T0 + STEPS,
        np.sort(stamps["image"]),
        odometry=Track(times["odometry"], np.tile(np.eye(4), (300, 1, 1))),
        imu=ImuReadings(np.sort(times["imu"]), nothing, nothing),
    )
    options = ImportOptions(conventions=parse_conventions(list(said)))
    return clocks.find(SourceDescription("a", "a list", 0, streams), CHOSEN, surveyed, options)


@pytest.mark.parametrize("seconds", [18, -18, 37, -3600])
def test_clocks_that_differ_by_whole_seconds_are_told_to_the_second(seconds):
    """GPS time and atomic time are so far from that of day; records come late by much less."""
    by_recorder = apart(late_ns=120_000_000, image=seconds * SECOND, imu=seconds * SECOND)
    near = 0.121 if abs(seconds) > 100 else 0.0
    assert by_recorder.image == pytest.approx(-seconds, abs=near)
    assert by_recorder.imu == by_recorder.image
    assert by_recorder.odometry == 0.0
    assert len(by_recorder.warnings) == 2


def test_stamps_since_a_device_started_are_told_as_well_as_records_are_in_time():
    by_recorder = apart(late_ns=120_000_000, image=BOOT, odometry=BOOT)
    assert by_recorder.image == by_recorder.odometry == pytest.approx(-BOOT * 1e-9 + 0.12, abs=1e-3)
    assert by_recorder.imu == 0.0


def test_records_that_come_late_are_of_the_same_clock():
    assert apart(late_ns=9 * SECOND) == clocks.ONE
    assert apart(late_ns=20 * SECOND).odometry == 0.0, "poses that overlap with the scans are of their clock"


def test_a_glitch_of_stamps_is_no_clock():
    one = np.zeros(300, np.int64)
    one[7] = 3600 * SECOND
    assert apart(image=one, imu=one) == clocks.ONE


def test_an_option_says_more_than_the_recorder():
    said = apart(said=["image_offset=-17.5", "imu_offset=2"], image=18 * SECOND)
    assert (said.image, said.imu, said.odometry) == (-17.5, 2.0, 0.0)
    assert [words.endswith("by the option") for words in said.warnings] == [True, True]
    assert apart(said=["image_offset=0.1"], image=18 * SECOND) == clocks.ONE


SENSORS = Sensors(points=2500, width=160, height=120)


@pytest.fixture(scope="module")
def truth():
    return raw.measure("courtyard", seconds=3.0, sensors=SENSORS)


@pytest.fixture(scope="module", autouse=True)
def few_pairs():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(readings, "MOST_PAIRS", 10)
        patch.setattr(thickness, "_QUERIES", 300)
        yield


@pytest.fixture(scope="module")
def plain(truth, few_pairs, tmp_path_factory):
    """A source of one clock, and what its import writes."""
    source, out = raw.written(truth, raw.Conventions(), SENSORS), tmp_path_factory.mktemp("plain") / "out"
    import_source(source, out)
    return source, out


def stamped(source, by, late_s=0.0):
    """The source with other stamps, which all but the scans are recorded `late_s` after. by: ns, by stream"""
    items = tuple(
        (name, replace(record, stamp=record.stamp + by.get(name, 0))) for name, record in source.items
    )
    late = round(late_s * 1e9)
    streams = tuple(
        each if each.name == raw.LIDAR else replace(each, first=each.first + late, last=each.last + late)
        for each in source.description.streams
    )
    return replace(source, items=items, description=replace(source.description, streams=streams))


def first_lines(out):
    names = ("image_poses.txt", "lidar_poses.txt", "imu.csv")
    paths = [next(out.rglob(name)) for name in names]
    return [float(path.read_text().splitlines()[1].replace(",", " ").split()[0]) for path in paths]


CASES = {
    "images by GPS, the IMU by atomic time": ({raw.IMAGES: 18 * SECOND, raw.IMU: 37 * SECOND}, 0.0, ()),
    "images since the camera started": ({raw.IMAGES: BOOT - 345_678_901}, 0.06, ()),
    "as an option says": ({raw.IMAGES: 18 * SECOND}, 0.0, ("image_offset=-18",)),
}


@pytest.mark.parametrize("name", CASES)
def test_streams_of_other_clocks_come_to_that_of_the_scans(tmp_path, plain, name):
    by, late, said = CASES[name]
    source, written = plain
    options = ImportOptions(conventions=parse_conventions(list(said)))
    report = import_source(stamped(source, by, late), tmp_path / "out", options)
    assert report.facts["written"]["images"] >= 27
    tolerance = 0.02 if late else 1e-6  # what is less is left to the bundle adjustment
    np.testing.assert_allclose(first_lines(tmp_path / "out"), first_lines(written), rtol=0, atol=tolerance)
    added = report.facts["applied"]["added_to_stamps_of_images_s"]
    assert added == pytest.approx(-by[raw.IMAGES] * 1e-9, abs=max(tolerance, 1e-5))
    assert float(report.facts["conventions"]["image_offset"]["taken"]) == pytest.approx(added, abs=1e-3)
    assert any("stamps are of another clock" in words for words in report.warnings)


def test_images_of_another_clock_that_nothing_tells_are_refused(tmp_path, plain):
    odd = stamped(plain[0], {raw.IMAGES: 18 * SECOND})
    streams = tuple(replace(each, first=None, last=None) for each in odd.description.streams)
    odd = replace(odd, description=replace(odd.description, streams=streams))
    with pytest.raises(
        InputError, match=r"no image lies between poses: .* by 1.* s: its clock.*image_offset=SEC"
    ):
        import_source(odd, tmp_path / "out")
