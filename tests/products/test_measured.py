"""LAZ of a result: when points were measured, by which scan, how strong the echo was, and what the coordinates are of."""

import json

import numpy as np
import pytest

from lvba import geometry
from lvba.errors import InputError
from lvba.io import pcd, ply, tum
from lvba.products import measured
from lvba.products.export import export
from lvba.trajectory import Trajectory

laspy = pytest.importorskip("laspy")

WKT = 'PROJCS["ETRS89 / UTM zone 33N",GEOGCS["ETRS89",DATUM["D",SPHEROID["GRS 1980",6378137,298.257222101]]]]'
START = 1_700_000_000.0
OFFSET = np.array([400_000.25, 5_800_000.5, 40.0])


def make_result(root, start=START, strength=1.0, times=None):
    """A recording of three scans far from zero, and a result with every fifth point of them, in any order."""
    rng = np.random.default_rng(3)
    recording, out = root / "recording", root / "result"
    (recording / "all_pcd_body").mkdir(parents=True)
    out.mkdir()
    stamps = start + np.array([0.0, 0.125, 0.25])
    poses = geometry.exp(rng.normal(0, 0.3, (3, 6)))
    poses[:, :3, 3] += OFFSET
    rows = []
    for index, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        points = rng.uniform(-20, 20, (400, 3)).astype(np.float32)
        intensity = strength * rng.integers(1, 255, 400)
        time = None if times is None else times(stamp, 400)
        pcd.write_pcd(recording / "all_pcd_body" / f"{stamp:.6f}.pcd", points, intensity, time)
        kept = rng.choice(400, 80, replace=False)
        moved = geometry.transform_points(pose, points[kept])
        exact = np.full(80, stamp) if time is None else time[kept]
        rows += [(*p, index, i, t) for p, i, t in zip(moved, intensity[kept], exact, strict=True)]
    table = np.array(rows)[rng.permutation(240)]
    for path in (recording / "all_pcd_body" / "lidar_poses.txt", out / "lidar_poses.txt"):
        tum.write_trajectory(path, Trajectory(stamps, poses))
    colors = {name: np.full(240, 90, np.uint8) for name in ("red", "green", "blue", "views")}
    axes = dict(zip("xyz", table[:, :3].T, strict=True))
    ply.write_ply(out / "map.ply", axes | colors | {"scan": table[:, 3].astype(np.uint16)})
    (out / "report.json").write_text(json.dumps({"dataset": {"path": str(recording)}}))
    return out, table


def test_points_keep_time_scan_and_intensity(tmp_path):
    out, table = make_result(tmp_path)
    las = laspy.read(export(out, "laz", crs=WKT))
    assert las.header.global_encoding.wkt
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    [vlr] = [vlr for vlr in las.header.vlrs if vlr.record_id == 2112]
    assert vlr.string == WKT
    np.testing.assert_array_equal(las.point_source_id, table[:, 3] + 1)
    np.testing.assert_array_equal(las["scan"], table[:, 3])
    np.testing.assert_array_equal(las.intensity, table[:, 4])
    # 2023-11-14: GPS is 18 s ahead of UTC, and its zero is 1980-01-06
    np.testing.assert_allclose(las.gps_time, table[:, 5] - 315_964_800 + 18 - 1e9, atol=1e-6)


def test_times_of_points_on_the_scan_s_clock_are_kept(tmp_path):
    out, table = make_result(tmp_path, times=lambda stamp, count: stamp - np.linspace(0, 0.1, count))
    las = laspy.read(export(out, "las"))
    assert len(np.unique(table[:, 5])) == 240
    np.testing.assert_allclose(las.gps_time, table[:, 5] - 315_964_800 + 18 - 1e9, atol=1e-6)
    assert las.header.global_encoding.wkt  # LAS 1.4 asks for the bit, also without a system
    assert not [vlr for vlr in las.header.vlrs if vlr.record_id == 2112]


def test_a_clock_of_its_own_and_intensities_up_to_one(tmp_path):
    def ticks(stamp, count):
        return np.arange(count) * 1e6  # nanoseconds since the scan began

    out, table = make_result(tmp_path, start=100.0, strength=1 / 255, times=ticks)
    las = laspy.read(export(out, "laz"))
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    np.testing.assert_allclose(las.gps_time, 100 + 0.125 * table[:, 3])
    np.testing.assert_allclose(las.intensity, table[:, 4] * 65535, atol=1)


def test_without_its_recording_the_map_is_exported_all_the_same(tmp_path, caplog):
    out, table = make_result(tmp_path)
    (tmp_path / "recording").rename(tmp_path / "moved")
    las = laspy.read(export(out, "laz"))
    assert len(las.points) == len(table)
    assert "without time, intensity and scan" in caplog.text


def test_leap_seconds():
    unix = np.array([1_136_073_599.0, 1_136_073_600.0, 1_483_228_799.0, 1_483_228_800.0])
    ahead = measured.adjusted_gps_time(unix) + 1e9 + 315_964_800 - unix
    np.testing.assert_array_equal(ahead, [13, 14, 17, 18])


def test_a_coordinate_reference_system_that_is_none(tmp_path):
    out, _ = make_result(tmp_path)
    (tmp_path / "a.prj").write_text(WKT + "\n")
    assert laspy.read(export(out, "laz", crs=str(tmp_path / "a.prj"))).header.vlrs[0].string == WKT
    (tmp_path / "b.prj").write_text("GEOGCRS[2019]")
    for given, words in (
        ("nowhere.prj", "no coordinate reference system"),
        (str(tmp_path / "b.prj"), "no OGC WKT 1"),
    ):
        with pytest.raises(InputError, match=words):
            export(out, "laz", crs=given)
    with pytest.raises(InputError, match="keeps no coordinate reference system"):
        export(out, "ply", crs=WKT)


def test_a_code_needs_pyproj_or_becomes_wkt_1(tmp_path):
    out, _ = make_result(tmp_path)
    try:
        import pyproj  # noqa: F401
    except ImportError:
        with pytest.raises(InputError, match="pip install pyproj"):
            export(out, "laz", crs="EPSG:25833+7837")
    else:
        las = laspy.read(export(out, "laz", crs="EPSG:25833+7837"))
        assert las.header.vlrs[0].string.startswith("COMPD_CS[")
