"""Transforms between sensors: repeated among those that move, as ROS 1 does, and beside damaged ones."""

from dataclasses import replace

import numpy as np
import pytest
import ros_bags
from changed_sources import changed
from ros_bags import T0, Messages

from lvba import geometry
from lvba.errors import InputError
from lvba.io.dataset import open_dataset
from lvba.simulate import raw
from lvba.sources.importing.importer import import_source
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.repeated_transforms import Repeated
from lvba.sources.source import PoseSample, TransformSample

pytestmark = pytest.mark.usefixtures("one_pair")
SECOND = 1_000_000_000


def transform(child, stamp=0, size=1.0):
    return TransformSample(stamp, "base", child, geometry.exp(np.full(6, 0.1 * size)), static=False)


def test_what_never_changes_is_told_from_what_moves():
    repeated = Repeated()
    for number in range(5):
        repeated.add(transform("lidar", number * SECOND))
        repeated.add(transform("wheel", number * SECOND, 1 + 1e-3 * number))
    repeated.add(transform("seen once"))
    assert list(repeated.still()) == [("base", "lidar")]
    assert list(repeated.still(4 * SECOND)) == [("base", "lidar")]
    assert list(repeated.still(5 * SECOND)) == []


def repeating(also=(), seconds=2.0):
    """A change of a source: static transforms are repeated in /tf in place of /tf_static, as are others."""

    def change(name, record):
        if not isinstance(record, TransformSample):
            return [(name, record)]
        stamps = record.stamp + np.arange(0, round(seconds * 1e9), SECOND // 5)
        return [
            ("/tf", replace(each, stamp=int(stamp), static=False))
            for stamp in stamps
            for each in (record, *also)
        ]

    return change


def test_static_transforms_that_are_repeated_are_the_extrinsic(tmp_path, small_source):
    import_source(small_source, tmp_path / "static")
    repeated = changed(small_source, repeating())
    assert not any("where the camera is" in words for words in inspect(repeated).missing)
    report = import_source(repeated, tmp_path / "out")
    one, other = (open_dataset(tmp_path / name) for name in ("static", "out"))
    np.testing.assert_allclose(other.camera_from_scan, one.camera_from_scan, atol=1e-9)
    np.testing.assert_allclose(other.images.world_from_sensor, one.images.world_from_sensor, atol=1e-9)
    assert report.facts["calibration"]["camera_from_lidar"] == "static transforms"


def test_transforms_that_are_said_for_a_moment_only_are_none(tmp_path, small_source):
    with pytest.raises(InputError, match="nothing says the extrinsic"):
        import_source(changed(small_source, repeating(seconds=0.7)), tmp_path / "out")


def test_poses_in_tf_are_those_that_move(tmp_path, small_source):
    def in_tree(name, record):
        if isinstance(record, PoseSample):
            moved = TransformSample(
                record.stamp, record.parent, record.child, record.parent_from_child, static=False
            )
            return [("/tf", moved)]
        return repeating()(name, record)

    report = import_source(changed(small_source, in_tree), tmp_path / "out")
    assert report.facts["streams"]["odometry"] == "/tf"
    import_source(small_source, tmp_path / "topic")
    one, other = (open_dataset(tmp_path / name) for name in ("topic", "out"))
    np.testing.assert_allclose(other.scans.world_from_sensor, one.scans.world_from_sensor, atol=1e-9)


def damaged_bag(path, count):
    """Transforms to so many frames in one message, of which the second has a quaternion of zeros."""
    messages = Messages(1)
    vector = messages.make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    listed = []
    for number in range(count):
        turn = messages.make(
            "geometry_msgs/msg/Quaternion", w=0.0 if number == 1 else 1.0, x=0.0, y=0.0, z=0.0
        )
        moved = messages.make("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
        listed.append(
            messages.make(
                "geometry_msgs/msg/TransformStamped",
                header=messages.header(T0, "base"),
                child_frame_id=f"link{number}",
                transform=moved,
            )
        )
    message = messages.make("tf2_msgs/msg/TFMessage", transforms=listed)
    return ros_bags.write(path, "bag", {"/tf_static": ("tf2_msgs/msg/TFMessage", [(T0, message)])}, messages)


def test_a_damaged_transform_costs_none_of_the_others(tmp_path):
    bag = open_source(damaged_bag(tmp_path / "a.bag", 3))
    records = [record for _, record in bag.records({"/tf_static"})]
    assert [record.child for record in records] == ["link0", "link2"]
    [words] = bag.losses()
    assert words.startswith(
        "/tf_static: 1 of 1 messages are damaged in part: the transform base <- link1 has no orientation"
    )


class LossySource:
    """A source that has lost something."""

    def __init__(self, source, words):
        self._source, self._words = source, words

    def __getattr__(self, name):
        return getattr(self._source, name)

    def losses(self):
        return (self._words,)


def test_what_was_lost_is_told_where_the_extrinsic_is_not_said(tmp_path, small_source):
    without = changed(
        small_source,
        lambda name, record: [(name, replace(record, child="other") if name == raw.TF_STATIC else record)],
    )
    words = f"{raw.TF_STATIC}: 1 of 2 messages are lost: damaged"
    with pytest.raises(InputError, match=f"extrinsic of camera and LiDAR.*{words}"):
        import_source(LossySource(without, words), tmp_path / "out")
