"""Bags that lie: nothing hangs, takes memory without limit, or ends in anything but one line."""

import bz2
import resource
import sqlite3
import struct

import numpy as np
import pytest
from backports import zstd
from lz4 import frame as lz4
from ros_bags import T0, Messages, write

from lvba.errors import InputError
from lvba.sources.bags import compression
from lvba.sources.bags.compression import Damaged, Unpacker
from lvba.sources.bags.container import Encoding
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.bags.layout import decode, layout_of
from lvba.sources.opening import open_source

ZEROS = bytes(4_000_000)
PACKERS = {"bz2": bz2.compress, "lz4": lz4.compress, "zstd": zstd.compress}


def most_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("kind", PACKERS)
def test_pieces_are_unpacked_to_the_size_that_they_claim_and_no_further(kind, tmp_path):
    packed = PACKERS[kind](ZEROS)
    assert Unpacker(tmp_path).unpack(kind, packed, 1000) == bytes(1000)
    assert Unpacker(tmp_path).unpack(kind, packed, 2**40) == ZEROS
    half = Unpacker(tmp_path).unpack(
        kind, PACKERS[kind](np.random.default_rng(0).bytes(3_000_000))[:2_000_000], 2**40
    )
    assert 0 < len(half) < 2_000_000
    with pytest.raises(Damaged):
        Unpacker(tmp_path).unpack(kind, b"nothing of the kind", 1000)


def test_a_short_file_does_not_unpack_to_endless_data(tmp_path, monkeypatch):
    monkeypatch.setattr(compression, "MAX_MESSAGE", 10_000_000)
    unpacker, packed = Unpacker(tmp_path), bz2.compress(ZEROS)
    sizes = []

    def unpack_again_and_again():
        sizes.extend(len(unpacker.unpack("bz2", packed, 2**40)) for _ in range(10))

    with pytest.raises(Damaged, match="more than a thousand times its size"):
        unpack_again_and_again()
    assert sum(sizes) < 10_000_000 + 10 * 1000 * len(packed)


RULE = "=" * 80
TREE = (
    "".join(f"{RULE}\nMSG: a/T{i}\n" + f"T{i + 1} x\n" * 10 for i in range(30))
    + f"{RULE}\nMSG: a/T30\nint32 y"
)


@pytest.mark.parametrize(
    ("definition", "said"),
    [
        ("a/A inner", "nested too deep, or holds itself"),
        ("a/A[] inner", "nested too deep, or holds itself"),
        (f"T0 x\n{TREE}", "too many fields|nested too deep"),
        ("int32 x\n" * 5000, "too many fields"),
        ("uint8[99999999999] x", "more than a billion"),
        ("???", "an invalid line of its definition"),
        ("unknown/Type x", "does not define unknown/Type"),
        ("x" * 2_000_000, "a definition of 2000000 characters"),
    ],
)
def test_definitions_without_end(definition, said):
    with pytest.raises(Undecodable, match=said):
        layout_of(definition, "a/msg/A", Encoding.ROS1)


def test_types_without_fields_take_a_byte_in_ros_2():
    definition = f"E[3] a\nE b\nint32 c\n{RULE}\nMSG: a/E\nuint8 A=1"
    layout = layout_of(definition, "a/msg/A", Encoding.CDR)
    assert decode(layout, b"\0\1\0\0" + bytes(4) + struct.pack("<i", 7), Encoding.CDR)["c"] == 7
    layout = layout_of(definition, "a/msg/A", Encoding.ROS1)
    assert decode(layout, struct.pack("<i", 7), Encoding.ROS1)["c"] == 7


@pytest.mark.parametrize(
    ("definition", "data"),
    [
        ("uint8[] x", struct.pack("<I", 2**32 - 1)),
        ("string x", struct.pack("<I", 2**32 - 1)),
        ("string[] x", struct.pack("<I", 2**32 - 1)),
        ("E[] x\n" + "=" * 80 + "\nMSG: a/E\nuint8 A=1", struct.pack("<I", 2**32 - 1)),
        ("P[] x\n" + "=" * 80 + "\nMSG: a/P\nint32 a\nint8 b", struct.pack("<I", 2**32 - 1) + bytes(40)),
        ("uint8[900000000] x", bytes(10)),
        ("float64 x", bytes(7)),
    ],
)
@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_counts_and_lengths_that_lie(definition, data, encoding):
    before = most_mb()
    head = b"\0\1\0\0" if encoding is Encoding.CDR else b""
    with pytest.raises(Undecodable):
        decode(layout_of(definition, "a/msg/A", encoding), head + data, encoding)
    assert most_mb() < before + 50


def test_a_million_messages_in_a_message_are_not_listed():
    layout = layout_of("S[] x\n" + "=" * 80 + "\nMSG: a/S\nstring name", "a/msg/A", Encoding.ROS1)
    with pytest.raises(Undecodable, match="it holds 1000000 messages"):
        decode(layout, struct.pack("<I", 1_000_000) + bytes(4_000_000), Encoding.ROS1)


