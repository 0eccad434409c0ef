"""What `lvba inspect` finds out: conventions of each driver, what is missing, and which streams it would take."""

from dataclasses import replace

import numpy as np
import pytest
from raw_records import SCANS, SECOND, T0, everything, source_of

from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import write_bag
from lvba.sources.choosing import choose
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.source import (
    GnssFix,
    ImuSample,
    Kind,
    ListSource,
    PoseSample,
    RawImage,
    SourceDescription,
    Stream,
)

TOLD = {
    PointLayout.LIVOX_CUSTOM_1: ("offset_time", "ns", "from the stamp", "start of the sweep"),
    PointLayout.LIVOX_CUSTOM_2: ("offset_time", "ns", "from the stamp", "start of the sweep"),
    PointLayout.LIVOX_CLOUD: ("timestamp", "ns", "since 1970", "start of the sweep"),
    PointLayout.OUSTER: ("t", "ns", "from the stamp", "start of the sweep"),
    PointLayout.VELODYNE: ("time", "s", "from the stamp", "end of the sweep"),
    PointLayout.HESAI: ("timestamp", "s", "since 1970", "start of the sweep"),
    PointLayout.ROBOSENSE: ("timestamp", "s", "since 1970", "start of the sweep"),
}


def inspected(tmp_path, items, layout=PointLayout.LIVOX_CUSTOM_2):
    write_bag(source_of(items), tmp_path / "a.bag", layout=layout)
    return inspect(open_source(tmp_path / "a.bag"))


def facts_of(inspection, name):
    return next(each for each in inspection.streams if each.stream.name == name)


@pytest.mark.parametrize("layout", list(PointLayout))
def test_times_of_points_are_told_for_each_driver(layout, tmp_path):
    scans = facts_of(inspected(tmp_path, [("/scans", scan) for scan in SCANS], layout), "/scans")
    told = [scans.facts[name] for name in ("time_field", "time_unit", "times", "stamp_is")]
    assert tuple(told) == TOLD[layout]
    assert scans.facts["sweep_s"] == pytest.approx(
        0.0981, abs=2e-4
    )  # 99 ms of times, less the outermost percent
    assert scans.facts["points"] == 2000
    assert scans.rate == pytest.approx(10, rel=1e-3)


def test_times_of_points_that_did_not_come_back_are_not_counted(tmp_path):
    """Some drivers leave them at zero, beside times since 1970."""
    items = []
    for scan in SCANS:
        points, times = scan.points.copy(), (scan.stamp + scan.times.astype(float)) * 1e-9
        points[::7], times[::7] = np.nan, 0.0
        items.append(("/scans", replace(scan, points=points, times=times)))
    description = SourceDescription("a", "a list", 0, (Stream("/scans", Kind.SCANS, "scans", len(items)),))
    scans = facts_of(inspect(ListSource(description, tuple(items))), "/scans")
    assert (scans.facts["times"], scans.facts["stamp_is"]) == ("since 1970", "start of the sweep")


def test_clouds_without_times_say_so(tmp_path):
    items = [("/scans", replace(scan, times=None, time_field="")) for scan in SCANS]
    inspection = inspected(tmp_path, items, PointLayout.OUSTER)
    assert facts_of(inspection, "/scans").facts["times"] == "not used: all the same"


def test_streams_are_chosen_and_what_is_missing_is_told(tmp_path):
    inspection = inspected(tmp_path, everything())
    choice = inspection.choice
    assert (choice.lidar, choice.odometry, choice.imu) == ("/livox", "/odometry", "/imu")
    assert dict(choice.others)[Kind.POSES] == ("/pose", "/path")
    assert inspection.missing == ("no camera: give its intrinsics, --calibration FILE",)


def test_topics_of_a_public_data_set_name_its_preset(tmp_path):
    topics = {"/livox": "/livox/lidar", "/imu": "/livox/imu"}
    items = [(topics.get(name, name), record) for name, record in everything()]
    [images] = {name for name, record in items if isinstance(record, RawImage) and record.encoded}
    named = [("/camera/image_color/compressed" if name == images else name, record) for name, record in items]
    assert inspected(tmp_path, named).presets == ("r3live",)
    (tmp_path / "other").mkdir()
    assert inspected(tmp_path / "other", items).presets == ()


