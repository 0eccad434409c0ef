import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lvba.errors import InputError
from lvba.io import pcd

ENCODINGS = ("ascii", "binary", "binary_compressed")


def _points(count: int = 100, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 20, (count, 3)).astype(np.float32)


def _header(fields: str, size: str, kind: str, count: str, points: int, data: str) -> bytes:
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("with_intensity", [False, True])
@pytest.mark.parametrize("with_time", [False, True])
def test_what_was_written_comes_back_exactly(
    tmp_path: Path, encoding: str, with_intensity: bool, with_time: bool
):
    points = _points()
    intensity = np.linspace(0, 1, 100, dtype=np.float32) / 3 if with_intensity else None
    time = 1630577758.0 + np.arange(100) * 1e-5 if with_time else None
    pcd.write_pcd(tmp_path / "a.pcd", points, intensity, time, encoding)
    scan = pcd.read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(scan.points, points)
    for found, expected in ((scan.intensity, intensity), (scan.time, time)):
        if expected is None:
            assert found is None
        else:
            np.testing.assert_array_equal(found, expected)
    assert scan.points.dtype == np.float32
    assert scan.points.flags["C_CONTIGUOUS"]
    assert scan.points.flags["WRITEABLE"]
    assert pcd.check_pcd(tmp_path / "a.pcd") == 100


@given(
    st.lists(st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3), min_size=1, max_size=20),
    st.sampled_from(ENCODINGS),
)
@settings(deadline=None, max_examples=40)
def test_any_finite_points_come_back_exactly(tmp_path_factory, rows, encoding):
    path = tmp_path_factory.mktemp("any") / "a.pcd"
    points = np.array([(1.0, 2.0, 3.0), *rows], np.float32)
    pcd.write_pcd(path, points, encoding=encoding)
    measured = points[np.abs(points).max(axis=1) >= np.float32(1e-3)]
    np.testing.assert_array_equal(pcd.read_pcd(path).points, measured)


def test_any_order_and_type_of_fields(tmp_path: Path):
    """Padding, counts above one, integers and doubles before, between and behind the position."""
    dtype = np.dtype(
        [
            ("ring", "<u2"),
            ("z", "<f8"),
            ("fpfh", "<f4", (3,)),
            ("x", "<i4"),
            ("t", "<u8"),
            ("y", "<f4"),
            ("intensity", "u1"),
        ]
    )
    table = np.zeros(50, dtype)
    rng = np.random.default_rng(1)
    table["x"], table["y"], table["z"] = rng.integers(-9, 9, 50), rng.normal(size=50), rng.normal(size=50)
    table["fpfh"], table["ring"] = 7.5, 3
    table["t"], table["intensity"] = 10**15 + np.arange(50), np.arange(50)
    head = ("ring z fpfh x t y intensity", "2 8 4 4 8 4 1", "U F F I U F U", "1 1 3 1 1 1 1", 50)
    (tmp_path / "b.pcd").write_bytes(_header(*head, "binary") + table.tobytes())
    rows = [
        " ".join(str(v) for v in np.hstack([np.ravel(item) for item in row.tolist()]).tolist())
        for row in table
    ]
    (tmp_path / "a.pcd").write_bytes(_header(*head, "ascii") + "\n".join(rows).encode())
    columns = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in dtype.names)
    packed = b"".join(
        bytes([len(part) - 1]) + part for part in (columns[i : i + 32] for i in range(0, len(columns), 32))
    )
    (tmp_path / "c.pcd").write_bytes(
        _header(*head, "binary_compressed") + struct.pack("<II", len(packed), len(columns)) + packed
    )
    expected = np.stack([table["x"], table["y"], table["z"]], axis=1).astype(np.float32)
    for name in ("a.pcd", "b.pcd", "c.pcd"):
        scan = pcd.read_pcd(tmp_path / name)
        np.testing.assert_allclose(scan.points, expected, rtol=1e-6)
        np.testing.assert_array_equal(scan.intensity, np.arange(50))
        np.testing.assert_array_equal(scan.time, 10**15 + np.arange(50))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_points_without_a_finite_position_are_dropped_with_their_values(tmp_path: Path, encoding: str):
    points = _points()
    points[3, 1], points[10, 0], points[99, 2] = np.nan, np.inf, 1e9
    pcd.write_pcd(tmp_path / "a.pcd", points, np.arange(100), np.arange(100), encoding)
    scan = pcd.read_pcd(tmp_path / "a.pcd")
    keep = np.delete(np.arange(100), [3, 10, 99])
    np.testing.assert_array_equal(scan.points, points[keep])
    np.testing.assert_array_equal(scan.intensity, keep)
    np.testing.assert_array_equal(scan.time, keep)
    assert scan.dropped == 3


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_points_at_zero_are_no_returns_and_are_dropped_with_their_values(tmp_path: Path, encoding: str):
    points = _points()
    points[::2] = 0
    points[1] = 0, 0, 0.002
    pcd.write_pcd(tmp_path / "a.pcd", points, np.arange(100), np.arange(100), encoding)
    scan = pcd.read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(scan.points, points[1::2])
    np.testing.assert_array_equal(scan.intensity, np.arange(1, 100, 2))
    np.testing.assert_array_equal(scan.time, np.arange(1, 100, 2))
    assert scan.dropped == 50