@pytest.mark.parametrize("twice", ["int32 a\nint32 a", "uint32 a\nint8 b\nuint32 a"])
@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_names_that_a_type_has_twice_make_no_table(twice, encoding):
    layout = layout_of(f"S[] x\n{RULE}\nMSG: a/S\nstring name\n{twice}", "a/msg/A", encoding)
    head = b"\0\1\0\0" if encoding is Encoding.CDR else b""
    values = decode(layout, head + struct.pack("<I", 3) + bytes(60), encoding, ["x"])["x"]
    assert [each["a"] for each in values] == [0, 0, 0]


def bag(tmp_path, name="a.bag"):
    messages = Messages(1)
    pose = messages.pose((1, 2, 3), (0, 0, 0, 1))
    rows = [(T0, messages.make("geometry_msgs/msg/PoseStamped", header=messages.header(T0), pose=pose))]
    return write(tmp_path / name, "bag", {"/pose": ("geometry_msgs/msg/PoseStamped", rows)}, messages)


def test_chunk_that_claims_a_terabyte(tmp_path):
    path = bag(tmp_path)
    content = bytearray(path.read_bytes())
    at = content.index(b"compression=none")
    data = content.index(struct.pack("<I", 0), at)
    position = content.index(b"size=", at - 30)
    content[position + 5 : position + 9] = b"\xff" * 4
    path.write_bytes(content)
    source = open_source(path)
    assert len(list(source.records({"/pose"}))) == 1
    assert "a chunk is cut" in source.losses()[0]
    assert data > 0


def test_damage_of_a_file_that_is_compressed_as_a_whole_names_that_file(tmp_path):
    content = bag(tmp_path).read_bytes()
    (tmp_path / "b.bag.zst").write_bytes(zstd.compress(content[:-50]))
    source = open_source(tmp_path / "b.bag.zst")
    assert source.describe().notes[0].startswith("b.bag.zst has no index")
    (tmp_path / "c.db3.zstd").write_bytes(zstd.compress(b"SQLite format 3\0" + bytes(100)))
    with pytest.raises(InputError, match=r"c\.db3\.zstd: is damaged or no SQLite file"):
        open_source(tmp_path / "c.db3.zstd").describe()
    (tmp_path / "d.mcap.zstd").write_bytes(b"no zstd")
    with pytest.raises(InputError, match=r"d\.mcap\.zstd: cannot be unpacked"):
        open_source(tmp_path / "d.mcap.zstd").describe()


def test_names_with_control_characters_stay_on_one_line(tmp_path):
    path = bag(tmp_path, "a\x1b[31m\n.bag")
    path.write_bytes(b"")
    with pytest.raises(InputError) as refused:
        open_source(path).describe()
    assert len(str(refused.value).splitlines()) == 1


def test_metadata_of_a_bag_leads_to_no_file_outside_it(tmp_path):
    (tmp_path / "bag").mkdir()
    bag(tmp_path, "secret.bag").rename(tmp_path / "secret.db3")
    (tmp_path / "bag" / "a.db3").write_bytes(b"")
    text = "rosbag2_bagfile_information:\n  relative_file_paths: [../secret.db3]\n"
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match=r"bag/secret\.db3: is named in metadata\.yaml, and missing"):
        open_source(tmp_path / "bag")


@pytest.mark.parametrize(
    "statements",
    [
        "CREATE TABLE topics (id, name, type, serialization_format); CREATE VIEW messages AS WITH RECURSIVE c(x) AS "
        "(SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM c",
        "CREATE TABLE topics (id, name, type, serialization_format); CREATE TABLE messages (id, topic_id, timestamp, "
        "data AS (zeroblob(900000000)))",
        "CREATE TABLE topics (id); CREATE TABLE messages (id)",
    ],
)
def test_tables_that_compute_or_lack_something_are_refused(statements, tmp_path):
    database = sqlite3.connect(tmp_path / "a.db3")
    database.executescript(statements)
    database.close()
    with pytest.raises(InputError):
        open_source(tmp_path / "a.db3").describe()


def test_text_where_numbers_are_expected_in_tables(tmp_path):
    database = sqlite3.connect(tmp_path / "a.db3")
    database.executescript(
        "CREATE TABLE topics (id, name, type, serialization_format);"
        "INSERT INTO topics VALUES (1, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr'), ('x', 2, 3, 4);"
        "CREATE TABLE messages (id, topic_id, timestamp, data);"
        "INSERT INTO messages VALUES (1, 1, 'soon', x'00'), (2, 1, 5, 'text'), (3, 1, 6, x'00010000')"
    )
    database.close()
    source = open_source(tmp_path / "a.db3")
    with pytest.raises(
        InputError, match="1 of 1 messages of /pose cannot be decoded: it is shorter than its type"
    ):
        list(source.records({"/pose"}))
    assert source.losses()[0] == "a.db3: a row has no time or no bytes (2 times)"
