"""Raw packets of Ouster's sensors: written from the manuals' layouts, and read back beam by beam."""

import json

import numpy as np
import ouster_writers as ouster
import pytest
from ouster_writers import DUAL, FUSA, LEGACY, LOW, PROFILES, SINGLE, Device

from lvba.sources.bags import ouster_metadata, ouster_packets
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.bags.ouster_scans import ReadingMaker, ScanMaker
from lvba.sources.bags.sensor_clock import SensorClock

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
HALF = np.sqrt(0.5)
TURNED = (HALF, -HALF, 0, 10.0, HALF, HALF, 0, -20.0, 0, 0, 1, 30.0, 0, 0, 0, 1)


def maker(device, **metadata):
    return ScanMaker(ouster_metadata.parse(device.metadata(**metadata)), SensorClock(), "os_lidar")


def scans_of(make, data, recorded=T0):
    """Scans of packets that are recorded at one time."""
    made = [scan for each in data for scan in fed(make, each, recorded)]
    return [*made, *make.finish()]


def fed(make, packet, recorded=T0):
    return list(make({"buf": np.frombuffer(packet, np.uint8)}, recorded, ""))


def assert_is(scan, device, seen):
    """The scan is what was seen; float32 has 4 um at 60 m, and 31 at 500 m."""
    assert_has(scan, ouster.truth(device, seen))
    assert scan.stamp == seen.times[seen.measured].min()


def assert_has(scan, expected):
    assert len(scan.points) == len(expected) > 0
    np.testing.assert_allclose(scan.points, expected[:, :3], atol=4e-5)
    np.testing.assert_array_equal(scan.times, expected[:, 3])
    np.testing.assert_array_equal(scan.rows, expected[:, 4])
    np.testing.assert_array_equal(scan.intensity, expected[:, 5])
    assert scan.points.dtype == np.float32


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("profile", PROFILES)
def test_each_return_is_where_and_when_its_beam_was(profile, nested):
    """Times are by the day, so that they stay."""
    device = Device(profile, out=27.0, up=-9.0, sensor_from_lidar=TURNED)
    seen = ouster.turn(device, 77, T0)
    [scan] = scans_of(maker(device, nested=nested), ouster.packets(device, seen))
    assert_is(scan, device, seen)
    assert scan.frame == "os_lidar"
    beams = len(np.unique(np.stack([scan.times, scan.rows]), axis=1).T)
    assert len(scan.points) > 1.3 * beams if "DUAL" in profile else len(scan.points) == beams


@pytest.mark.parametrize("window", [(5, 40), (50, 20)])
def test_a_window_gives_its_columns_alone(window):
    """One that spans column 0 has a turn that begins there, and its times are in order."""
    device = Device(LOW, window=window)
    seen = ouster.turn(device, 3, T0)
    sensor = ouster_metadata.parse(device.metadata())
    data = ouster.packets(device, seen)
    assert sensor.packets == len(data)
    assert sensor.columns == seen.measured.sum()
    [scan] = scans_of(maker(device), data)
    assert_is(scan, device, seen)


def test_frames_end_where_their_number_changes_and_numbers_begin_anew():
    device, begin = Device(), T0
    turns = [ouster.turn(device, 65534 + number, begin + number * ouster.TURN_NS) for number in range(4)]
    turns[2:] = [ouster.Turn(frame - 65536, *rest) for frame, *rest in map(_fields, turns[2:])]
    make = maker(device)
    data = [each for seen in turns for each in ouster.packets(device, seen)]
    made = scans_of(make, data)
    assert len(made) == 4
    for scan, seen in zip(made, turns):
        assert_is(scan, device, seen)


def _fields(seen):
    return seen.frame, seen.ranges, seen.reflectivity, seen.times, seen.measured


def test_lost_late_and_repeated_packets():
    device = Device(columns=256, window=(0, 255))
    turns = [ouster.turn(device, number, T0 + number * ouster.TURN_NS) for number in range(3)]
    first, second, third = (ouster.packets(device, seen) for seen in turns)
    # the last packet of a turn comes after the first two of the next one; one is lost; one comes twice
    late = [*first[:-1], *second[:2], first[-1], *second[2:7], second[5], *second[8:], *third]
    made = scans_of(maker(device), late)
    assert_is(made[0], device, turns[0])
    assert_is(made[2], device, turns[2])
    some = ouster.truth(device, turns[1])
    after = turns[1].times - turns[1].times[0]
    gone = (some[:, 3] >= after[112]) & (some[:, 3] < after[128])
    assert_has(made[1], some[~gone])
    # later than that it is counted
    make = maker(device)
    for each in [*first[:-1], *second]:
        fed(make, each)
    with pytest.raises(Undecodable, match="after its scan"):
        fed(make, first[-1])


def test_slivers_at_the_ends_are_not_scans():
    device = Device(columns=256, window=(0, 255))
    turns = [ouster.turn(device, number, T0 + number * ouster.TURN_NS) for number in range(2)]
    first, second = (ouster.packets(device, seen) for seen in turns)
    make = maker(device)
    [scan] = scans_of(make, [*first[13:], *second])
    assert_is(scan, device, turns[1])
    assert make.slivers == 1