def test_images_beside_a_camera_info_have_a_camera(tmp_path):
    names = {"/rgb": "/a/image_raw", "/livox": "/livox"}
    items = [
        (names.get(name, name), record) for name, record in everything() if name not in ("/gray", "/jpeg")
    ]
    assert inspected(tmp_path, items).missing == ()


def test_without_poses_images_and_transforms_each_is_told(tmp_path):
    inspection = inspected(tmp_path, [("/livox", scan) for scan in SCANS])
    assert [sentence.partition(":")[0] for sentence in inspection.missing] == ["no poses", "no images"]
    items = [("/livox", SCANS[0]), ("/image", RawImage(T0, "camera", pixels=np.zeros((4, 4), np.uint8)))]
    (tmp_path / "b").mkdir()
    missing = inspected(tmp_path / "b", items).missing
    assert [sentence.partition(":")[0] for sentence in missing] == [
        "no poses",
        "no camera",
        "where the camera is on the LiDAR is not said",
    ]


def test_transforms_are_taken_for_poses_where_there_are_none(tmp_path):
    items = [item for item in everything() if item[0] not in ("/odometry", "/pose", "/path")]
    inspection = inspected(tmp_path, items)
    assert inspection.choice.odometry == "/tf"
    assert not any("no poses" in sentence for sentence in inspection.missing)


def test_gravity_tells_the_unit_of_an_accelerometer(tmp_path):
    for length, unit in ((1.0, "g"), (9.81, "m/s^2"), (1000.0, "not known")):
        sample = ImuSample(T0, "imu", np.zeros(3), np.array([0.0, length, 0.0]))
        (folder := tmp_path / str(length)).mkdir()
        assert facts_of(inspected(folder, [("/imu", sample)]), "/imu").facts["acceleration_unit"] == unit


def test_clocks_that_differ_are_told():
    def stream(name, kind, first):
        return Stream(name, kind, "x", 2, first, first + SECOND)

    scan = replace(SCANS[0], stamp=5 * SECOND)
    poses = [PoseSample(T0 + i, "map", "body", np.eye(4)) for i in range(2)]
    streams = (stream("/scan", Kind.SCANS, T0), stream("/odometry", Kind.POSES, T0))
    items = (("/scan", scan), *(("/odometry", pose) for pose in poses))
    inspection = inspect(ListSource(SourceDescription("", "", 0, streams), items))
    assert facts_of(inspection, "/scan").facts["clock"] == "since its device started"
    apart = (T0 - 5 * SECOND) // SECOND
    assert (
        f"clocks of /odometry and /scan are {apart} s apart, by when the recorder got their stamps"
        in inspection.notes
    )


def test_clouds_of_an_odometry_are_not_taken_for_those_of_the_sensor():
    def stream(name, kind, count, fields=(), message_type="x"):
        return Stream(name, kind, message_type, count, fields=fields)

    timed = ("x float32", "timestamp float64")
    streams = (
        stream("/cloud_registered", Kind.SCANS, 900, timed),
        stream("/livox/lidar", Kind.SCANS, 800, timed),
        stream("/points_without_times", Kind.SCANS, 1000),
        stream("/gps/odom", Kind.POSES, 5000, message_type="nav_msgs/msg/Odometry"),
        stream("/path", Kind.POSES, 2000, message_type="nav_msgs/msg/Path"),
        stream("/aft_mapped_to_init", Kind.POSES, 800, message_type="nav_msgs/msg/Odometry"),
        stream("/depth/image", Kind.IMAGES, 900),
        stream("/image", Kind.IMAGES, 800),
    )
    choice = choose(SourceDescription("", "", 0, streams))
    assert (choice.lidar, choice.odometry, choice.image) == ("/livox/lidar", "/aft_mapped_to_init", "/image")


def test_a_topic_with_messages_of_two_types_is_named():
    """As in a bag that has the topic twice."""
    fix = GnssFix(stamp=1, frame="", latitude=1.0, longitude=2.0, altitude=3.0, covariance=None, status=0)
    reading = ImuSample(2, "imu", np.ones(3), np.ones(3))
    stream = Stream("/fix", Kind.GNSS, "sensor_msgs/msg/NavSatFix", 2)
    source = ListSource(SourceDescription("made", "made", 0, (stream,)), (("/fix", reading), ("/fix", fix)))
    [facts] = inspect(source).streams
    assert facts.problem == "it has messages of several types"
