"""Bags with raw packets of Ouster's sensors: topics, metadata, what is lost, and a whole import."""

import heapq
from pathlib import Path

import numpy as np
import ouster_writers as ouster
import pytest
from changed_sources import SMALL
from ouster_writers import LOW, Device
from ros_bags import SECOND, T0, Messages, typestore, write

from lvba.errors import InputError
from lvba.io.dataset import load_scan, open_dataset
from lvba.simulate import lidar, raw
from lvba.sources import choosing
from lvba.sources.bags.bag_source import BagSource
from lvba.sources.bags.container import Contents, Encoding, Message, Topic
from lvba.sources.bags.ouster_topics import OusterTopics
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.importing import streams as importing_streams
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.source import ImuSample, Kind, RawScan, SourceDescription, Stream, TransformSample

SCANS, IMU, METADATA = "/ouster/lidar_packets", "/ouster/imu_packets", "/ouster/metadata"
PACKET = "ouster_ros/msg/PacketMsg"
STARTED = T0 - 1000 * SECOND
"""When the sensor was switched on."""
DEVICE = Device(LOW)
METADATA_TEXTS = (DEVICE.metadata(),)


def turns(count=3, device=DEVICE):
    return [ouster.turn(device, number, 1000 * SECOND + number * ouster.TURN_NS) for number in range(count)]


def bag(path, container, seen, metadata=METADATA_TEXTS):
    """Packets of turns as a driver records them, those of the LiDAR up to 2 ms late."""
    ros = 1 if container == "bag" else 2
    package = "ouster_ros" if ros == 1 else "ouster_sensor_msgs"
    kind = f"{package}/msg/PacketMsg"
    messages = Messages(ros, typestore(ros, extra={kind: "uint8[] buf"}))
    rng = np.random.default_rng(3)

    def late(data, stamp):
        return STARTED + stamp + int(rng.integers(0, 2_000_000)), message(data)

    def message(data):
        return messages.make(kind, buf=np.frombuffer(data, np.uint8))

    ends = [int(each.times[15::16][number]) for each in seen for number in range(4)]
    data = [packet for each in seen for packet in ouster.packets(DEVICE, each)]
    felt = [1000 * SECOND + number * 10_000_000 for number in range(20)]
    topics = {
        SCANS: (kind, [late(*each) for each in zip(data, ends)]),
        IMU: (
            kind,
            [(STARTED + each, message(ouster.imu_packet(each, (0, 0, 9), (0, 0, 1)))) for each in felt],
        ),
    }
    texts = [(STARTED + 1000 * SECOND, messages.make("std_msgs/msg/String", data=each)) for each in metadata]
    if texts:
        topics[METADATA] = ("std_msgs/msg/String", texts)
    return write(path, container, topics, messages)


@pytest.mark.parametrize("container", ["bag", "mcap", "sqlite3"])
def test_a_bag_of_packets_is_a_source_of_scans_and_readings(tmp_path, container):
    path = bag(tmp_path / ("a.bag" if container == "bag" else "a"), container, turns())
    source = open_source(path)
    streams = {stream.name: stream for stream in source.describe().streams}
    assert {name: each.kind for name, each in streams.items()} == {
        SCANS: Kind.SCANS,
        IMU: Kind.IMU,
        METADATA: Kind.TRANSFORMS,
    }
    assert streams[SCANS].count == 3
    assert "t int64" in streams[SCANS].fields
    records = list(source.records(set(streams)))
    scans, felt, placed = (
        [record for _, record in records if isinstance(record, kind)]
        for kind in (RawScan, ImuSample, TransformSample)
    )
    assert source.losses() == ()
    for scan, seen in zip(scans, turns(), strict=True):
        expected = ouster.truth(DEVICE, seen)
        np.testing.assert_allclose(scan.points, expected[:, :3], atol=4e-5)
        np.testing.assert_array_equal(scan.times, expected[:, 3])
        # readings are recorded at once, and tell the clock
        assert scan.stamp == STARTED + seen.times[0]
    assert [each.stamp for each in felt] == [STARTED + 1000 * SECOND + 10_000_000 * n for n in range(20)]
    assert {(each.parent, each.child, each.static) for each in placed} == {
        ("os_sensor", "os_lidar", True),
        ("os_sensor", "os_imu", True),
    }
    assert {each.frame for each in scans} == {"os_lidar"}
    assert {each.frame for each in felt} == {"os_imu"}
    # scans that are read alone have the same stamps
    assert [record.stamp for _, record in source.records({SCANS})] == [each.stamp for each in scans]


