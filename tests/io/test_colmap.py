"""COLMAP models: text and binary say the same, and put points where the images show them."""

import numpy as np
import pytest

from lvba import geometry
from lvba.camera import Camera
from lvba.io import colmap, nerfstudio


@pytest.fixture
def model():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (30, 3)) + np.array([0, 0, 5])
    poses = geometry.exp(rng.normal(0, 0.1, (4, 6)))
    camera = Camera(640, 480, 500.0, 510.0, 320.25, 239.75)
    image, point = np.nonzero(rng.random((4, 30)) < 0.6)
    order = np.lexsort((image, point))
    image, point = image[order].astype(np.int32), point[order].astype(np.int32)
    local = np.einsum("nji,nj->ni", poses[image, :3, :3], points[point] - poses[image, :3, 3])
    pixel = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    rgb = rng.integers(0, 256, (30, 3)).astype(np.uint8)
    return colmap.ColmapModel(
        camera, ("a.png", "b.png", "c.png", "d.png"), poses, points, rgb, point, image, pixel
    )


def lines(path):
    return [line for line in path.read_text().split("\n")[:-1] if not line.startswith("#")]


def test_text_tracks_and_images_refer_to_each_other_and_reproject(tmp_path, model):
    colmap.write_model(tmp_path, model)
    _, name, *parameters = lines(tmp_path / "cameras.txt")[0].split()
    assert name == "PINHOLE"
    width, height, fx, fy, cx, cy = map(float, parameters)
    assert (width, height, cx, cy) == (640, 480, 320.75, 240.25)
    rows = lines(tmp_path / "images.txt")
    images = {}
    for head, seen in zip(rows[::2], rows[1::2]):
        number, *pose = head.split()[:8]
        w, x, y, z, *t = map(float, pose)
        camera_from_world = geometry.from_quaternion_translation(np.array([x, y, z, w]), np.array(t))
        images[int(number)] = camera_from_world, np.array(seen.split(), float).reshape(-1, 3)
    assert [head.split()[-1] for head in rows[::2]] == list(model.names)
    seen_pairs = 0
    for row in lines(tmp_path / "points3D.txt"):
        number, x, y, z, *rest = row.split()
        assert list(map(int, rest[:3])) == model.rgb[int(number) - 1].tolist()
        track = np.array(rest[4:], int).reshape(-1, 2)
        for image, place in track:
            camera_from_world, points2d = images[image]
            assert points2d[place, 2] == int(number)
            local = geometry.transform_points(camera_from_world, np.array([[x, y, z]], float))[0]
            expected = local[:2] / local[2] * [fx, fy] + [cx, cy]
            np.testing.assert_allclose(points2d[place, :2], expected, atol=0.01)
            seen_pairs += 1
    assert seen_pairs == len(model.track_point) == sum(len(points2d) for _, points2d in images.values())


def test_binary_holds_the_same_as_text(tmp_path, model):
    colmap.write_model(tmp_path, model)
    data = (tmp_path / "points3D.bin").read_bytes()
    assert np.frombuffer(data, "<u8", 1)[0] == 30
    place, texts = 8, lines(tmp_path / "points3D.txt")
    head = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
    for text in texts:
        words = text.split()
        row = np.frombuffer(data, head, 1, place)[0]
        track = np.frombuffer(data, "<u4", 2 * int(row["length"]), place + head.itemsize)
        place += head.itemsize + track.nbytes
        assert int(words[0]) == row["id"]
        np.testing.assert_allclose(np.array(words[1:4], float), row["xyz"], atol=1e-5)
        assert [int(word) for word in words[8:]] == track.tolist()
    assert place == len(data)
    data, place = (tmp_path / "images.bin").read_bytes(), 8
    rows = lines(tmp_path / "images.txt")
    for head_text, seen in zip(rows[::2], rows[1::2]):
        pose = np.frombuffer(data, "<f8", 7, place + 4)
        np.testing.assert_allclose(np.array(head_text.split()[1:8], float), pose)
        end = data.index(b"\0", place + 64)
        assert data[place + 64 : end].decode() == head_text.split()[-1]
        count = np.frombuffer(data, "<u8", 1, end + 1)[0]
        assert count == len(seen.split()) // 3
        place = end + 9 + 24 * int(count)
    assert place == len(data)


def test_an_independent_reader_loads_it(tmp_path, model):
    pycolmap = pytest.importorskip("pycolmap")
    colmap.write_model(tmp_path, model)
    for suffix in (".txt", ".bin"):
        folder = tmp_path / suffix[1:]
        folder.mkdir()
        for path in tmp_path.glob(f"*{suffix}"):
            path.rename(folder / path.name)
        loaded = pycolmap.Reconstruction(str(folder))
        assert loaded.num_reg_images() == 4
        assert loaded.compute_num_observations() == len(model.track_point)
        loaded.update_point_3d_errors()
        assert loaded.compute_mean_reprojection_error() < 0.01


def test_transforms_turn_the_camera_axes(tmp_path, model):
    import json

    nerfstudio.write_transforms(tmp_path, model.camera, model.names, model.world_from_camera, "points.ply")
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (content["cx"], content["cy"]) == (320.75, 240.25)
    for frame, pose in zip(content["frames"], model.world_from_camera):
        turned = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(turned[:3, 2], -pose[:3, 2])
        np.testing.assert_allclose(turned[:3, 1], -pose[:3, 1])
        np.testing.assert_allclose(turned[:3, 3], pose[:3, 3])
        assert np.linalg.det(turned) == pytest.approx(1)