def test_a_sensor_that_begins_anew_begins_a_scan():
    """Though the numbers of its frames are those of scans before."""
    device = Device()
    again = ouster.like(device, initialization=7)
    turns = [
        ouster.turn(device, number, T0 + at * ouster.TURN_NS) for number, at in ((5, 0), (6, 1), (5, 90))
    ]
    data = [each for seen in turns[:2] for each in ouster.packets(device, seen)]
    made = scans_of(maker(device), [*data, *ouster.packets(again, turns[2])])
    for scan, seen in zip(made, turns, strict=True):
        assert_is(scan, device, seen)


def test_old_metadata_say_less():
    """As of firmware 1.12: neither a format of data, nor where beams begin."""
    names = ("beam_to_lidar_transform", "lidar_origin_to_beam_origin_mm", "udp_profile_lidar")
    names += ("pixels_per_column", "columns_per_packet", "columns_per_frame", "column_window")
    names += ("lidar_to_sensor_transform", "imu_to_sensor_transform")
    device = Device(LEGACY, columns=1024, window=(0, 1023), beams=4)
    for product, out in (("OS-1-64", 15.806), ("OS-0-128", 27.67), ("OS-2-32", 13.762), ("OS1", 12.163)):
        sensor = ouster_metadata.parse(device.metadata(nested=False, without=names, prod_line=product))
        assert sensor.out == pytest.approx(out * 1e-3)
        assert (sensor.columns_per_frame, sensor.columns_per_packet) == (1024, 16)
        assert (sensor.profile, sensor.window, len(sensor.altitude)) == (LEGACY, (0, 1023), 4)
        np.testing.assert_allclose(sensor.sensor_from_lidar[:3, 3], [0, 0, 0.03618])
        np.testing.assert_allclose(sensor.sensor_from_imu[:3, 3], [0.006253, -0.011775, 0.007645])
    seen = ouster.turn(device, 1, T0)
    [scan] = scans_of(ScanMaker(sensor, SensorClock(), ""), ouster.packets(device, seen))
    there = ouster.like(device, out=12.163)
    assert_is(scan, there, seen)


def test_packets_of_old_drivers_have_one_byte_more():
    device = Device()
    seen = ouster.turn(device, 1, T0)
    [scan] = scans_of(maker(device), [each + b"\0" for each in ouster.packets(device, seen)])
    assert_is(scan, device, seen)


