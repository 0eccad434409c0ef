"""What `lvba export RESULT lod` writes beside the octree, from a small result far from zero."""

import dataclasses
import json

import box_world
import numpy as np
import pytest

from lvba.io import dataset as recordings
from lvba.io import exposures, images, pcd, ply, potree, tum
from lvba.products import export, map_file, viewer
from lvba.trajectory import Trajectory

ORIGIN = np.array([500000.0, 4000000.0, 50.0])
SHIFT = np.array([0.3, -0.2, 0.1])
"""By how far the rough poses are off."""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A recording of a box whose rough poses are shifted, and its result with the true poses."""
    world, root = box_world.make(images=4), tmp_path_factory.mktemp("viewer")
    recording, out = root / "recording", root / "result"
    for folder in (recording / "all_image", recording / "all_pcd_body", out):
        folder.mkdir(parents=True)
    times = 100 + np.arange(4.0)
    for time, picture, scan in zip(times, world.pictures, world.scans):
        images.write_image(recording / "all_image" / f"{time:.6f}.png", picture)
        pcd.write_pcd(recording / "all_pcd_body" / f"{time:.6f}.pcd", scan)
    write_poses(times, world.world_from_camera, ORIGIN, out / "image_poses.txt", out / "lidar_poses.txt")
    write_poses(
        times, world.world_from_camera, ORIGIN + SHIFT,
        recording / "all_image/image_poses.txt", recording / "all_pcd_body/lidar_poses.txt",
    )  # fmt: skip
    camera = box_world.CAMERA
    (recording / "config.yaml").write_text(
        f"cam_model: {{cam_width: {camera.width}, cam_height: {camera.height}, scale: 1.0, cam_fx: {camera.fx}, "
        f"cam_fy: {camera.fy}, cam_cx: {camera.cx}, cam_cy: {camera.cy}, cam_d0: 0, cam_d1: 0, cam_d2: 0, cam_d3: 0}}\n"
        "extrin_calib: {extrinsic_T: [0, 0, 0], extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1], "
        "Rcl: [1, 0, 0, 0, 1, 0, 0, 0, 1], Pcl: [0, 0, 0]}\n"
    )
    point_map = map_file.build(world.cloud(), world.views(), map_file.MapConfig(voxel_m=0.05))
    ply.write_ply(out / "map.ply", map_file.columns(point_map, ORIGIN))
    exposures.write_exposures(out / "exposures.csv", exposures.Exposures(times, np.exp(world.log_exposure)))
    parts = [{"core_scans": [0, 2]}, {"core_scans": [2, 4]}]
    errors = {"scans": {"per_frame_m": [0.001, 0.002, None, 0.004]}, "cameras": None}
    report = {"dataset": {"path": str(recording)}, "merge": {"parts": parts}, "expected_error": errors}
    (out / "report.json").write_text(json.dumps(report))
    return out


def write_poses(times, poses, origin, *paths):
    moved = poses.copy()
    moved[:, :3, 3] += origin
    for path in paths:
        tum.write_trajectory(path, Trajectory(times, moved))


def test_rough_and_refined_poses_are_in_the_frame_of_the_recording(result, tmp_path):
    export.export(result, "lod", tmp_path)
    facts = json.loads((tmp_path / "cloud" / "cloud.json").read_text())
    for name in ("scans", "images"):
        rough, refined = (np.array(facts[name][which]).reshape(-1, 3, 4) for which in ("rough", "refined"))
        np.testing.assert_allclose(rough[..., 3] - refined[..., 3], np.tile(SHIFT, (4, 1)), atol=1e-6)
        assert np.abs(refined[..., 3] - ORIGIN).max() < 1
        np.testing.assert_allclose(
            refined[..., :3] @ refined[..., :3].swapaxes(1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-6
        )
    assert facts["camera"]["fx"] == box_world.CAMERA.fx
    assert facts["parts"] == [[0, 2], [2, 4]]
    assert facts["images"]["names"][0] == "100.000000.png"
    assert facts["scans"]["error"] == [0.001, 0.002, None, 0.004]
    assert facts["images"]["error"] is None


def test_every_point_has_the_scan_that_measured_it(result, tmp_path):
    """Moved back by the pose of its scan, a point of the map is one of that scan."""
    export.export(result, "lod", tmp_path)
    facts = json.loads((tmp_path / "cloud" / "cloud.json").read_text())
    metadata = json.loads((tmp_path / "cloud" / "metadata.json").read_text())
    rows = np.concatenate([rows for _, rows in potree.read_nodes(tmp_path / "cloud")])
    dataset = recordings.open_dataset(json.loads((result / "report.json").read_text())["dataset"]["path"])
    world = rows["position"] * metadata["scale"] + metadata["offset"]
    for s in range(4):
        pose = np.array(facts["scans"]["refined"][s]).reshape(3, 4)
        back = (world[rows["scan"] == s] - pose[:, 3]) @ pose[:, :3]
        scan = recordings.load_scan(dataset, s).points
        distance = np.linalg.norm(back[:50, None] - scan[None], axis=2).min(1)
        assert len(back) > 100
        assert distance.max() < 0.001


def test_the_map_from_refined_poses_looks_more_like_the_photograph(result, tmp_path):
    export.export(result, "lod", tmp_path)
    for image in range(4):
        photo, before, after = (
            images.read_image(tmp_path / "frames" / kind / f"{image:06d}.jpg").astype(float)
            for kind in viewer.KINDS
        )
        assert photo.shape == (box_world.CAMERA.height, box_world.CAMERA.width, 3)
        covered = (before.max(2) > 8) & (after.max(2) > 8)
        assert covered.mean() > 0.3
        assert np.abs(after - photo)[covered].mean() < 0.7 * np.abs(before - photo)[covered].mean()


def test_wide_pictures_are_made_smaller():
    small = viewer._small(np.zeros((100, 3000, 3), np.uint8))
    assert small.shape == (43, viewer.MAX_WIDTH, 3)


def test_without_its_recording_a_result_still_gives_the_octree(result, tmp_path, caplog):
    lone = tmp_path / "lone"
    lone.mkdir()
    (lone / "map.ply").write_bytes((result / "map.ply").read_bytes())
    (lone / "report.json").write_text(json.dumps({"dataset": {"path": str(tmp_path / "gone")}}))
    export.export(lone, "lod")
    assert sorted(path.name for path in lone.iterdir()) == ["cloud", "map.ply", "report.json"]
    assert not (lone / "cloud" / "cloud.json").exists()
    assert "without cameras" in caplog.text


def test_a_recording_without_images_has_no_pictures(result, tmp_path):
    path = json.loads((result / "report.json").read_text())["dataset"]["path"]
    dataset = dataclasses.replace(recordings.open_dataset(path), image_paths=())
    viewer.write(result, dataset, tmp_path)
    facts = json.loads((tmp_path / "cloud" / "cloud.json").read_text())
    assert facts["images"] is None
    assert facts["camera"] is None
    assert not (tmp_path / "frames").exists()