def test_a_scan_of_zeros_is_refused_by_its_bytes_and_a_plane_across_the_origin_is_not(tmp_path: Path):
    pcd.write_pcd(tmp_path / "a.pcd", np.zeros((5000, 3)))
    for refuse in (pcd.read_pcd, lambda path: pcd.check_pcd(path, path.read_bytes())):
        with pytest.raises(InputError, match=r"none of its 5000 points .* other than the sensor's own"):
            refuse(tmp_path / "a.pcd")
    plane = _points() * np.float32([0, 1, 1])
    pcd.write_pcd(tmp_path / "b.pcd", plane)
    assert pcd.check_pcd(tmp_path / "b.pcd", (tmp_path / "b.pcd").read_bytes()) == 100
    np.testing.assert_array_equal(pcd.read_pcd(tmp_path / "b.pcd").points, plane)


def test_names_of_fields_that_are_not_clear_are_no_time(tmp_path: Path):
    table = np.ones(4, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("normal_x", "<f4"), ("curvature", "<f4")])
    head = _header("x y z normal_x curvature", "4 4 4 4 4", "F F F F F", "1 1 1 1 1", 4, "binary")
    (tmp_path / "a.pcd").write_bytes(head + table.tobytes())
    scan = pcd.read_pcd(tmp_path / "a.pcd")
    assert scan.time is None
    assert scan.intensity is None


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"time_offset_ns": ("<i4", 7 * np.arange(4))}, 7 * np.arange(4)),
        ({"point_time_offset": ("<f4", np.arange(4) / 8)}, np.arange(4) / 8),
        (
            {"timestampSec": ("<u4", 5), "timestampNsec": ("<u4", 9 + np.arange(4))},
            5_000_000_009 + np.arange(4),
        ),
    ],
)
def test_times_of_other_names_are_read(tmp_path: Path, fields: dict, expected: np.ndarray):
    table = np.zeros(
        4, [*((axis, "<f4") for axis in "xyz"), *((name, kind) for name, (kind, _) in fields.items())]
    )
    table["x"] = 1
    for name, (_, values) in fields.items():
        table[name] = values
    kinds = [table.dtype[name] for name in table.dtype.names]
    letters = " ".join({"f": "F", "i": "I", "u": "U"}[kind.kind] for kind in kinds)
    sizes = " ".join(str(kind.itemsize) for kind in kinds)
    head = _header(" ".join(table.dtype.names), sizes, letters, " ".join("1" for _ in kinds), 4, "binary")
    (tmp_path / "a.pcd").write_bytes(head + table.tobytes())
    np.testing.assert_array_equal(pcd.read_pcd(tmp_path / "a.pcd").time, expected)


def test_an_organized_cloud_and_one_without_points_line(tmp_path: Path):
    head = b"VERSION 0.6\nCOLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 5\nHEIGHT 2\nDATA binary\r\n"
    points = _points(10)
    (tmp_path / "a.pcd").write_bytes(head + points.tobytes())
    np.testing.assert_array_equal(pcd.read_pcd(tmp_path / "a.pcd").points, points)


def test_zeros_behind_the_data_are_padding_other_bytes_are_a_lie(tmp_path: Path):
    pcd.write_pcd(tmp_path / "a.pcd", _points(10))
    content = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(content + bytes(4096))
    assert len(pcd.read_pcd(tmp_path / "a.pcd")) == 10
    (tmp_path / "a.pcd").write_bytes(content + b"\1" * 24)
    with pytest.raises(InputError, match="says 10 points, the file holds 12"):
        pcd.read_pcd(tmp_path / "a.pcd")


def test_open3d_writes_what_we_read_and_reads_what_we_write(tmp_path: Path):
    o3d = pytest.importorskip("open3d")
    points = _points(2000)
    points[:500] = np.round(points[:500])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    for ascii_text, compressed in ((False, False), (True, False), (False, True)):
        path = str(tmp_path / "theirs.pcd")
        o3d.io.write_point_cloud(path, cloud, write_ascii=ascii_text, compressed=compressed)
        np.testing.assert_allclose(pcd.read_pcd(path).points, points, atol=1e-5)
    for encoding in ENCODINGS:
        path = str(tmp_path / "ours.pcd")
        pcd.write_pcd(path, points, encoding=encoding)
        np.testing.assert_array_equal(np.asarray(o3d.io.read_point_cloud(path).points, np.float32), points)