WRONG = {
    "no JSON": "{",
    "no JSON object": "[1, 2]",
    "nesting": "[" * 100_000,
    "characters": " " * (ouster_metadata.MAX_TEXT + 1),
    "NaN": {"beam_azimuth_angles": [float("nan")] * 6},
    "too few": {"beam_azimuth_angles": [0.0] * 5},
    "too many": {"beam_altitude_angles": [0.1 * number for number in range(100_000)]},
    "texts": {"beam_altitude_angles": ["1"] * 6},
    "bools": {"beam_azimuth_angles": [True] * 6},
    "beyond floats": {"beam_azimuth_angles": [10**400] * 6},
    "all the same": {"beam_altitude_angles": [0.0] * 6},
    "does not turn": {"beam_altitude_angles": [[0.0] * 64] * 6},
    "object": {"beam_altitude_angles": {"a": 1}},
    "huge": {"columns_per_frame": 10**9},
    "none": {"columns_per_packet": 0},
    "fraction": {"pixels_per_column": 6.5},
    "beams": {"pixels_per_column": 7},
    "window": {"column_window": [0, 64]},
    "window's type": {"column_window": "all"},
    "profile": {"udp_profile_lidar": "RNG99"},
    "profile's type": {"udp_profile_lidar": [1]},
    "no mode": {"lidar_mode": "9" * 5000, "columns_per_frame": None},
    "offset": {"beam_to_lidar_transform": [1, 0, 0, 1e300, *[0] * 12]},
    "no rotation": {"lidar_to_sensor_transform": [1e300] * 16},
    "mirror": {"imu_to_sensor_transform": np.diag([1, 1, -1, 1]).ravel().tolist()},
    "packet's size": {"columns_per_packet": 512, "columns_per_frame": 8192, "udp_profile_lidar": DUAL},
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_metadata_say_why(name):
    wrong = WRONG[name]
    beams = 200 if name == "packet's size" else 6
    text = wrong if isinstance(wrong, str) else Device(beams=beams).metadata(**wrong)
    with pytest.raises(Undecodable, match=r"^(they|their|all their) ") as said:
        ouster_packets.PacketFormat(ouster_metadata.parse(text))
    assert len(str(said.value)) < 200


@pytest.mark.parametrize("profile", PROFILES)
def test_random_packets_are_refused_or_give_numbers(profile):
    rng, device = np.random.default_rng(0), Device(profile)
    make = maker(device)
    size = len(ouster.packets(device, ouster.turn(device, 1, T0))[0])
    made = scans_of(make, [rng.bytes(size) for _ in range(300)])
    for scan in made:
        assert np.isfinite(scan.points).all()
        assert 0 <= scan.times.min() <= scan.times.max() < 20 * SECOND
        assert abs(scan.stamp) < 2**63
    for wrong in (0, 1, size - 1, size + 2, 70_000):
        with pytest.raises(Undecodable, match=f"have {wrong} bytes, and {size} by the metadata"):
            fed(make, bytes(wrong))
    # frames that never end are cut
    held = ouster.packets(device, ouster.turn(device, 1, T0))
    for each in held * 100:
        try:
            fed(make, each)
        except Undecodable:
            continue
    assert sum(map(len, make._open.values())) <= 40


def test_readings_of_an_imu():
    clock = SensorClock()
    make = ReadingMaker(clock, "os_imu")
    data = ouster.imu_packet(T0, (90.0, -1.0, 0.0), (0.0, 0.0, 1.0))
    for packet in (data, data + b"\0"):
        [read] = fed(make, packet)
        assert (read.stamp, read.frame) == (T0, "os_imu")
        np.testing.assert_allclose(read.gyroscope, np.radians([90.0, -1.0, 0.0]))
        np.testing.assert_allclose(read.accelerometer, [0, 0, 9.80665])
    several = [(T0 + number, (0.1, 0.2, number), (0.0, 1.0, 9.8), number != 2) for number in range(4)]
    read = fed(make, ouster.imu_packets_of_several(several))
    assert [each.stamp - T0 for each in read] == [0, 1, 3]
    np.testing.assert_allclose(read[2].gyroscope, [0.1, 0.2, 3], rtol=1e-6)
    np.testing.assert_allclose(read[2].accelerometer, [0.0, 1.0, 9.8], rtol=1e-6)
    for wrong in (b"", bytes(47), bytes(50), bytes(164), bytes(200 - 1)):
        with pytest.raises(Undecodable, match="none of an IMU"):
            fed(make, wrong)
    for wrong in (b"\xff" * 48, ouster.imu_packet(T0, (np.nan, 0, 0), (0, 0, 1))):
        with pytest.raises(Undecodable, match="not finite"):
            fed(make, wrong)


def test_a_clock_of_the_sensor_is_laid_onto_the_recorder_without_jitter():
    """A drift of 30 ppm, packets that come 0 to 3 ms late, and a burst of 2 s."""
    rng, clock = np.random.default_rng(0), SensorClock()
    own = np.arange(0, 40 * SECOND, 2_000_000)
    true = T0 + own + (own * 30e-6).astype(np.int64)
    late = rng.integers(0, 3_000_000, len(own))
    late[9000:10_000] += np.linspace(2 * SECOND, 0, 1000).astype(np.int64)
    off = []
    for stamp, when, behind in zip(own.tolist(), true.tolist(), late.tolist()):
        clock.see(stamp, when + behind)
        off.append(stamp + clock.apart() - when)
    off = np.array(off)[500:]
    assert np.abs(off).max() < 600_000
    assert np.abs(np.diff(off)).max() < 100_000
    # a sensor that begins anew
    clock.see(5, T0 + 100 * SECOND)
    assert clock.apart() == T0 + 100 * SECOND - 5


@pytest.mark.parametrize(
    ("apart", "added"), [(0.02, 0), (3.0, 0), (-37.02, -37), (18.1, 18), (50.5, 0), (5e7, 0)]
)
def test_times_of_the_day_stay_but_for_leap_seconds(apart, added):
    clock = SensorClock()
    for number in range(20):
        clock.see(T0 + number * 5_000_000, T0 + number * 5_000_000 + round(apart * SECOND))
    assert clock.apart() == added * SECOND


def test_lidar_and_imu_have_one_clock():
    device, clock = Device(), SensorClock()
    scans = ScanMaker(ouster_metadata.parse(device.metadata()), clock, "")
    readings = ReadingMaker(clock, "")
    seen = ouster.turn(device, 1, 5 * SECOND)
    data = ouster.packets(device, seen)
    for each in data:
        fed(scans, each, T0 + 130_000_000)  # packets of the LiDAR come later than those of the IMU
    [read] = fed(readings, ouster.imu_packet(6 * SECOND, (0, 0, 0), (0, 0, 1)), T0 + SECOND)
    [scan] = scans.finish()
    assert read.stamp - scan.stamp == SECOND
    assert read.stamp == T0 + SECOND


def test_metadata_may_be_in_either_form():
    for device in (Device(FUSA), Device(SINGLE, beams=3)):
        one, other = (ouster_metadata.parse(device.metadata(nested=nested)) for nested in (True, False))
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name))
        assert one.fusa == (device.profile == FUSA)
    plain = json.loads(Device().metadata())
    plain["lidar_data_format"]["header_type"] = "FUSA"
    assert ouster_metadata.parse(json.dumps(plain)).fusa
