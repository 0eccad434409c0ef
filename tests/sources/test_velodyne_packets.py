"""Raw packets of Velodyne's sensors, written from the manuals' layout, against a plain decoder of single returns."""

import numpy as np
import pytest
from ros_bags import T0, Messages, typestore, write

from lvba.sources.bags import velodyne_packets
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.opening import open_source
from lvba.sources.source import Kind

VLP16, HDL32E, VLP32C = 0x22, 0x21, 0x28
VLP16_DEGREES = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
CYCLE_US = {VLP16: 55.296, HDL32E: 46.08, VLP32C: 55.296}
HOUR_US = 3_600_000_000
TURNS_PER_US = 10e-6


def firings_in_block(product):
    return 2 if product == VLP16 else 1


def packets(product, count=8, dual=False, azimuth=35_950, began_us=HOUR_US - 1500, seed=0):
    """Bytes (count, 1206), stamps (count,) ns, and what is in them, by block: (azimuth, us, distances, intensities)."""
    rng, data, truth = np.random.default_rng(seed), np.zeros((count, 1206), np.uint8), []
    block_us = CYCLE_US[product] * firings_in_block(product)
    step = 6 if dual else 12
    for packet in range(count):
        since = packet * step * block_us
        head = np.uint32(round(began_us + since) % HOUR_US).tobytes()
        data[packet, 1200:] = np.frombuffer(head + bytes([0x39 if dual else 0x37, product]), np.uint8)
        for block in range(12):
            at = since + (block // 2 if dual else block) * block_us
            here = round(azimuth + 36_000 * TURNS_PER_US * at) % 36_000
            distances = np.where(rng.random(32) < 0.2, 0, rng.integers(500, 20_000, 32))
            if dual and block % 2:
                distances = np.where(rng.random(32) < 0.5, truth[-1][2], distances)
            brightness = rng.integers(0, 256, 32)
            returns = np.stack([distances & 255, distances >> 8, brightness], axis=1).astype(np.uint8)
            whole = bytes([0xFF, 0xEE, here & 255, here >> 8]) + returns.tobytes()
            data[packet, 100 * block : 100 * block + 100] = np.frombuffer(whole, np.uint8)
            truth.append((azimuth + 36_000 * TURNS_PER_US * at, at, distances, brightness))
    stamps = T0 + np.round(1e3 * np.arange(count) * step * block_us).astype(np.int64)
    return data, stamps, truth


def values(data, stamps):
    return {
        "packets": [
            {"stamp.sec": stamp // 10**9, "stamp.nanosec": stamp % 10**9, "data": each}
            for stamp, each in zip(stamps.tolist(), data)
        ]
    }


def decoded(data, stamps):
    [scan] = velodyne_packets.scan(values(data, stamps), T0, "velodyne")
    return scan


@pytest.mark.parametrize("dual", [False, True])
def test_each_return_of_a_vlp_16_is_where_and_when_its_beam_was(dual):
    """Across 360 degrees, and across the full hour of its clock."""
    data, stamps, truth = packets(VLP16, dual=dual)
    expected = []
    for number, (azimuth, at, distances, brightness) in enumerate(truth):
        for place in range(32):
            reach = 0.002 * distances[place]
            if not reach or (dual and number % 2 and distances[place] == truth[number - 1][2][place]):
                continue
            after = place // 16 * 55.296 + place % 16 * 2.304
            angle = np.radians(azimuth / 100 + 360 * TURNS_PER_US * after)
            laser = np.radians(VLP16_DEGREES[place % 16])
            across, up = reach * np.cos(laser), reach * np.sin(laser) - 0.04191 * np.tan(laser)
            row = sorted(VLP16_DEGREES).index(VLP16_DEGREES[place % 16])
            expected.append(
                (
                    across * np.cos(angle),
                    -across * np.sin(angle),
                    up,
                    1e3 * (at + after),
                    row,
                    brightness[place],
                )
            )
    expected, scan = np.array(expected), decoded(data, stamps)
    assert len(scan.points) == len(expected) > 1000
    far = np.linalg.norm(expected[:, :3], axis=1)
    # azimuths are written in hundredths of a degree
    assert (np.linalg.norm(scan.points - expected[:, :3], axis=1) < far * np.radians(0.011) + 1e-5).all()
    assert np.abs(scan.times - expected[:, 3]).max() < 1000
    np.testing.assert_array_equal(scan.rows, expected[:, 4])
    np.testing.assert_array_equal(scan.intensity, expected[:, 5])


@pytest.mark.parametrize(
    ("product", "unit", "lowest", "highest"), [(HDL32E, 0.002, -30.67, 10.67), (VLP32C, 0.004, -25.0, 15.0)]
)
def test_others_have_their_own_units_angles_and_times(product, unit, lowest, highest):
    data, stamps, truth = packets(product)
    scan = decoded(data, stamps)
    reach = unit * np.concatenate([distances[distances > 0] for _, _, distances, _ in truth])
    across = np.linalg.norm(scan.points[:, :2], axis=1)
    seen = np.degrees(np.arccos(np.minimum(across / reach, 1.0)))
    for row, elevation in ((scan.rows == 0, lowest), (scan.rows == 31, highest)):
        assert seen[row] == pytest.approx(abs(elevation), abs=0.02)
    assert scan.times.max() == pytest.approx(1e3 * (truth[-1][1] + 36.0), abs=1500)


def test_clocks_and_lost_packets():
    data, stamps, _ = packets(VLP16, count=12)
    whole = decoded(data, stamps)
    # stamps of a driver jitter by when packets arrive: the sensor's clock does not
    jitter = np.random.default_rng(1).integers(0, 300_000, len(stamps))
    late = decoded(data, stamps + jitter)
    assert np.ptp(late.times - whole.times) == 0
    assert 0 <= (late.times - whole.times)[0] <= 300_000
    # a clock that stands still is not used
    data_without = data.copy()
    data_without[:, 1200:1204] = 0
    assert np.abs(decoded(data_without, np.arange(12) * 80_000_000 + T0).times).max() > 800_000_000
    kept = np.delete(np.arange(12), [4, 5])
    some = decoded(data[kept], stamps[kept])
    there = np.isin(whole.times, some.times)
    assert there.sum() == len(some.times)
    off = np.linalg.norm(whole.points[there] - some.points, axis=1) / np.linalg.norm(some.points, axis=1)
    assert off.max() < np.radians(0.02)


def test_what_is_not_read_says_why():
    data, stamps, _ = packets(VLP16, count=2)
    wrong = {"HDL-64E": (0, 0xDD, "HDL-64E"), "product": (1205, 0x63, "product 0x63")}
    for at, value, words in wrong.values():
        other = data.copy()
        other[:, at + (1 if at == 0 else 0)] = value
        with pytest.raises(Undecodable, match=words):
            decoded(other, stamps)
    with pytest.raises(Undecodable, match="1206 bytes"):
        decoded(data[:, :600], stamps)
    with pytest.raises(Undecodable, match="no packets"):
        list(velodyne_packets.scan({"packets": []}, T0, ""))


@pytest.mark.parametrize("container", ["bag", "mcap"])
def test_a_bag_of_packets_is_a_source_of_scans(tmp_path, container):
    ros = 1 if container == "bag" else 2
    time = "time" if ros == 1 else "builtin_interfaces/Time"
    extra = {
        "velodyne_msgs/msg/VelodynePacket": f"{time} stamp\nuint8[1206] data",
        "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    }
    messages = Messages(ros, typestore(ros, extra=extra))
    data, stamps, _ = packets(VLP16, count=4)
    listed = [
        messages.make("velodyne_msgs/msg/VelodynePacket", stamp=messages.header(int(stamp)).stamp, data=each)
        for stamp, each in zip(stamps, data)
    ]
    name = "velodyne_msgs/msg/VelodyneScan"
    scan = messages.make(name, header=messages.header(T0, "velodyne"), packets=listed)
    path = write(
        tmp_path / "a.bag" if ros == 1 else tmp_path / "a", container, {"/a": (name, [(T0, scan)])}, messages
    )
    source = open_source(path)
    [stream] = source.describe().streams
    assert stream.kind is Kind.SCANS
    assert "time int64" in stream.fields
    [(_, read)] = source.records({"/a"})
    expected = decoded(data, stamps)
    np.testing.assert_array_equal(read.points, expected.points)
    np.testing.assert_array_equal(read.times, expected.times)
    assert read.frame == "velodyne"