def test_what_inspection_says(tmp_path):
    inspection = inspect(open_source(bag(tmp_path / "a.bag", "bag", turns())))
    facts = {each.stream.name: each for each in inspection.streams}
    assert inspection.choice.lidar == SCANS
    assert inspection.choice.imu == IMU
    assert inspection.choice.odometry == ""
    assert facts[SCANS].facts["stamp_is"] == "start of the sweep"
    assert facts[SCANS].facts["time_unit"] == "ns"
    assert facts[IMU].facts["acceleration_unit"] == "m/s^2"


@pytest.mark.parametrize(
    ("left", "right"),
    [("/left/{}", "/right/{}"), ("/left_{}", "/right_{}"), ("/os/{}_left", "/os/{}_right")],
)
def test_two_sensors_have_metadata_clocks_and_frames_of_their_own(left, right):
    devices = {left: Device(LOW), right: Device(LOW, beams=7)}
    kinds = {"lidar_packets": PACKET, "imu_packets": PACKET, "metadata": "std_msgs/msg/String"}
    types = {name.format(part): kind for name in devices for part, kind in kinds.items()}
    texts = {name.format("metadata"): [device.metadata()] for name, device in devices.items()}
    topics = OusterTopics(Path("a.bag"), types, texts.__getitem__)
    names = [name.format("lidar_packets") for name in devices]
    assert [len(topics.sensor(name).altitude) for name in names] == [6, 7]
    assert len({topics.unit(name) for name in types}) == 2
    assert len({topics.frame(name, "os_lidar") for name in types}) == 2
    assert topics.beside(names[:1]) == {left.format("imu_packets")}
    assert "left" in topics.frame(names[0], "os_imu")
    lost = {name: kind for name, kind in types.items() if name != right.format("metadata")}
    with pytest.raises(InputError, match=f"record {right.format('metadata')} "):
        OusterTopics(Path("a.bag"), lost, texts.__getitem__).sensor(names[1])


def test_what_the_driver_made_of_packets_is_taken_where_both_are_there():
    scans, felt, clouds, imu = (
        Stream(name, kind, message, 9)
        for name, kind, message in (
            (SCANS, Kind.SCANS, PACKET),
            (IMU, Kind.IMU, PACKET),
            ("/ouster/points", Kind.SCANS, "sensor_msgs/msg/PointCloud2"),
            ("/ouster/imu", Kind.IMU, "sensor_msgs/msg/Imu"),
        )
    )
    auto = ImportOptions(odometry="auto")
    for streams, expected in (
        ((scans, felt, clouds, imu), ("/ouster/points", "/ouster/imu")),
        ((scans, felt, imu), (SCANS, "/ouster/imu")),
        ((scans, felt), (SCANS, IMU)),
    ):
        description = SourceDescription("a", "", 0, streams)
        likely, taken = choosing.choose(description), importing_streams.choose(description, auto)
        assert (likely.lidar, likely.imu) == (taken.lidar, taken.imu) == expected
    asked = ImportOptions(odometry="auto", lidar=SCANS)
    assert importing_streams.choose(description, asked).lidar == SCANS


def test_metadata_that_are_nowhere_or_none_give_one_error(tmp_path):
    path = bag(tmp_path / "a.bag", "bag", turns(), metadata=())
    source = open_source(path)
    said = r"/ouster/lidar_packets has packets of an Ouster, and no topic has the metadata of the sensor; "
    said += r"record /ouster/metadata \(std_msgs/String, latched\) with them, or save its text as .*a\.json"
    with pytest.raises(InputError, match=said):
        list(source.records({SCANS}))
    with pytest.raises(InputError, match=said):
        import_source(source, tmp_path / "out", ImportOptions(odometry="auto"))
    missing = inspect(source).missing
    assert any("record /ouster/metadata" in sentence for sentence in missing)
    # readings of an IMU need none
    assert len(list(source.records({IMU}))) == 20
    (tmp_path / "a.json").write_text(DEVICE.metadata())
    assert len(list(open_source(path).records({SCANS}))) == 3
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match=r"whose metadata, .*a\.json, cannot be used: they are no JSON"):
        list(open_source(path).records({SCANS}))
    wrong = bag(tmp_path / "b.bag", "bag", turns(), metadata=[DEVICE.metadata(beam_azimuth_angles=[1])])
    with pytest.raises(InputError, match=r"/ouster/metadata, cannot be used: their beam_azimuth_angles"):
        list(open_source(wrong).records({SCANS}))


def test_the_last_metadata_that_can_be_used_count(tmp_path):
    texts = [DEVICE.metadata(udp_profile_lidar="LEGACY"), DEVICE.metadata(), "nothing"]
    source = open_source(bag(tmp_path / "a.bag", "bag", turns(), metadata=texts))
    assert len(list(source.records({SCANS}))) == 3
    list(source.records({METADATA}))
    [sentence] = source.losses()
    assert "1 of 3 messages are lost: as metadata of an Ouster, they are no JSON" in sentence


