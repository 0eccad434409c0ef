"""Exports of a small result folder."""

import dataclasses
import json
import shutil

import box_world
import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import calibration, exposures, images, pcd, ply, tum
from lvba.io.dataset import open_dataset
from lvba.products import export, map_file, tracks
from lvba.trajectory import Trajectory
from lvba.visual.image import Undistorter
from lvba.visual.trajectory_rates import turns_of

ORIGIN = np.array([500000.0, 4000000.0, 50.0])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A recording of a box far from zero, with lens distortion, and its result with the true poses."""
    world, root = box_world.make(images=4, points_per_scan=6000), tmp_path_factory.mktemp("export")
    recording, out = root / "recording", root / "result"
    for folder in (recording / "all_image", recording / "all_pcd_body", out):
        folder.mkdir(parents=True)
    times = 100 + np.arange(4.0)
    for time, picture, scan in zip(times, world.pictures, world.scans):
        images.write_image(recording / "all_image" / f"{time:.6f}.png", picture)
        pcd.write_pcd(recording / "all_pcd_body" / f"{time:.6f}.pcd", scan)
    poses = world.world_from_camera.copy()
    poses[:, :3, 3] += ORIGIN
    trajectory = Trajectory(times, poses)
    for path in (
        recording / "all_image/image_poses.txt",
        recording / "all_pcd_body/lidar_poses.txt",
        out / "image_poses.txt",
    ):
        tum.write_trajectory(path, trajectory)
    camera = box_world.CAMERA
    (recording / "config.yaml").write_text(
        f"cam_model: {{cam_width: {camera.width}, cam_height: {camera.height}, scale: 1.0, cam_fx: {camera.fx}, "
        f"cam_fy: {camera.fy}, cam_cx: {camera.cx}, cam_cy: {camera.cy}, "
        "cam_d0: 0.2, cam_d1: 0.03, cam_d2: 0.001, cam_d3: 0.0}\n"
        "extrin_calib: {extrinsic_T: [0, 0, 0], extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1], "
        "Rcl: [1, 0, 0, 0, 1, 0, 0, 0, 1], Pcl: [0, 0, 0]}\n"
    )
    point_map = map_file.build(world.cloud(), world.views(), map_file.MapConfig(voxel_m=0.05))
    ply.write_ply(out / "map.ply", map_file.columns(point_map, ORIGIN))
    exposures.write_exposures(out / "exposures.csv", exposures.Exposures(times, np.exp(world.log_exposure)))
    (out / "report.json").write_text(json.dumps({"dataset": {"path": str(recording)}}))
    return out


def test_pieces_of_a_map_are_stored_as_the_whole_is():
    rng = np.random.default_rng(3)
    near, far = (
        map_file.PointMap(
            rng.normal(size=(9, 3)).astype(np.float32) + np.float32(at),
            np.zeros((9, 3), np.uint8), np.ones(9, np.uint8), np.ones(9, np.float32), 0.1,
            np.arange(9, dtype=np.int32) + at,
            None if at else np.linspace(0.001, 0.01, 9, dtype=np.float32),
        )
        for at in (0, 70_000)
    )  # fmt: skip
    whole = map_file.columns(map_file.together([near, far]), ORIGIN)
    stored = map_file.layout([near, far], ORIGIN)
    pieces = [map_file.columns(piece, ORIGIN, stored) for piece in (near, far)]
    for name, values in whole.items():
        together = np.concatenate([piece[name] for piece in pieces])
        assert (together.dtype, together.tobytes()) == (values.dtype, values.tobytes()), name
    assert (whole["x"].dtype, whole["scan"].dtype) == (np.float64, np.uint32)
    assert map_file.columns(near, 0 * ORIGIN)["x"].dtype == np.float32
    assert whole["error"].dtype == np.float32
    assert np.isnan(whole["error"][9:]).all()
    nameless = dataclasses.replace(near, scan=None)
    assert "scan" not in map_file.columns(far, ORIGIN, map_file.layout([nameless, far], ORIGIN))


def test_a_map_far_from_zero_is_written_in_double_precision(result):
    columns = ply.read_ply(result / "map.ply")
    assert columns["x"].dtype == np.float64
    assert abs(columns["x"].mean() - ORIGIN[0]) < 5
    assert columns["views"].max() > 1
    uncolored = columns["views"] == 0
    assert uncolored.any()
    assert (columns["red"][uncolored] == map_file.UNCOLORED).all()


def test_colmap_images_show_the_points_of_their_tracks(result, tmp_path):
    out = export.export(result, "colmap", tmp_path / "model")
    sparse = out / "sparse" / "0"
    assert {path.name for path in sparse.iterdir()} >= {
        "cameras.txt",
        "images.bin",
        "points3D.bin",
        "rigs.txt",
    }
    words = next(line for line in (sparse / "cameras.txt").read_text().splitlines() if line[0] != "#").split()
    width, height = int(words[2]), int(words[3])
    pictures = {path.name: images.read_image(path) for path in sorted((out / "images").iterdir())}
    assert len(pictures) == 4
    for picture in pictures.values():
        assert picture.shape == (height, width, 3)
        assert picture.max(axis=2).min() > 0  # no empty corners
    assert width < box_world.CAMERA.width
    assert np.loadtxt(out / "offset.txt") == pytest.approx(ORIGIN, abs=2)
    points = np.array(
        [line.split()[1:4] for line in (sparse / "points3D.txt").read_text().splitlines()[1:]], float
    )
    assert np.abs(points).max() < 5


def test_nerfstudio_dataset_is_complete(result, tmp_path):
    out = export.export(result, "nerfstudio", tmp_path / "nerf")
    content = json.loads((out / "transforms.json").read_text())
    for frame in content["frames"]:
        assert images.read_image(out / frame["file_path"]).shape[:2] == (content["h"], content["w"])
    assert len(ply.read_ply(out / content["ply_file_path"])["x"]) > 1000


def test_images_that_were_read_row_by_row_are_exported_as_if_at_once(result, tmp_path):
    rows = shutil.copytree(result, tmp_path / "rows")
    dataset = open_dataset(json.loads((rows / "report.json").read_text())["dataset"]["path"])
    camera = dataset.camera
    calibration.write(rows, camera, np.eye(4), 0.0, 0.1, {})
    sizes = []
    for folder in (result, rows):
        out = export.export(folder, "nerfstudio", tmp_path / f"nerf_{folder.name}")
        content = json.loads((out / "transforms.json").read_text())
        sizes.append((content["w"], content["h"]))
    assert sizes[1][0] <= sizes[0][0]
    assert sizes[1][1] <= sizes[0][1]
    # pixel centers are at .5 there
    left, top = round(camera.cx + 0.5 - content["cx"]), round(camera.cy + 0.5 - content["cy"])
    turns = turns_of(tum.read_trajectory(rows / "image_poses.txt"), 0.1)
    assert np.abs(turns).max() > 1e-3
    undistort = Undistorter(camera)
    assert len(content["frames"]) == len(turns)
    for frame, path, turn in zip(content["frames"], dataset.image_paths, turns, strict=True):
        expected = undistort(images.read_image(path), turn)[
            top : top + content["h"], left : left + content["w"]
        ]
        np.testing.assert_array_equal(images.read_image(out / frame["file_path"]), expected)
        assert not undistort.empty(turn)[top : top + content["h"], left : left + content["w"]].any()


def test_las_is_in_the_frame_of_the_recording(result, tmp_path):
    laspy = pytest.importorskip("laspy")
    las = laspy.read(export.export(result, "laz", tmp_path / "map.laz"))
    np.testing.assert_allclose(las.x, ply.read_ply(result / "map.ply")["x"], atol=6e-5)


def test_unknown_formats_and_folders_are_named(result, tmp_path):
    with pytest.raises(InputError, match="colmap, nerfstudio"):
        export.export(result, "fbx")
    with pytest.raises(InputError, match=r"map\.ply"):
        export.export(tmp_path, "ply")


def test_tracks_leave_out_what_is_hidden_or_outside():
    world = box_world.make(images=1)
    wall = np.random.default_rng(0).uniform(-0.5, 0.5, (20000, 3)) * [1, 1, 0] + [0, 0, 1.0]
    pose = np.eye(4)[None]
    views = box_world.BoxWorld(pose, np.zeros(1), world.pictures, [], pose).views()
    points = np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, -1.0], [50, 0, 1.0], [0.2, 0.1, 1.05]])
    point, image, pixel = tracks.visible(points, wall.astype(np.float32), views)
    assert point.tolist() == [0, 4]
    assert image.tolist() == [0, 0]
    np.testing.assert_allclose(pixel[0], [box_world.CAMERA.cx, box_world.CAMERA.cy])


def test_the_rectangle_that_is_kept_holds_valid_pixels_only():
    row, column = np.mgrid[:60, :80]
    valid = ((column - 40) / 45.0) ** 2 + ((row - 28) / 35.0) ** 2 < 1
    rows, columns = export.valid_rectangle(valid)
    assert valid[rows, columns].all()
    assert valid[rows, columns].size > 0.6 * valid.sum()
    assert export.valid_rectangle(np.ones((3, 4), bool)) == (slice(0, 3), slice(0, 4))
    hole = np.ones((30, 40), bool)
    hole[15, 20] = False
    rows, columns = export.valid_rectangle(hole)
    assert hole[rows, columns].all()


def test_thinned_maps_keep_the_pixel_footprint_by_default():
    world = box_world.make(images=3)
    footprint = map_file.pixel_footprint(world.cloud(), world.views(), world.views().camera)
    assert 1 / 60 < footprint < 4 / 60
    point_map = map_file.build(world.cloud(), world.views())
    assert point_map.voxel_m == pytest.approx(2 * footprint)
    paper = map_file.build(
        world.cloud(), world.views(), map_file.MapConfig(colors="paper", keep_uncolored=False)
    )
    assert (paper.views == 1).all()
    assert len(paper) < len(point_map)