_GOOD = _header("x y z", "4 4 4", "F F F", "1 1 1", 10, "binary")
_DATA = _points(10).tobytes()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "no PCD header"),
        (b"not a pcd at all\n" * 9, "no PCD header"),
        (_GOOD.replace(b"FIELDS x y z", b"FIELDS x y"), "SIZE has 3 entries instead of 2"),
        (_GOOD.replace(b"FIELDS x y z\n", b""), "no FIELDS"),
        (_GOOD.replace(b"FIELDS x y z", b"FIELDS x y y") + _DATA, "needs one field"),
        (_GOOD.replace(b"FIELDS x y z", b"FIELDS a b c") + _DATA, "needs one field 'x'"),
        (_GOOD.replace(b"TYPE F F F", b"TYPE F F Q") + _DATA, "TYPE Q and SIZE 4"),
        (_GOOD.replace(b"SIZE 4 4 4", b"SIZE 4 4 3") + _DATA, "TYPE F and SIZE 3"),
        (_GOOD.replace(b"SIZE 4 4 4", b"SIZE 4 4 -4") + _DATA, "'-4', not a count"),
        (_GOOD.replace(b"COUNT 1 1 1", b"COUNT 1 1 999999999") + _DATA, "bytes per point"),
        (_GOOD.replace(b"COUNT 1 1 1", b"COUNT 1 1 0") + _DATA, "needs one field 'z'"),
        (_GOOD.replace(b"POINTS 10", b"POINTS 11") + _DATA, "contradicts itself"),
        (_GOOD.replace(b"POINTS 10", b"POINTS 1e9") + _DATA, "'1e9', not a count"),
        (_GOOD.replace(b" 10\n", b" 999999999999999999\n") + _DATA, "truncated"),
        (_GOOD.replace(b" 10\n", b" 99999999999999999999999999\n") + _DATA, "not a count"),
        (_GOOD.replace(b" 10\n", b" 0\n"), "empty scan"),
        (_GOOD.replace(b" 10\n", b" 9\n") + _DATA, "says 9 points, the file holds 10"),
        (_GOOD.replace(b"DATA binary", b"DATA zip") + _DATA, "DATA is 'zip'"),
        (_GOOD + _DATA[:-1], "truncated: 10 points need 120 bytes of data, the file holds 119"),
        (_GOOD, "truncated"),
        (_GOOD + np.full((10, 3), np.nan, "<f4").tobytes(), "none of its 10 points"),
        (_GOOD.replace(b"binary", b"ascii") + b"1.0 2.0 3.0\n" * 9, "says 10 points, the file holds 9"),
        (_GOOD.replace(b"binary", b"ascii") + b"1 2 3\n" * 11, "says 10 points, the file holds 11"),
        (_GOOD.replace(b"binary", b"ascii") + b"1 2 3\n" * 8 + b"1 2\n3 4 5 6", ":20: 2 values instead of 3"),
        (_GOOD.replace(b"binary", b"ascii") + b"1 2 3\n" * 9 + b"1 2 x", ":21: 'x' is no number"),
        (_GOOD.replace(b"binary", b"binary_compressed") + b"\xff\xff\xff\xff\x78\0\0\0" + _DATA, "truncated"),
        (_GOOD.replace(b"binary", b"binary_compressed") + b"\x10\0\0\0\xff\xff\xff\xff" + _DATA, "need 120 bytes"),
        (_GOOD.replace(b"binary", b"binary_compressed") + b"\x40\0\0\0\x78\0\0\0" + b"\xff" * 90, "damaged"),
    ],
)  # fmt: skip
def test_bad_files_are_named_with_what_is_wrong(tmp_path: Path, content: bytes, problem: str):
    path = tmp_path / "bad.pcd"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        pcd.read_pcd(path)
    assert problem in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("data", ENCODINGS)
@pytest.mark.parametrize("points", [300_000_000, 10**12])
def test_a_header_alone_cannot_make_a_big_allocation(tmp_path: Path, data: str, points: int):
    """Refused by comparing numbers, before any array is made; also where all numbers agree."""
    plain = min(12 * points, 2**32 - 1)
    content = (
        _header("x y z", "4 4 4", "F F F", "1 1 1", points, data) + struct.pack("<II", 60, plain) + bytes(60)
    )
    (tmp_path / "bomb.pcd").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            pcd.read_pcd(tmp_path / "bomb.pcd")
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