def test_metadata_of_another_mode_and_damaged_packets(tmp_path):
    source = open_source(
        bag(tmp_path / "a.bag", "bag", turns(), metadata=[DEVICE.metadata(udp_profile_lidar="LEGACY")])
    )
    with pytest.raises(InputError, match=r"12 of 12 .* bytes, and .* by the metadata .*ouster_ros"):
        list(source.records({SCANS}))


class _Both:
    """A bag of others, and messages of packets beside it, in the order of their times."""

    def __init__(self, container, more):
        self._container, self._more, self.path = container, more, container.path

    def contents(self):
        inside = self._container.contents()
        topics = {message.topic.name: message.topic for message in self._more}
        return Contents(inside.format, (*inside.topics, *topics.values()), inside.notes)

    def messages(self, names, losses):
        more = [message for message in self._more if message.topic.name in names]
        others = self._container.messages(names, losses)
        return heapq.merge(others, more, key=lambda message: message.time)


def _simulated(truth, device):
    """Turns of the device in a simulated world: distances in whole mm from one point, as beams begin on the axis."""
    altitude, azimuth = np.radians(device.altitude), np.radians(device.azimuth)
    turned = -2 * np.pi * np.arange(device.columns) / device.columns
    angle = turned[:, None] - azimuth
    level = np.cos(altitude)
    parts = [np.cos(angle) * level, np.sin(angle) * level, np.broadcast_to(np.sin(altitude), angle.shape)]
    directions = np.stack(parts, axis=2).reshape(-1, 3)
    for number, begin in enumerate(truth.scans):
        times = begin + np.arange(device.columns) * ouster.TURN_NS // device.columns
        rng = np.random.default_rng([5, number])
        poses = truth.scene_from_body(np.repeat(times, device.beams)) @ truth.rig.body_from_lidar
        points, intensity, beams = lidar.scan(truth.around, poses, directions, rng)
        ranges, bright = np.zeros(len(directions), int), np.zeros(len(directions), int)
        ranges[beams] = np.rint(1e3 * np.linalg.norm(points, axis=1))
        bright[beams] = np.clip(intensity, 0, 255)
        shape = (device.columns, device.beams, 1)
        measured = np.ones(device.columns, bool)
        yield ouster.Turn(number, ranges.reshape(shape), bright.reshape(shape), times, measured)


def test_packets_of_a_simulated_recording_are_imported(tmp_path, one_pair, monkeypatch):
    """By a clock of its own, packets 1 to 4 ms late: stamps of scans are those of the truth, but for the first delay."""
    monkeypatch.setattr(raw, "LIDAR_FRAME", "os_lidar")
    truth = raw.measure("courtyard", seconds=2.0, sensors=SMALL)
    write_bag(raw.written(truth, sensors=SMALL), tmp_path / "others.bag", BagForm.ROS1)
    identity = tuple(np.eye(4).ravel())
    device = Device(beams=16, columns=64, out=0.0, sensor_from_lidar=identity, sensor_from_imu=identity)
    definition = "uint8[] buf\n"
    topic = Topic(SCANS, PACKET, Encoding.ROS1, definition, 4 * len(truth.scans), 1, 2)
    named = Topic(METADATA, "std_msgs/msg/String", Encoding.ROS1, "string data\n", 1, 1, 1)
    text = device.metadata().encode()
    more = [Message(named, int(truth.scans[0]), len(text).to_bytes(4, "little") + text)]
    rng = np.random.default_rng(0)
    for seen in _simulated(truth, device):
        own = ouster.Turn(seen.frame, seen.ranges, seen.reflectivity, seen.times - STARTED, seen.measured)
        for number, packet in enumerate(ouster.packets(device, own)):
            when = int(seen.times[16 * number + 15]) + int(rng.integers(1_000_000, 4_000_000))
            more.append(Message(topic, when, len(packet).to_bytes(4, "little") + packet))
    inside = open_source(tmp_path / "others.bag")._container
    source = BagSource(tmp_path / "others.bag", _Both(inside, more))
    out = tmp_path / "out"
    import_source(source, out, ImportOptions(lidar=SCANS))
    dataset = open_dataset(out)
    assert len(dataset.scan_paths) == len(truth.scans)
    stamps = np.array([int(Path(path).stem.replace(".", "")) for path in dataset.scan_paths])
    assert np.min(stamps - truth.scans) > 0.9e6
    assert np.max(stamps - truth.scans) < 2.5e6
    scan = load_scan(dataset, 3)
    assert len(scan.points) > 500
    assert np.ptp(scan.time) == pytest.approx(0.1 * 63 / 64, abs=0.003)
