"""What an import does to its folder: stopped, killed, done again, and what it refuses to touch."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io.dataset import open_dataset
from lvba.simulate import raw, simulate
from lvba.sources.importing import data_set, streams
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions, parse_conventions
from lvba.sources.opening import open_source
from lvba.sources.source import Kind, ListSource, TransformSample

pytestmark = pytest.mark.usefixtures("one_pair")


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


class StopError(Exception):
    pass


def stopping_after(count):
    """Progress that stops the work after so many scans and images."""

    def progress(what, done, total):
        if what == "scans and images" and done == count:
            raise StopError

    return progress


def test_an_import_that_was_stopped_goes_on_and_gives_the_same_bytes(tmp_path, small_source):
    import_source(small_source, tmp_path / "whole")
    out = tmp_path / "stopped"
    for count in (1, 9):
        with pytest.raises(StopError):
            import_source(small_source, out, progress=stopping_after(count))
    kept = {
        path: (out / path).stat().st_mtime_ns for path in contents(out) if path.suffix in (".pcd", ".jpg")
    }
    assert len(kept) >= 1
    # what a process that is killed leaves behind
    (out / "all_pcd_body" / ".1700000000.pcd.abcd.partial").write_bytes(b"half")
    (out / ".imu.csv.abcd.partial").write_bytes(b"half")
    import_source(small_source, out)
    assert contents(out) == contents(tmp_path / "whole")
    assert {path: (out / path).stat().st_mtime_ns for path in kept} == kept
    # once more: all is there
    assert import_source(small_source, out).reused
    assert contents(out) == contents(tmp_path / "whole")


def test_a_folder_of_something_else_is_left_alone(tmp_path, small_source):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("42")
    with pytest.raises(InputError, match="is not empty"):
        import_source(small_source, mine)
    import_source(small_source, tmp_path / "out")
    with pytest.raises(InputError, match="of another source, or with other options"):
        import_source(small_source, tmp_path / "out", ImportOptions(every=2))
    assert contents(mine) == {Path("thesis.txt"): b"42"}


def test_what_ended_before_a_frame_was_written_is_taken_over(tmp_path, small_source):
    (tmp_path / "one.txt").write_text("1700000000 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"one\.txt"):
        import_source(small_source, tmp_path / "out", ImportOptions(odometry=str(tmp_path / "one.txt")))
    import_source(small_source, tmp_path / "out")
    import_source(small_source, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def stamps(dataset, paths):
    return np.array([int(Path(path).stem.replace(".", "")) for path in paths])


def test_a_part_of_a_recording_is_chosen(tmp_path, small_source, small_truth):
    import_source(small_source, tmp_path / "all")
    every = stamps(None, open_dataset(tmp_path / "all").scan_paths)
    chosen = ImportOptions(start=0.55, stop=1.45, every=2, image="none")
    import_source(small_source, tmp_path / "part", chosen)
    part = open_dataset(tmp_path / "part")
    after = (small_truth.scans - small_truth.scans[0]) * 1e-9
    wanted = small_truth.scans[::2][(after[::2] >= 0.55) & (after[::2] <= 1.45)]
    assert list(stamps(part, part.scan_paths)) == [stamp for stamp in wanted if stamp in every]
    assert part.image_paths == ()
    import_source(small_source, tmp_path / "slow", ImportOptions(rate=2.0))
    slow = open_dataset(tmp_path / "slow")
    for paths, count in ((slow.scan_paths, 4), (slow.image_paths, 4)):
        gaps = np.diff(stamps(slow, paths)) * 1e-9
        assert len(paths) == count
        assert np.all(gaps > 0.39)  # images come 5 times a second


def test_what_data_cannot_tell_is_said(tmp_path, small_source):
    report = import_source(small_source, tmp_path / "out")
    assert any(
        "time: the data cannot tell" in words and "--convention time=" in words for words in report.warnings
    )
    decided = import_source(
        small_source,
        tmp_path / "said",
        ImportOptions(conventions=parse_conventions(["time=middle", "pose_of=body"])),
    )
    assert decided.facts["conventions"]["time"] == {
        **decided.facts["conventions"]["time"],
        "taken": "middle",
        "by": "option",
    }
    assert not any(words.startswith(("time", "pose_of")) for words in decided.warnings)


@pytest.mark.parametrize("named", ["body", "frame:imu"])
def test_a_body_at_the_place_of_the_lidar_is_the_lidar(tmp_path, small_source, named):
    here = TransformSample(raw.START_NS, raw.IMU_FRAME, raw.LIDAR_FRAME, np.eye(4), True)
    items = tuple(
        (stream, here if getattr(record, "parent", "") == raw.IMU_FRAME else record)
        for stream, record in small_source.items
    )
    options = ImportOptions(conventions={"pose_of": named})
    report = import_source(replace(small_source, items=items), tmp_path / "out", options)
    assert report.facts["conventions"]["pose_of"]["taken"] == "lidar"


def test_a_body_that_nothing_is_known_of_is_a_warning(tmp_path, small_source):
    items = tuple(
        (stream, record)
        for stream, record in small_source.items
        if getattr(record, "parent", "") != raw.IMU_FRAME
    )
    report = import_source(replace(small_source, items=items), tmp_path / "out")
    assert any("nothing says where the body (IMU) is" in words for words in report.warnings)
    options = ImportOptions(conventions={"pose_of": "lidar"})
    report = import_source(replace(small_source, items=items), tmp_path / "said", options)
    assert not any("pose_of" in words for words in report.warnings)


def without(source, *names):
    items = tuple(item for item in source.items if item[0] not in names)
    kept = tuple(each for each in source.description.streams if each.name not in names)
    return replace(source, items=items, description=replace(source.description, streams=kept))


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        (raw.LIDAR, "has no scans"),
        (raw.ODOMETRY, "has no poses"),
        (raw.CAMERA_INFO, "intrinsics of the camera; give --calibration FILE, or --image none"),
        (raw.TF_STATIC, "the extrinsic of camera and LiDAR; give --calibration FILE"),
    ],
)
def test_what_is_missing_is_named_with_the_mend(tmp_path, small_source, missing, words):
    with pytest.raises(InputError, match=words):
        import_source(without(small_source, missing), tmp_path / "out")


def test_of_several_streams_one_must_be_chosen(small_source):
    first = small_source.description.streams[0]
    both = replace(
        small_source.description,
        streams=(*small_source.description.streams, replace(first, name="/other/points")),
    )
    with pytest.raises(
        InputError, match=r"choose by --lidar: /lidar/points .*, /other/points .*; likely /lidar/points"
    ):
        streams.choose(both, ImportOptions())
    assert streams.choose(both, ImportOptions(lidar="/other/points")).lidar == "/other/points"
    with pytest.raises(InputError, match="no such stream of scans"):
        streams.choose(both, ImportOptions(lidar="/nothing"))


VIRAL = {raw.LIDAR: "/os1_cloud_node1/points", raw.IMAGES: "/left/image_raw", raw.IMU: "/imu/imu"}


def as_ntu_viral(source, path="eee_01.bag"):
    """With topics of that data set, and images of a second camera."""
    items = tuple((VIRAL.get(name, name), record) for name, record in source.items)
    streams = tuple(
        replace(each, name=VIRAL.get(each.name, each.name)) for each in source.description.streams
    )
    [images] = [each for each in streams if each.kind is Kind.IMAGES]
    streams = (*streams, replace(images, name="/right/image_raw"))
    return replace(source, items=items, description=replace(source.description, path=path, streams=streams))


def test_a_preset_chooses_topics_and_tells_what_data_leave_open(tmp_path, small_source):
    viral = as_ntu_viral(small_source)
    with pytest.raises(InputError, match="2 streams of images"):
        import_source(viral, tmp_path / "without")
    facts = import_source(viral, tmp_path / "out", ImportOptions(preset="ntu-viral")).facts
    assert facts["streams"]["image"] == "/left/image_raw"
    names = dict(zip(("lidar", "image", "imu"), VIRAL.values(), strict=True))
    assert facts["preset"]["streams"] == names
    assert facts["preset"]["stamp"] == "end"
    decided = facts["conventions"]["time"]
    assert (decided["taken"], decided["by"]) == ("end", "preset ntu-viral")
    assert not any(words.startswith("time") for words in facts["warnings"])
    said = ImportOptions(preset="ntu-viral", image="none", conventions=parse_conventions(["time=begin"]))
    alone = replace(viral, items=tuple(item for item in viral.items if item[0] != raw.TF_STATIC))
    facts = import_source(alone, tmp_path / "said", said).facts
    assert "image" not in facts["streams"]
    assert facts["calibration"]["imu_from_lidar"] == "preset ntu-viral"
    assert "extrinsic_T: [-0.05, 0.0, 0.055]" in (tmp_path / "said" / "config.yaml").read_text()
    assert (facts["conventions"]["time"]["taken"], facts["conventions"]["time"]["by"]) == ("begin", "option")


def test_of_several_cameras_one_is_chosen_by_name(tmp_path, small_source):
    """Of topics that the source has not; one that is named otherwise is refused, also where it is the only one."""
    known = "{camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [0, 0, 0, 0], resolution: [64, 48], "
    identity = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    first = f"cam0: {known}intrinsics: [51, 51, 32, 24], rostopic: /left}}\n"
    second = f"cam1: {known}intrinsics: [52, 52, 32, 24], T_cn_cnm1: {identity}, rostopic: /right}}\n"
    path = tmp_path / "camchain.yaml"
    path.write_text(first + second)
    asked = ImportOptions(calibration=(str(path),))
    out = tmp_path / "out"
    with pytest.raises(
        InputError, match=r"has no camera '/camera/image': cam0 \(/left\), cam1.*--camera NAME"
    ):
        import_source(small_source, tmp_path / "without", asked)
    import_source(small_source, out, replace(asked, camera="cam1"))
    assert open_dataset(out).camera.fx == 52
    path.write_text(first)
    with pytest.raises(InputError, match="--camera cam1: the calibration is of cam0, /left"):
        import_source(small_source, tmp_path / "other", replace(asked, camera="cam1"))


def test_image_offsets_are_those_of_the_sequence_that_the_source_is_named_for(small_source):
    mars = ImportOptions(preset="mars-lvig")
    named = replace(small_source.description, path="/data/hkisland02_part.bag")
    assert data_set.of_source(named, mars).guess.image_offset == 0.1
    other = data_set.of_source(small_source.description, mars)
    assert other.guess.image_offset is None
    assert any("none of HKairport01" in words for words in other.warnings)
    assert any("has none of its topics" in words for words in other.warnings)


def test_scans_outside_of_the_poses_are_counted(tmp_path, small_source, small_truth):
    late = int(small_truth.scans[10])
    items = tuple(item for item in small_source.items if item[0] != raw.ODOMETRY or item[1].stamp >= late)
    part: ListSource = replace(small_source, items=items)
    report = import_source(part, tmp_path / "out")
    assert "10 scans outside of the poses left out, by 0.1 to 1 s" in report.facts["losses"]
    assert len(open_dataset(tmp_path / "out").scan_paths) == 10


@pytest.mark.parametrize(("late_s", "count", "loss"), [(1.4e-3, 20, ""), (0.0125, 19, "by 0.0125 s")])
def test_a_scan_that_ends_a_little_after_the_last_pose_is_kept(
    tmp_path, small_source, small_truth, late_s, count, loss
):
    last = int(small_truth.scans[-1])
    kept = [
        item for item in small_source.items if item[0] != raw.ODOMETRY or item[1].stamp <= last + 100_000_000
    ]
    items = tuple(
        (name, replace(record, times=record.times + late_s * 1e9))
        if name == raw.LIDAR and record.stamp == last
        else (name, record)
        for name, record in kept
    )
    report = import_source(replace(small_source, items=items), tmp_path / "out", ImportOptions(image="none"))
    assert report.facts["written"]["scans"] == count
    lost = [words for words in report.facts["losses"] if "of the poses" in words]
    assert lost == ([f"1 scans outside of the poses left out, {loss}"] if loss else [])


def test_scans_in_a_gap_of_the_poses_are_counted(tmp_path, small_source, small_truth):
    first, last = int(small_truth.scans[5]), int(small_truth.scans[12])
    kept = tuple(
        item for item in small_source.items if item[0] != raw.ODOMETRY or not first < item[1].stamp < last
    )
    report = import_source(replace(small_source, items=kept), tmp_path / "out", ImportOptions(image="none"))
    assert "7 scans in gaps of the poses left out" in report.facts["losses"]


@pytest.mark.parametrize("text", ["nothing=1", "pose_of=wheel", "time=soon"])
def test_conventions_that_are_not_known_are_refused(text):
    with pytest.raises(InputError, match="--convention"):
        parse_conventions([text])


@pytest.mark.parametrize("kind", ["camera", "body"])
def test_a_recording_is_thinned_out_as_it_is(tmp_path, kind):
    """Poses, bytes of frames, the camera and the IMU stay; what images' poses are of, too."""
    sizes = {"width": 64, "height": 48, "points_per_scan": 300}
    simulate("street", tmp_path / "all", frames=8, length=6.0, image_poses=kind, imu=True, **sizes)
    whole = open_dataset(tmp_path / "all")
    report = import_source(open_source(tmp_path / "all"), tmp_path / "thin", ImportOptions(every=2))
    thin = open_dataset(tmp_path / "thin")
    assert report.facts["written"] == {"scans": len(thin.scan_paths), "images": len(thin.image_paths)}
    for of, among in ((thin.scan_paths, whole.scan_paths), (thin.image_paths, whole.image_paths)):
        assert [Path(path).read_bytes() for path in of] == [Path(path).read_bytes() for path in among[::2]]
    for of, among in ((thin.scans, whole.scans), (thin.images, whole.images)):
        np.testing.assert_array_equal(of.times, among.times[::2])
    moved = thin.images.world_from_sensor - whole.images.world_from_sensor[::2]
    moved[:, :3, 3] += thin.origin - whole.origin
    assert np.abs(moved).max() < 1e-8
    assert thin.camera == whole.camera
    assert thin.image_poses == whole.image_poses == kind
    assert thin.camera_from_scan == pytest.approx(whole.camera_from_scan, abs=1e-12)
    assert thin.sensor_position_scan == pytest.approx(whole.sensor_position_scan)
    assert Path(thin.imu_path).read_text() == Path(whole.imu_path).read_text()
    assert import_source(open_source(tmp_path / "all"), tmp_path / "thin", ImportOptions(every=2)).reused
    with pytest.raises(InputError, match="1 scans are wanted"):
        import_source(open_source(tmp_path / "all"), tmp_path / "few", ImportOptions(every=1000))
