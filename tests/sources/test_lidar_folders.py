"""Folders with scans and poses of LiDAR programs: a wall and a mark at known poses must come back."""

import known_view as view
import numpy as np
import pytest
from lidar_writers import CAMERA_FROM_BASE, balm, hba, kiss_icp, line, recording, spires

from lvba.errors import InputError
from lvba.io import dataset
from lvba.sources import folders
from lvba.sources.opening import open_source
from lvba.sources.source import Kind

CASES = {
    "hba": (hba, [0, 100_000_000, 200_000_000, 300_000_000], True),
    "balm": (balm, [100_250_000_000, 100_350_000_000, 100_450_000_000, 100_550_000_000], True),
    "kiss_icp": (kiss_icp, [50_500_000_000, 50_600_000_000, 50_700_000_000, 50_800_000_000], False),
}


def check(source, stamps):
    records = list(source.records(["scans", "poses"]))
    scans = [record for name, record in records if name == "scans"]
    poses = [record for name, record in records if name == "poses"]
    assert [scan.stamp for scan in scans] == [pose.stamp for pose in poses] == stamps
    for scan, pose in zip(scans, poses, strict=True):
        assert pose.child == scan.frame
        world = scan.points @ pose.parent_from_child[:3, :3].T + pose.parent_from_child[:3, 3]
        np.testing.assert_allclose(world[0], view.MARK, atol=1e-5)
        assert np.abs(world @ view.NORMAL - view.DISTANCE).max() < 1e-5


@pytest.mark.parametrize("name", CASES)
def test_scans_are_on_the_wall_by_their_poses(tmp_path, name):
    write, stamps, deskewed = CASES[name]
    write(tmp_path)
    source = open_source(tmp_path)
    check(source, stamps)
    assert source.geometry().deskewed == deskewed
    assert source.geometry().camera is None


def test_balm_poses_without_times_are_ten_a_second(tmp_path):
    balm(tmp_path, timed=False)
    check(folders.find(tmp_path), [0, 100_000_000, 200_000_000, 300_000_000])


def test_scans_of_kiss_icp_are_matched_by_the_times_in_their_names(tmp_path):
    kiss_icp(tmp_path, ("50.500.pcd", "50.600.pcd", "50.700.pcd", "50.800.pcd"))
    check(folders.find(tmp_path), CASES["kiss_icp"][1])


def test_times_in_the_names_of_kiss_icp_are_whole_however_many_seconds_they_span(tmp_path):
    """The digits behind the point repeat each second."""
    names = [f"{1700000001 + i // 2}.{i % 2 * 500_000_000:09}.pcd" for i in range(4)]
    kiss_icp(tmp_path, names, [f"{1700000001 + 0.5 * i:.4f}" for i in range(4)])
    check(folders.find(tmp_path), [1700000001_000000000 + 500_000_000 * i for i in range(4)])


def test_poses_of_kiss_icp_without_times_take_those_in_the_names(tmp_path):
    names = [f"{1700000001 + i // 2}.{i % 2 * 500_000_000:09}.pcd" for i in range(4)]
    kiss_icp(tmp_path, names, [f"{i}.0000" for i in range(4)])
    source = folders.find(tmp_path)
    check(source, [1700000001_000000000 + 500_000_000 * i for i in range(4)])
    assert any("in the names of the scans are taken" in note for note in source.describe().notes)


@pytest.mark.parametrize("names", ["{:06}.pcd", "scan{}_of_4.pcd", "v1.2_{:06}.pcd"])
@pytest.mark.parametrize("first", [0, 1, 9])
def test_poses_of_kiss_icp_without_any_times_are_ten_a_second(tmp_path, names, first):
    named = [names.format(i + first) for i in range(4)]
    kiss_icp(tmp_path, named, [f"{i}.0000" for i in range(4)])
    source = folders.find(tmp_path)
    check(source, [0, 100_000_000, 200_000_000, 300_000_000])
    assert any("10 scans a second are assumed" in note for note in source.describe().notes)


