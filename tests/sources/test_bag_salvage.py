"""What is left of bags that were cut or not closed is read, and it is said how much."""

import io
import re
import sqlite3
import struct

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from ros_bags import SECOND, T0, Messages, write
from rosbags.rosbag1 import Reader

from lvba.errors import InputError
from lvba.sources.opening import open_source

COUNT = 120
NOISE = np.random.default_rng(0).bytes(20_000).hex()


def numbered(ros, padding=3000):
    """Poses that are numbered by their x, in messages long enough to fill several chunks."""
    messages = Messages(ros)
    rows = []
    for i in range(COUNT):
        stamp = T0 + i * SECOND // 10
        pose = messages.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=messages.pose((i, 0, 0), (0, 0, 0, 1))
        )
        frame = f"{i}" + NOISE[i : i + padding]
        odometry = messages.make(
            "nav_msgs/msg/Odometry", header=messages.header(stamp), child_frame_id=frame, pose=pose
        )
        rows.append((stamp, odometry))
    return messages, {"/odometry": ("nav_msgs/msg/Odometry", rows)}


def numbers(source):
    return [round(record.parent_from_child[0, 3]) for _, record in source.records({"/odometry"})]


def check_prefix(path, least):
    """That the first messages are left, at least so many, and as many as are told."""
    source = open_source(path)
    description = source.describe()
    left = numbers(source)
    assert left == list(range(len(left)))
    assert len(left) >= least
    assert description.streams[0].count == len(left)
    assert any(f"{len(left)} messages are left" in note for note in description.notes)
    assert all(len(note.splitlines()) == 1 for note in description.notes)
    return source


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bags of 120 messages in chunks of about 20, by container."""
    folder = tmp_path_factory.mktemp("whole")
    found = {}
    for container in ("bag", "bag-lz4", "bag-bz2"):
        messages, topics = numbered(1, padding=20_000)
        found[container] = write(folder / f"{container}.bag", container, topics, messages).read_bytes()
    return found


def mcap_bytes(kind=CompressionType.NONE, profile="ros2", encoding="ros1", **options):
    """By the library of MCAP's authors; messages of ROS 1."""
    messages, topics = numbered(1)
    text, _ = messages.store.generate_msgdef("nav_msgs/msg/Odometry")
    content = io.BytesIO()
    writer = Writer(content, chunk_size=50_000, compression=kind, **options)
    writer.start(profile)
    schema = writer.register_schema("nav_msgs/Odometry", "ros1msg", text.encode())
    channel = writer.register_channel("/odometry", encoding, schema)
    for time, message in topics["/odometry"][1]:
        data = messages.raw(message, "nav_msgs/msg/Odometry")
        writer.add_message(channel, time, data, time)
    writer.finish()
    return content.getvalue()


@pytest.mark.parametrize("container", ["bag", "bag-lz4", "bag-bz2"])
@pytest.mark.parametrize("part", [0.5, 0.8])
def test_ros_1_bag_that_is_cut(container, part, whole, tmp_path):
    content = whole[container]
    path = tmp_path / "a.bag"
    path.write_bytes(content[: int(len(content) * part)])
    source = check_prefix(path, int(COUNT * part) - (2 if container == "bag" else 45))
    assert "has no index (it was cut, or not closed)" in source.describe().notes[0]


def test_ros_1_bag_without_index_has_all_its_messages(whole, tmp_path):
    content = whole["bag"]
    at = content.index(b"index_pos=") + len("index_pos=")
    (index,) = struct.unpack_from("<Q", content, at)
    path = tmp_path / "a.bag.active"
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 : index])
    check_prefix(path, COUNT)


def test_last_chunk_of_a_bag_that_was_not_closed_is_read_though_its_length_is_not_written(whole, tmp_path):
    content = whole["bag"]
    path = tmp_path / "a.bag"
    path.write_bytes(content)
    with Reader(path) as reader:
        last = reader.chunks[max(reader.chunks)]
        before = sum(info.connection_counts[0] for info in reader.chunk_infos[:-1])
    head = bytearray(content[: last.datapos])
    head[-4:] = bytes(4)
    size = head.rindex(b"size=") + len("size=")
    head[size : size + 4] = bytes(4)
    at = head.index(b"index_pos=") + len("index_pos=")
    head[at : at + 8] = bytes(8)
    (tmp_path / "b.bag").write_bytes(bytes(head) + content[last.datapos : last.datapos + last.datasize])
    assert before < COUNT
    check_prefix(tmp_path / "b.bag", COUNT)


def test_damaged_chunk_loses_its_own_messages_only(whole, tmp_path):
    content = bytearray(whole["bag-lz4"])
    path = tmp_path / "a.bag"
    path.write_bytes(content)
    with Reader(path) as reader:
        chunk = sorted(reader.chunks.items())[0][1]
        chunks = len(reader.chunks)
    content[chunk.datapos : chunk.datapos + chunk.datasize] = bytes(chunk.datasize)
    path.write_bytes(content)
    source = open_source(path)
    left = numbers(source)
    assert left == list(range(left[0], COUNT)) if left else chunks == 1
    assert any("chunk cannot be read" in sentence for sentence in source.losses())


