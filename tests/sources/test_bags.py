"""Bags of every kind, written by rosbags, give the records that were put in."""

import numpy as np
import pytest
from ros_bags import CONTAINERS, SECOND, T0, Messages, generation, write

from lvba.errors import InputError
from lvba.sources.opening import open_source
from lvba.sources.source import Kind

RNG = np.random.default_rng(0)
CLOUD = np.zeros(
    60, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")]
)
for axis in "xyz":
    CLOUD[axis] = RNG.normal(0, 10, 60)
CLOUD["t"], CLOUD["ring"] = np.arange(60) * 1000, np.arange(60) % 16
POINTS, OFFSETS = RNG.normal(0, 10, (50, 3)).astype(np.float32), np.arange(50) * 2000
TURN = np.array([0.1, -0.2, 0.3, 0.9])


def topics_of(ros):
    """Scans of two kinds, images, poses and IMU, ten of each."""
    messages = Messages(ros)
    clouds, scans, images, poses, imu = [], [], [], [], []
    for i in range(10):
        stamp = T0 + i * SECOND // 10
        clouds.append((stamp + 5_000, messages.cloud(stamp, CLOUD)))
        scans.append((stamp + 6_000, messages.livox(stamp, POINTS + i, OFFSETS)))
        pixels = np.full((4, 6, 3), i, np.uint8)
        image = messages.make(
            "sensor_msgs/msg/Image",
            header=messages.header(stamp + 7),
            height=4,
            width=6,
            encoding="rgb8",
            step=18,
            data=pixels.reshape(-1),
        )
        images.append((stamp + 7_000, image))
        pose = messages.make("geometry_msgs/msg/PoseWithCovariance", pose=messages.pose((i, 2, 3), TURN))
        odometry = messages.make(
            "nav_msgs/msg/Odometry", header=messages.header(stamp, "/odom"), child_frame_id="body", pose=pose
        )
        poses.append((stamp + 8_000, odometry))
        rate = messages.make("geometry_msgs/msg/Vector3", x=0.1 * i, y=2.0, z=3.0)
        imu.append(
            (
                stamp + 9_000,
                messages.make("sensor_msgs/msg/Imu", header=messages.header(stamp), angular_velocity=rate),
            )
        )
    return messages, {
        "/points": ("sensor_msgs/msg/PointCloud2", clouds),
        "/livox/lidar": ("livox_ros_driver2/msg/CustomMsg", scans),
        "/camera/image": ("sensor_msgs/msg/Image", images),
        "/odometry": ("nav_msgs/msg/Odometry", poses),
        "/imu": ("sensor_msgs/msg/Imu", imu),
    }


@pytest.fixture(scope="module", params=CONTAINERS)
def bag(request, tmp_path_factory):
    messages, topics = topics_of(generation(request.param))
    return write(tmp_path_factory.mktemp("bag") / "a.bag", request.param, topics, messages)


def test_streams_are_told_with_counts_and_times(bag):
    streams = {stream.name: stream for stream in open_source(bag).describe().streams}
    assert {name: stream.count for name, stream in streams.items()} == dict.fromkeys(streams, 10)
    assert {name: stream.kind for name, stream in streams.items()} == {
        "/points": Kind.SCANS,
        "/livox/lidar": Kind.SCANS,
        "/camera/image": Kind.IMAGES,
        "/odometry": Kind.POSES,
        "/imu": Kind.IMU,
    }
    packed = any(path.name.endswith(".zstd") for path in bag.iterdir()) if bag.is_dir() else False
    if not packed:
        assert streams["/points"].first == T0 + 5_000
        assert streams["/points"].last == T0 + 9 * SECOND // 10 + 5_000
        assert streams["/points"].fields[:2] == ("x float32", "y float32")
        assert streams["/livox/lidar"].fields[0] == "offset_time uint32"


def test_records_come_back_in_the_order_of_recording(bag):
    source = open_source(bag)
    names = [name for name, _ in source.records({"/points", "/odometry", "/camera/image"})]
    assert names == ["/points", "/camera/image", "/odometry"] * 10
    assert source.losses() == ()


def test_records_have_what_was_written(bag):
    found: dict[str, list] = {}
    for name, record in open_source(bag).records(
        {"/points", "/livox/lidar", "/camera/image", "/odometry", "/imu"}
    ):
        found.setdefault(name, []).append(record)
    stamps = [T0 + i * SECOND // 10 for i in range(10)]
    clouds = found["/points"]
    assert [cloud.stamp for cloud in clouds] == stamps
    assert np.array_equal(clouds[3].points, np.stack([CLOUD[axis] for axis in "xyz"], axis=1))
    assert (clouds[3].time_field, clouds[3].times.dtype, clouds[3].frame) == ("t", np.uint32, "lidar")
    assert np.array_equal(clouds[3].times, CLOUD["t"])
    assert np.array_equal(clouds[3].rows, CLOUD["ring"])
    scans = found["/livox/lidar"]
    assert np.array_equal(scans[4].points, POINTS + np.float32(4))
    assert np.array_equal(scans[4].times, OFFSETS)
    assert np.array_equal(scans[4].intensity, np.arange(50))
    assert np.array_equal(scans[4].rows, np.arange(50) % 4)
    assert found["/camera/image"][5].stamp == stamps[5] + 7
    assert (found["/camera/image"][5].pixels == 5).all()
    pose = found["/odometry"][6]
    assert (pose.parent, pose.child) == ("odom", "body")
    assert np.allclose(pose.parent_from_child[:3, 3], (6, 2, 3))
    unit = TURN / np.linalg.norm(TURN)
    trace = 4 * unit[3] ** 2 - 1
    assert np.isclose(np.trace(pose.parent_from_child[:3, :3]), trace)
    assert np.isclose(np.linalg.det(pose.parent_from_child[:3, :3]), 1)
    assert np.allclose(found["/imu"][7].gyroscope, (0.7, 2, 3))


def test_topic_that_is_not_there_is_named_with_those_that_are(bag):
    with pytest.raises(InputError, match=r"has no topic /points2; give one of its topics: /camera/image, "):
        list(open_source(bag).records({"/points2"}))


def test_several_bags_of_a_folder_are_one(tmp_path):
    messages, topics = topics_of(1)
    halves = [
        {name: (kind, rows[part]) for name, (kind, rows) in topics.items()}
        for part in (slice(5, 10), slice(0, 5))
    ]
    only_imu = {"/imu2": topics["/imu"]}
    for name, some in zip(("a.bag", "b.bag", "c.bag"), (*halves, only_imu)):
        write(tmp_path / name, "bag", some, messages)
    source = open_source(tmp_path)
    assert {stream.name: stream.count for stream in source.describe().streams} == dict.fromkeys(
        [*topics, "/imu2"], 10
    )
    names = [name for name, _ in source.records({"/points", "/imu2"})]
    assert names == ["/points", "/imu2"] * 10


def test_what_is_no_bag_is_none(tmp_path):
    (tmp_path / "a.txt").write_text("nothing")
    for path in (tmp_path, tmp_path / "a.txt"):
        with pytest.raises(InputError, match="neither a bag nor a folder"):
            open_source(path)