def test_files_of_one_number_are_refused(tmp_path):
    hba(tmp_path)
    (tmp_path / "pcd" / "copy_of_8.pcd").write_bytes((tmp_path / "pcd" / "8.pcd").read_bytes())
    with pytest.raises(InputError, match=r"both 8.pcd and copy_of_8.pcd have the number 8"):
        folders.find(tmp_path)
    (tmp_path / "pcd" / "copy_of_8.pcd").rename(tmp_path / "pcd" / "8.PCD")  # as an image beside its original
    check(folders.find(tmp_path), CASES["hba"][1])


@pytest.mark.parametrize("viewpoints", [True, False])
def test_oxford_spires_sequence(tmp_path, viewpoints):
    spires(tmp_path, viewpoints)
    source = open_source(tmp_path)
    check(source, [1710338090_100000000 + i * 1_000_000 for i in range(4)])
    known = source.geometry()
    np.testing.assert_allclose(known.camera_from_lidar, CAMERA_FROM_BASE, atol=1e-9)
    images = [record for _, record in source.records(["cam0"])]
    for image, pose in zip(images, view.poses(), strict=True):
        expected = view.project(view.MARK, (60, 60), (31, 24), pose @ np.linalg.inv(known.camera_from_lidar))
        np.testing.assert_allclose(view.spot_in(image), expected, atol=0.3)


@pytest.mark.parametrize(
    ("write", "name", "text", "message"),
    [
        (spires, "sensor.yaml", "sensor: {cameras: []}\n", "sensor.yaml"),
        (
            spires,
            "processed/vilens-slam/undist-clouds/cloud_1710338090_100000000.pcd",
            "x\n",
            "has no VIEWPOINT",
        ),
        (hba, "pose.json", "1 2 3\n", r"pose\.json:1: not 7 finite numbers; write tx ty tz qw qx qy qz"),
        (hba, "pose.json", line(0, 0, 0, 0, 0, 0, 1), "seem to be written w last"),
        (hba, "pose.json", line(0, 0, 0, 1, 0, 0, 0), "has 1 poses, but there are 4 scans"),
        (hba, "pose.json", line(0, 0, 0, 2, 0, 0, 0), "length 2 instead of 1"),
        (balm, "alidarPose.csv", "1,0,0,0\n", r"alidarPose\.csv: 1 lines are no whole number"),
        (balm, "alidarPose.csv", "2,0,0,0\n0,1,0,0\n0,0,1,0\n0,0,0,1\n", "no rotation"),
        (kiss_icp, "run_poses_tum.txt", "1 2\n", r"run_poses_tum\.txt:1"),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(tmp_path, write, name, text, message):
    write(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        folders.find(tmp_path)


@pytest.mark.parametrize(
    ("name", "mend"),
    [
        ("PCD/scans.pcd", "without single scans; run it again and record its topics /cloud_registered_body"),
        ("r3live_output/rgb_pt.pcd", "keeps no single scans; give the bag"),
        ("r3live_output/map.r3live", "keeps no single scans; give the bag"),
    ],
)
def test_merged_maps_are_refused_with_the_mend(tmp_path, name, mend):
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).write_text("")
    with pytest.raises(InputError, match=mend):
        open_source(tmp_path)


@pytest.mark.parametrize(("name", "mend"), [("a.r3d", "unpack it"), ("scene0000_00.sens", "SensReader")])
def test_archives_are_refused_with_the_mend(tmp_path, name, mend):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=mend):
        folders.find(tmp_path / name)


def test_a_recording_is_a_source_as_lvba_opens_it(tmp_path):
    recording(tmp_path)
    source = open_source(tmp_path)
    opened = dataset.open_dataset(tmp_path)
    streams = {stream.name: stream for stream in source.describe().streams}
    assert streams["scans"].kind is Kind.SCANS
    assert streams["images"].count == len(opened.image_paths)
    records = list(source.records(["scans", "scan_poses", "camera_poses"]))
    poses = [record.parent_from_child for name, record in records if name == "scan_poses"]
    np.testing.assert_allclose(poses, opened.scans.world_from_sensor)
    cameras = [record.parent_from_child for name, record in records if name == "camera_poses"]
    np.testing.assert_allclose(cameras, opened.images.world_from_sensor)
    scans = [record for name, record in records if name == "scans"]
    np.testing.assert_array_equal(scans[0].points, dataset.load_scan(opened, 0).points)
    assert source.geometry().camera == opened.camera
