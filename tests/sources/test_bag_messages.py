"""Messages as drivers write them, odd ones too; those that cannot be read say why."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ros_bags import LIVOX_POINT, SECOND, T0, Messages, typestore, write

from lvba import geometry
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.lens import Lens
from lvba.sources import choosing, packets
from lvba.sources.bags import decoders
from lvba.sources.bags.container import Encoding, Topic
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source
from lvba.sources.source import Kind

RNG = np.random.default_rng(0)
XYZ = np.round(RNG.normal(0, 10, (12, 3)), 2)


@pytest.fixture(params=[1, 2])
def messages(request):
    return Messages(request.param)


def source_of(tmp_path, messages, rows, kind, topic="/a"):
    """A bag with these messages in one topic."""
    container = "bag" if messages.ros == 1 else "mcap"
    rows = [(T0 + i, row) for i, row in enumerate(rows)]
    return open_source(write(tmp_path / "a.bag", container, {topic: (kind, rows)}, messages))


def only(tmp_path, messages, message, kind, topic="/a"):
    """The only record of a bag with this message."""
    [(_, record)] = source_of(tmp_path, messages, [message], kind, topic).records({topic})
    return record


def why(tmp_path, messages, message, kind):
    """Why a message is refused: most of a topic that is needed, or counted in others."""
    source = source_of(tmp_path, messages, [message], kind)
    if kind == KIND:
        assert list(source.records({"/a"})) == []
        return source.losses()[0]
    with pytest.raises(InputError) as refused:
        list(source.records({"/a"}))
    return refused.value.problem


def table(**columns):
    """A packed structured array, fields in this order."""
    result = np.zeros(len(XYZ), [(name, form) for name, (form, _) in columns.items()])
    for name, (_, values) in columns.items():
        result[name] = values
    return result


CLOUDS = {
    "unaligned and in another order": table(
        tag=("u1", 7),
        z=("<f4", XYZ[:, 2]),
        timestamp=("<f8", np.arange(12) / 7),
        x=("<f4", XYZ[:, 0]),
        y=("<f4", XYZ[:, 1]),
        Ring=("u1", np.arange(12)),
        Reflectivity=("<u2", 300),
    ),
    "float64": table(
        **{axis: ("<f8", XYZ[:, i]) for i, axis in enumerate("xyz")},
        time_stamp=("<f8", T0 + np.arange(12) * 1000),
        intensity=("u1", 3),
    ),
    "big endian": table(
        **{axis: (">f4", XYZ[:, i]) for i, axis in enumerate("xyz")},
        t=(">u4", np.arange(12) * 70_000),
        ring=(">u2", np.arange(12) + 256),
    ),
}


TIMES = {
    "Aeva": ({"time_offset_ns": ("<i4", -70_000 * np.arange(12))}, -70_000 * np.arange(12, dtype=np.int32)),
    "seconds and ns": (
        {"timestampNsec": ("<u4", np.arange(12)), "timestampSec": ("<u4", T0 // 10**9)},
        T0 + np.arange(12),
    ),
    "seconds and ns as floats": (
        {"sec": ("<f8", 3.0), "nsec": ("<f4", 1000.0 * np.arange(12))},
        3e9 + 1e3 * np.arange(12),
    ),
    "names known before come first": (
        {"relative_time": ("<f4", 1.0), "t": ("<u4", np.arange(12))},
        np.arange(12, dtype=np.uint32),
    ),
    "seconds alone are no times": ({"sec": ("<u4", 5)}, None),
}


@pytest.mark.parametrize("name", TIMES)
def test_times_of_points_are_read_by_the_names_that_drivers_give_them(name, messages, tmp_path):
    columns, expected = TIMES[name]
    points = table(**{axis: ("<f4", XYZ[:, i]) for i, axis in enumerate("xyz")}, **columns)
    source = source_of(tmp_path, messages, [messages.cloud(T0, points)], "sensor_msgs/msg/PointCloud2")
    [(_, scan)] = source.records({"/a"})
    assert (scan.times is None) == (expected is None)
    [stream] = source.describe().streams
    untimed = replace(stream, name="/b", fields=stream.fields[:3], count=5)
    description = replace(source.describe(), streams=(untimed, stream))
    assert choosing.choose(description).lidar == ("/b" if expected is None else "/a")
    if expected is not None:
        assert np.array_equal(scan.times, expected)
        assert scan.times.dtype == expected.dtype


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize(("padding", "height"), [(0, 1), (5, 3)])
def test_clouds_of_any_layout(name, padding, height, messages, tmp_path):
    points = CLOUDS[name]
    cloud = messages.cloud(T0, points, height=height, padding=padding, big="big" in name)
    scan = only(tmp_path, messages, cloud, "sensor_msgs/msg/PointCloud2")
    assert scan.points.dtype == np.float32
    assert np.array_equal(scan.points, XYZ.astype(np.float32))
    field = next(each for each in points.dtype.names if each.startswith("t") and each != "tag")
    assert scan.time_field == field
    assert scan.times.dtype == points.dtype[field].newbyteorder("=")
    assert np.array_equal(scan.times, points[field])
    rows = next((each for each in points.dtype.names if each.lower() == "ring"), None)
    assert (scan.rows is None) == (rows is None)
    if rows:
        assert np.array_equal(scan.rows, points[rows])
    bright = next(
        (each for each in points.dtype.names if each.lower() in ("intensity", "reflectivity")), None
    )
    assert (scan.intensity is None) == (bright is None)
    if bright:
        assert np.array_equal(scan.intensity, points[bright])


def test_clouds_that_contradict_themselves(messages, tmp_path):
    kind = "sensor_msgs/msg/PointCloud2"
    good = CLOUDS["float64"]
    for values, said in (
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "its points are more than its bytes"),
        ({"point_step": 0}, "its points are more than its bytes"),
        ({"point_step": 12}, "lies beyond its points"),
        ({"fields": []}, "its points have no x, y, z"),
        ({"width": 0}, "it has no points"),
    ):
        cloud = messages.cloud(T0, good)
        for name, value in values.items():
            setattr(cloud, name, value)
        (folder := tmp_path / str(len(list(tmp_path.iterdir())))).mkdir()
        assert said in why(folder, messages, cloud, kind)


def test_livox_messages_of_another_version_are_read_by_their_own_definition(tmp_path):
    fields = "std_msgs/Header header\nuint64 timebase\nuint32 timestep\nuint32 point_num\nuint8 lidar_id\n"
    extra = {
        "livox_ros_driver/msg/CustomPoint": f"{LIVOX_POINT}\nfloat64 range",
        "livox_ros_driver/msg/CustomMsg": f"{fields}uint8[3] rsvd\nCustomPoint[] points\nstring note",
    }
    for ros in (1, 2):
        messages = Messages(ros, typestore(ros, extra=extra))
        points = [
            messages.make("livox_ros_driver/msg/CustomPoint", offset_time=i, x=x, y=y, z=z, line=3, range=0.5)
            for i, (x, y, z) in enumerate(XYZ)
        ]
        scan_message = messages.make(
            "livox_ros_driver/msg/CustomMsg",
            header=messages.header(T0),
            points=points,
            note="hello",
            timestep=9,
        )
        (tmp_path / str(ros)).mkdir()
        scan = only(tmp_path / str(ros), messages, scan_message, "livox_ros_driver/msg/CustomMsg")
        assert np.array_equal(scan.points, XYZ.astype(np.float32))
        assert np.array_equal(scan.times, np.arange(12))
        assert (scan.rows == 3).all()


PIXELS = RNG.integers(0, 256, (6, 8, 3)).astype(np.uint8)
GRAY16 = RNG.integers(0, 65536, (6, 8)).astype(np.uint16)
ALPHA = np.dstack([PIXELS, np.full((6, 8), 9, np.uint8)])


@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("rgb8", PIXELS, PIXELS),
        ("bgr8", PIXELS[..., ::-1], PIXELS),
        ("rgba8", ALPHA, PIXELS),
        ("bgra8", ALPHA[..., [2, 1, 0, 3]], PIXELS),
        ("8UC3", PIXELS[..., ::-1], PIXELS),
        ("mono8", PIXELS[..., 0], PIXELS[..., 0]),
        ("mono16", GRAY16, GRAY16),
    ],
)
@pytest.mark.parametrize(("padding", "big"), [(0, False), (7, True)])
def test_images_of_plain_encodings(encoding, stored, expected, padding, big, messages, tmp_path):
    order = ">" if big else "<"
    rows = np.ascontiguousarray(stored).astype(stored.dtype.newbyteorder(order)).reshape(6, -1)
    data = b"".join(row.tobytes() + bytes(padding) for row in rows)
    image = messages.make(
        "sensor_msgs/msg/Image",
        header=messages.header(T0 + 5, "camera"),
        height=6,
        width=8,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows[0].nbytes + padding,
        data=np.frombuffer(data, np.uint8),
    )
    record = only(tmp_path, messages, image, "sensor_msgs/msg/Image")
    assert (record.stamp, record.frame, record.encoded) == (T0 + 5, "camera", None)
    assert record.pixels.dtype == expected.dtype
    assert np.array_equal(record.pixels, expected)


def flat(messages, encoding, stored, width):
    return messages.make(
        "sensor_msgs/msg/Image",
        header=messages.header(T0),
        height=len(stored),
        width=width,
        encoding=encoding,
        step=stored[0].nbytes,
        data=np.frombuffer(stored.tobytes(), np.uint8),
    )


@pytest.mark.parametrize(
    ("pattern", "at"),
    [("rggb", (0, 1, 1, 2)), ("bggr", (2, 1, 1, 0)), ("gbrg", (1, 2, 0, 1)), ("grbg", (1, 0, 2, 1))],
)
def test_bayer_images_have_their_colors(pattern, at, messages, tmp_path):
    color = np.array([200, 100, 30], np.uint8)
    mosaic = np.tile(color[list(at)].reshape(2, 2), (8, 8))
    record = only(
        tmp_path, messages, flat(messages, f"bayer_{pattern}8", mosaic, 16), "sensor_msgs/msg/Image"
    )
    assert (record.pixels == color).all()


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_yuv_images_have_their_colors(encoding, order, messages, tmp_path):
    y, u, v = 120, 90, 180
    bright = 1.164 * (y - 16)  # ITU-R BT.601, of 16 to 235
    rgb = (
        bright + 1.596 * (v - 128),
        bright - 0.813 * (v - 128) - 0.391 * (u - 128),
        bright + 2.018 * (u - 128),
    )
    four = [{"y": y, "u": u, "v": v}[letter] for letter in order]
    stored = np.tile(np.array(four, np.uint8), (4, 3))
    record = only(tmp_path, messages, flat(messages, encoding, stored, 6), "sensor_msgs/msg/Image")
    assert np.abs(record.pixels - np.array(rgb)).max() < 1.5


@pytest.mark.parametrize(
    ("encoding", "said"),
    [
        ("16UC1", "a depth image (16UC1): use a topic of color or gray images"),
        ("32FC1", "a depth image"),
        ("nv12", "an encoding that is not known, 'nv12'"),
        ("rgb8", "its pixels are more than its bytes"),
    ],
)
def test_images_that_are_refused_say_why(encoding, said, messages, tmp_path):
    image = flat(messages, encoding, PIXELS[..., 0], 8)
    assert said in why(tmp_path, messages, image, "sensor_msgs/msg/Image")


@pytest.mark.parametrize(("suffix", "form"), [(".jpg", "rgb8; jpeg compressed bgr8"), (".png", "png")])
def test_files_in_compressed_images_are_kept_as_they_are(suffix, form, messages, tmp_path):
    content = cv2.imencode(suffix, PIXELS)[1]
    message = messages.make(
        "sensor_msgs/msg/CompressedImage", header=messages.header(T0), format=form, data=content.reshape(-1)
    )
    record = only(tmp_path, messages, message, "sensor_msgs/msg/CompressedImage")
    assert (record.encoded, record.suffix, record.pixels) == (content.tobytes(), suffix, None)


@pytest.mark.parametrize(
    ("form", "content", "said"),
    [
        ("16UC1; compressedDepth png", b"\0" * 12 + b"\x89PNG", "a depth image (compressedDepth)"),
        ("bayer_rggb8; jpeg compressed ", b"\xff\xd8\xff", "a Bayer mosaic"),
        ("h264", b"\0\0\0\1", "neither a JPEG nor a PNG, format 'h264'"),
    ],
)
def test_compressed_images_that_are_refused_say_why(form, content, said, messages, tmp_path):
    data = np.frombuffer(content, np.uint8)
    message = messages.make(
        "sensor_msgs/msg/CompressedImage", header=messages.header(T0), format=form, data=data
    )
    assert said in why(tmp_path, messages, message, "sensor_msgs/msg/CompressedImage")


def info(
    messages, model="plumb_bob", coefficients=(0.1, -0.2, 0.01, 0.02, 0.0), roi=(0, 0, 0, 0), binning=(0, 0)
):
    region = messages.make(
        "sensor_msgs/msg/RegionOfInterest", **dict(zip(("x_offset", "y_offset", "width", "height"), roi))
    )
    return messages.make(
        "sensor_msgs/msg/CameraInfo",
        header=messages.header(T0, "camera"),
        width=640,
        height=480,
        distortion_model=model,
        d=np.array(coefficients, float),
        k=np.array([400.0, 0, 319.5, 0, 400.0, 239.5, 0, 0, 1]),
        p=np.array([380.0, 0, 310.0, 0, 0, 381.0, 230.0, 0, 0, 0, 1, 0]),
        binning_x=binning[0],
        binning_y=binning[1],
        roi=region,
    )


KIND = "sensor_msgs/msg/CameraInfo"


@pytest.mark.parametrize(
    ("model", "coefficients", "lens", "expected"),
    [
        ("plumb_bob", (0.1, -0.2, 0.01, 0.02, 0.3), Lens.RADIAL_TANGENTIAL, (0.1, -0.2, 0.01, 0.02, 0.3)),
        ("plumb_bob", (0.1, -0.2, 0.01, 0.02), Lens.RADIAL_TANGENTIAL, (0.1, -0.2, 0.01, 0.02)),
        ("plumb_bob", (), Lens.RADIAL_TANGENTIAL, (0, 0, 0, 0)),
        ("rational_polynomial", tuple(range(1, 9)), Lens.RADIAL_TANGENTIAL, tuple(range(1, 9))),
        ("rational_polynomial", (*range(1, 9), 0, 0, 0, 0), Lens.RADIAL_TANGENTIAL, tuple(range(1, 9))),
        ("equidistant", (0.1, 0.2, 0.3, 0.4), Lens.EQUIDISTANT, (0.1, 0.2, 0.3, 0.4)),
    ],
)
def test_camera_infos(model, coefficients, lens, expected, messages, tmp_path):
    record = only(tmp_path, messages, info(messages, model, coefficients), KIND)
    assert record.camera == Camera(
        width=640, height=480, fx=400, fy=400, cx=319.5, cy=239.5, distortion=expected, lens=lens
    )


def test_camera_info_with_an_empty_matrix_has_no_camera(messages, tmp_path):
    empty = info(messages)
    setattr(empty, "K" if messages.ros == 1 else "k", np.zeros(9))
    assert only(tmp_path, messages, empty, KIND).camera is None


def test_region_and_binning_of_a_camera_info_are_counted_in(messages, tmp_path):
    record = only(tmp_path, messages, info(messages, roi=(20, 40, 600, 400), binning=(2, 4)), KIND)
    camera = record.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (300, 100, 200, 100)
    assert np.isclose(camera.cx, (319.5 - 20 + 0.5) / 2 - 0.5)
    assert np.isclose(camera.cy, (239.5 - 40 + 0.5) / 4 - 0.5)


@pytest.mark.parametrize(
    ("model", "coefficients", "said"),
    [
        ("thin_prism", (1.0,), "a lens of the model 'thin_prism'"),
        ("rational_polynomial", (*range(1, 9), 1, 0, 0, 0), "a lens with 12 coefficients"),
        ("equidistant", (0.1, 0.2), "a fisheye with 2 coefficients"),
        ("plumb_bob", (np.nan,) * 5, "its distortion has values that are not finite numbers"),
    ],
)
def test_lenses_that_are_not_known_say_so(model, coefficients, said, messages, tmp_path):
    assert said in why(tmp_path, messages, info(messages, model, coefficients), KIND)


@pytest.mark.parametrize(
    ("image", "width"),
    [
        ("/camera/image_rect_color", 380.0),
        ("/camera/image_undistorted", 380.0),
        ("/camera/image_raw", 400.0),
    ],
)
def test_rectified_images_go_with_the_projection_and_have_no_distortion(image, width, messages, tmp_path):
    picture = flat(messages, "mono8", PIXELS[..., 0], 8)
    topics = {
        "/camera/camera_info": (KIND, [(T0, info(messages))]),
        image: ("sensor_msgs/msg/Image", [(T0 + 1, picture)]),
    }
    container = "bag" if messages.ros == 1 else "mcap"
    source = open_source(write(tmp_path / "a.bag", container, topics, messages))
    [(_, record), _] = source.records(set(topics))
    assert record.camera.fx == width
    assert record.rectified == record.camera.is_pinhole == (width == 380.0)
    # the other one is kept: names may be wrong
    assert record.other.fx == 780.0 - width
    assert record.other.is_pinhole == (width == 400.0)


def test_a_camera_info_of_one_camera_has_no_other(messages, tmp_path):
    values = info(messages, coefficients=(0.0,) * 5)
    field = "P" if hasattr(values, "P") else "p"
    same = replace(values, **{field: np.array([400.0, 0, 319.5, 0, 0, 400.0, 239.5, 0, 0, 0, 1, 0])})
    record = only(tmp_path, messages, same, KIND)
    assert record.camera.fx == 400.0
    assert record.other is None


def test_transforms_poses_and_paths(messages, tmp_path):
    turn = np.array([0.1, 0.2, 0.3, 0.9])
    turn /= np.linalg.norm(turn)
    truth = geometry.from_quaternion_translation(turn, np.array([1.0, 2.0, 3.0]))
    move = messages.make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    rotation = messages.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, 3 * turn))))
    transform = messages.make("geometry_msgs/msg/Transform", translation=move, rotation=rotation)
    stamped = messages.make(
        "geometry_msgs/msg/TransformStamped",
        header=messages.header(T0, "/lidar"),
        child_frame_id="camera",
        transform=transform,
    )
    trees = messages.make("tf2_msgs/msg/TFMessage", transforms=[stamped, stamped])
    pose = messages.pose((1, 2, 3), turn)
    poses = [
        messages.make("geometry_msgs/msg/PoseStamped", header=messages.header(T0 + i), pose=pose)
        for i in range(3)
    ]
    covariance = messages.make("geometry_msgs/msg/PoseWithCovariance", pose=pose)
    topics = {
        "/tf_static": ("tf2_msgs/msg/TFMessage", [(T0, trees)]),
        "/vicon": ("geometry_msgs/msg/TransformStamped", [(T0 + 1, stamped)]),
        "/pose": ("geometry_msgs/msg/PoseStamped", [(T0 + 2, poses[0])]),
        "/amcl": (
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            [
                (
                    T0 + 3,
                    messages.make(
                        "geometry_msgs/msg/PoseWithCovarianceStamped",
                        header=messages.header(T0),
                        pose=covariance,
                    ),
                )
            ],
        ),
        "/path": (
            "nav_msgs/msg/Path",
            [(T0 + 4, messages.make("nav_msgs/msg/Path", header=messages.header(T0, "map"), poses=poses))],
        ),
    }
    container = "bag" if messages.ros == 1 else "mcap"
    source = open_source(write(tmp_path / "a.bag", container, topics, messages))
    records = [record for _, record in source.records(set(topics))]
    assert len(records) == 6
    for record in records[:5]:
        assert np.allclose(record.parent_from_child, truth)
    assert (records[0].parent, records[0].child, records[0].static) == ("lidar", "camera", True)
    assert (records[2].parent, records[2].child) == ("lidar", "camera")
    assert records[5].times.tolist() == [T0, T0 + 1, T0 + 2]
    assert np.allclose(records[5].parent_from_child, truth)


def test_lost_messages_are_counted_by_reason_and_the_others_read(messages, tmp_path):
    kind = "geometry_msgs/msg/PoseStamped"
    good = [
        messages.make(kind, header=messages.header(T0 + i), pose=messages.pose((i, 0, 0), (0, 0, 0, 1)))
        for i in range(5)
    ]
    zero = messages.make(kind, header=messages.header(T0), pose=messages.pose((0, 0, 0), (0, 0, 0, 0)))
    nan = messages.make(kind, header=messages.header(T0), pose=messages.pose((np.nan, 0, 0), (0, 0, 0, 1)))
    short = messages.raw(good[0], kind)[:-9]
    unstamped = messages.make(kind, header=messages.header(0), pose=messages.pose((9, 0, 0), (0, 0, 0, 1)))
    source = source_of(tmp_path, messages, [zero, *good, nan, short, unstamped], kind)
    records = [record for _, record in source.records({"/a"})]
    assert [record.parent_from_child[0, 3] for record in records] == [0, 1, 2, 3, 4, 9]
    assert records[-1].stamp == T0 + 8
    assert source.losses() == (
        "/a: 2 of 9 messages are lost: a pose of it has no orientation, or values that are not finite numbers",
        "/a: 1 of 9 messages are lost: it is shorter than its type",
        "/a: 1 messages have no stamp; the time of recording is taken",
    )


def test_negative_stamps_of_ros_2_are_kept(tmp_path):
    messages = Messages(2)
    kind = "geometry_msgs/msg/PoseStamped"
    message = messages.make(
        kind, header=messages.header(-3 * SECOND // 2), pose=messages.pose((0, 0, 0), (0, 0, 0, 1))
    )
    assert only(tmp_path, messages, message, kind).stamp == -3 * SECOND // 2


def test_raw_packets_and_other_messages_say_what_to_do(messages, tmp_path):
    source = source_of(tmp_path, messages, [messages.make("std_msgs/msg/String")], "std_msgs/msg/String")
    with pytest.raises(InputError, match=r"/a has messages that are not read \(std_msgs/msg/String\)"):
        list(source.records({"/a"}))
    extra = {"pandar_msgs/msg/PandarScan": "std_msgs/Header header"}
    messages = Messages(messages.ros, typestore(messages.ros, extra=extra))
    (tmp_path / "b").mkdir()
    scan = messages.make("pandar_msgs/msg/PandarScan", header=messages.header(T0))
    source = source_of(tmp_path / "b", messages, [scan], "pandar_msgs/msg/PandarScan")
    said = r"/a has raw packets .*, which are not read.* HesaiLidar_General_ROS, and record /hesai/pandar"
    with pytest.raises(InputError, match=said):
        list(source.records({"/a"}))
    for options in (ImportOptions(), ImportOptions(lidar="/a"), ImportOptions(odometry="auto")):
        with pytest.raises(InputError, match=said):
            import_source(source, tmp_path / "out", options)
    [missing, *_] = inspect(source).missing
    assert "/a has raw packets" in missing
    assert "record /hesai/pandar (sensor_msgs/PointCloud2)" in missing


@pytest.mark.parametrize("name", sorted(packets.DRIVERS))
def test_the_driver_of_each_kind_of_packets_is_named(name):
    driver, topic = packets.DRIVERS[name]
    package, _, message = name.partition("/")
    for text in (name, f"{package}/msg/{message}"):
        assert driver in packets.mend(text)
        assert topic in packets.mend(text)
        is_read = package.startswith(("velodyne", "ouster"))
        assert decoders.kinds_of([Topic("/a", text, Encoding.ROS1)])["/a"] is (
            Kind.SCANS if is_read else Kind.PACKETS
        )


@pytest.mark.parametrize(
    "frames", [["map"] * 40, ["map"] * 39 + ["world"], ["a", "bb", "ccc"] * 13], ids=["one", "two", "many"]
)
def test_paths_with_frames_of_any_length(frames, messages, tmp_path):
    poses = [
        messages.make(
            "geometry_msgs/msg/PoseStamped",
            header=messages.header(T0 + 3 * i, frame),
            pose=messages.pose((i, 2, 3), (0, 0, 0, 1)),
        )
        for i, frame in enumerate(frames)
    ]
    path = messages.make("nav_msgs/msg/Path", header=messages.header(T0, "odom"), poses=poses)
    record = only(tmp_path, messages, path, "nav_msgs/msg/Path")
    assert record.times.tolist() == [T0 + 3 * i for i in range(len(frames))]
    assert record.parent_from_child[:, 0, 3].tolist() == list(range(len(frames)))
    assert np.allclose(record.parent_from_child[:, :3, :3], np.eye(3))


def test_of_several_lidars_in_one_topic_the_first_is_read(messages, tmp_path):
    kind = "livox_ros_driver2/msg/CustomMsg"
    rows = [messages.livox(T0 + i, XYZ + i, np.arange(12)) for i in range(6)]
    for i, row in enumerate(rows):
        row.lidar_id = 7 + i % 3
    source = source_of(tmp_path, messages, rows, kind)
    assert [record.stamp for _, record in source.records({"/a"})] == [T0, T0 + 3]
    assert source.losses() == (
        "/a: 4 messages of other LiDARs are left out: lidar_id 8, 9, where the first has 7",
    )