@pytest.mark.parametrize("kind", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("profile", ["ros1", "", "ros2"])
def test_mcap_of_any_profile(kind, profile, tmp_path):
    (tmp_path / "a.mcap").write_bytes(mcap_bytes(kind, profile))
    source = open_source(tmp_path / "a.mcap")
    [stream] = source.describe().streams
    assert (stream.count, stream.first, stream.last) == (COUNT, T0, T0 + (COUNT - 1) * SECOND // 10)
    assert numbers(source) == list(range(COUNT))
    assert source.describe().notes == ()


@pytest.mark.parametrize("kind", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("part", [0.4, 0.8, 0.999])
def test_mcap_that_is_cut(kind, part, tmp_path):
    content = mcap_bytes(kind)
    (tmp_path / "a.mcap").write_bytes(content[: int(len(content) * part)])
    source = check_prefix(tmp_path / "a.mcap", int(COUNT * part * 0.5))
    assert "has no summary" in source.describe().notes[0]


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
)
def test_mcap_with_less_than_usual(options, tmp_path):
    from mcap.writer import IndexType

    (tmp_path / "a.mcap").write_bytes(mcap_bytes(index_types=IndexType.NONE, **options))
    source = open_source(tmp_path / "a.mcap")
    assert numbers(source) == list(range(COUNT))
    assert source.describe().streams[0].count in (COUNT, None)


@pytest.mark.parametrize("place", [2**63, 2**64 - 1, 2**62])
def test_mcap_whose_summary_names_places_that_no_file_has_is_read_without_it(place, tmp_path):
    from mcap.reader import make_reader

    content = bytearray(mcap_bytes())
    [(channel, at), *_] = (
        make_reader(io.BytesIO(content)).get_summary().chunk_indexes[0].message_index_offsets.items()
    )
    number = content.rindex(struct.pack("<HQ", channel, at))
    content[number : number + 10] = struct.pack("<HQ", channel, place)
    (tmp_path / "a.mcap").write_bytes(content)
    source = open_source(tmp_path / "a.mcap")
    assert source.describe().streams[0].count == COUNT
    assert numbers(source) == list(range(COUNT))


def test_checksum_of_a_chunk_that_is_wrong_is_told(tmp_path):
    content = bytearray(mcap_bytes())
    content[content.index(NOISE[200:300].encode())] ^= 1
    (tmp_path / "a.mcap").write_bytes(content)
    source = open_source(tmp_path / "a.mcap")
    assert numbers(source) == list(range(COUNT))
    assert "the checksum of a chunk is wrong" in source.losses()[0]


def sqlite_bag(folder, topics, messages):
    """The bare file, as ROS 2 Humble and older leave it: without definitions."""
    [path] = write(folder / "a", "sqlite3", topics, messages).glob("*.db3")
    database = sqlite3.connect(path)
    database.execute("DROP TABLE message_definitions")
    database.commit()
    database.close()
    return path.rename(folder / "b.db3")


def test_sqlite_without_definitions_is_read_by_the_known_ones(tmp_path):
    messages = Messages(2)
    points, offsets = np.arange(30, dtype=np.float32).reshape(10, 3), np.arange(10) * 1000
    topics = {"/livox": ("livox_ros_driver2/msg/CustomMsg", [(T0, messages.livox(T0, points, offsets))])}
    source = open_source(sqlite_bag(tmp_path, topics, messages))
    [(_, scan)] = source.records({"/livox"})
    assert np.array_equal(scan.points, points)
    assert np.array_equal(scan.times, offsets)


def test_sqlite_that_is_cut_gives_its_first_messages(tmp_path):
    messages, topics = numbered(2)
    path = sqlite_bag(tmp_path, topics, messages)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 // 4096 * 4096])
    source = open_source(path)
    left = numbers(source)
    assert left == list(range(len(left)))
    assert len(left) > COUNT // 4
    assert any("the rest of the file is lost" in sentence for sentence in source.losses())


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.bag", b"", "is no ROS 1 bag of version 2.0"),
        ("a.bag", b"#ROSBAG V1.2\n" + bytes(100), "is no ROS 1 bag of version 2.0"),
        ("a.bag", b"#ROSBAG V2.0\n", "its first record is damaged"),
        ("a.mcap", b"", "is no MCAP file"),
        ("a.mcap", b"\x89MCAP0\r\n", "is cut before its first messages"),
        ("a.db3", b"", "has no tables"),
        ("a.db3", b"SQLite format 3\0" + bytes(100), "is damaged or no SQLite file"),
    ],
)
def test_nothing_left_is_one_line_that_names_the_file(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"{re.escape(name)}: {said}"):
        open_source(tmp_path / name).describe()


def test_compressed_bag_without_the_package_names_the_extra(whole, tmp_path, monkeypatch):
    import sys

    (tmp_path / "a.bag").write_bytes(whole["bag-lz4"])
    monkeypatch.setitem(sys.modules, "lz4", None)
    with pytest.raises(InputError, match=re.escape("pip install 'lvba[bags]'")):
        list(open_source(tmp_path / "a.bag").records({"/odometry"}))
