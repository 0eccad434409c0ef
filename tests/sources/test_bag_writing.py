"""What is written to a bag comes back, and rosbags reads and writes the same bytes."""

from dataclasses import fields, replace

import numpy as np
import pytest
from raw_records import SCANS, T0, everything, source_of
from ros_bags import usual_types
from rosbags.highlevel import AnyReader

from lvba.errors import InputError
from lvba.sources.bags.container import Encoding
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.bags.writing import BagForm, write_bag
from lvba.sources.opening import open_source


def name_of(form):
    """rosbags tells the generations of ROS by this."""
    return "a.bag" if form.encoding is Encoding.ROS1 else "a"


def same(one, other):
    """Whether two records have the same in all fields; poses to rounding."""
    assert type(one) is type(other)
    for each in fields(one):
        a, b = getattr(one, each.name), getattr(other, each.name)
        if each.name == "parent_from_child":
            assert np.allclose(a, b, atol=1e-12)
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b)
        else:
            assert a == b, each.name


@pytest.mark.parametrize("form", list(BagForm))
def test_records_of_all_types_come_back(form, tmp_path):
    items = everything()
    write_bag(source_of(items), tmp_path / name_of(form), form)
    source = open_source(tmp_path / name_of(form))
    names = {name for name, _ in items}
    assert {stream.name for stream in source.describe().streams} == names
    back = list(source.records(names))
    assert source.losses() == ()
    assert [name for name, _ in back] == [name for name, _ in items]
    for (_, one), (_, other) in zip(items, back, strict=True):
        same(one, other)


@pytest.mark.parametrize("form", [BagForm.ROS1, BagForm.MCAP])
@pytest.mark.parametrize("layout", list(PointLayout))
def test_rosbags_reads_and_writes_the_same_bytes(form, layout, tmp_path):
    write_bag(source_of(everything()), tmp_path / name_of(form), form, layout)
    store = usual_types(1 if form.encoding is Encoding.ROS1 else 2)
    count = 0
    with AnyReader([tmp_path / name_of(form)]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            serialize = store.serialize_ros1 if form.encoding is Encoding.ROS1 else store.serialize_cdr
            again = serialize(message, connection.msgtype)
            assert bytes(again) == bytes(raw), connection.topic
            count += 1
    assert count == len(everything())


@pytest.mark.parametrize("form", [BagForm.ROS1, BagForm.MCAP])
@pytest.mark.parametrize("layout", [PointLayout.LIVOX_CUSTOM_1, PointLayout.LIVOX_CUSTOM_2])
def test_points_of_livox_are_those_that_rosbags_reads(form, layout, tmp_path):
    write_bag(source_of([("/livox", SCANS[0])]), tmp_path / name_of(form), form, layout)
    [(_, scan)] = open_source(tmp_path / name_of(form)).records({"/livox"})
    with AnyReader([tmp_path / name_of(form)]) as reader:
        [(connection, _, raw)] = reader.messages()
        points = reader.deserialize(raw, connection.msgtype).points
    for name, values in (("offset_time", scan.times), ("reflectivity", scan.intensity), ("line", scan.rows)):
        assert [getattr(point, name) for point in points] == values.tolist()
    assert [[point.x, point.y, point.z] for point in points] == scan.points.tolist()


SECONDS = {  # of a point's time, from the scan's begin
    PointLayout.LIVOX_CUSTOM_1: lambda scan: scan.times * 1e-9,
    PointLayout.LIVOX_CUSTOM_2: lambda scan: scan.times * 1e-9,
    PointLayout.LIVOX_CLOUD: lambda scan: (scan.times - T0) * 1e-9,
    PointLayout.OUSTER: lambda scan: scan.times * 1e-9,
    PointLayout.VELODYNE: lambda scan: scan.times + (scan.stamp - T0) * 1e-9,
    PointLayout.HESAI: lambda scan: scan.times - T0 * 1e-9,
    PointLayout.ROBOSENSE: lambda scan: scan.times - T0 * 1e-9,
}


@pytest.mark.parametrize("layout", list(PointLayout))
def test_each_driver_s_layout_keeps_points_rows_and_times(layout, tmp_path):
    write_bag(source_of([("/scans", SCANS[0])]), tmp_path / "a.bag", BagForm.MCAP, layout)
    [(_, scan)] = open_source(tmp_path / "a.bag").records({"/scans"})
    assert np.array_equal(scan.points, SCANS[0].points)
    assert np.array_equal(scan.intensity, SCANS[0].intensity)
    assert np.array_equal(scan.rows, SCANS[0].rows)
    error = SECONDS[layout](scan) - SCANS[0].times * 1e-9
    assert np.abs(error).max() < 1e-6  # float64 seconds since 1970 have 0.24 us
    if layout is PointLayout.VELODYNE:
        assert scan.times.max() <= 0
        assert scan.times.min() < -0.09


def test_a_bag_that_exists_is_kept(tmp_path):
    (tmp_path / "a.bag").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        write_bag(source_of([]), tmp_path / "a.bag")
    assert (tmp_path / "a.bag").read_text() == "mine"


@pytest.mark.parametrize(
    "times", [SCANS[0].times * 1e-9, SCANS[0].times * 1e-9 + T0 * 1e-9, SCANS[0].times - 1e8]
)
def test_times_that_are_not_ns_from_the_begin_are_refused(times, tmp_path):
    scan = replace(SCANS[0], times=times)
    with pytest.raises(InputError, match="does not hold ns from the start of the scan"):
        write_bag(source_of([("/scans", scan)]), tmp_path / "a.bag")


def test_calibrations_that_come_first_are_recorded_with_what_comes_next(tmp_path):
    calibration = [item for item in everything() if item[0] in ("/a/camera_info", "/tf_static")]
    late = [(name, replace(record, stamp=T0 + 5)) for name, record in calibration]
    items = [*late, ("/pose", replace(next(r for n, r in everything() if n == "/pose"), stamp=T0 + 1))]
    write_bag(source_of(items), tmp_path / "a.bag")
    source = open_source(tmp_path / "a.bag")
    assert {stream.first for stream in source.describe().streams} == {T0 + 1}
    assert [record.stamp for _, record in source.records({name for name, _ in items})] == [
        T0 + 5,
        T0 + 5,
        T0 + 1,
    ]
