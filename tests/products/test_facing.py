"""Both sides of a wall that is thinner than any depth test can tell apart."""

import naive_products as naive
import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import facing
from lvba.products import cloud as clouds
from lvba.products import colorize, map_file
from lvba.products.views import Views

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
RED, BLUE = np.array([200, 40, 40], np.uint8), np.array([40, 40, 200], np.uint8)
THICK = 0.03


def two_rooms():
    """(cloud, views): a wall across x from 0 to THICK, red towards -x and blue towards +x, a LiDAR and a camera each."""
    rng = np.random.default_rng(0)
    across = rng.uniform(-1, 1, (6000, 2))
    depth = np.repeat([0.0, THICK], 3000) + rng.normal(0, 0.01, 6000)
    points = np.column_stack([depth, across]).astype(np.float32)
    sensors = np.array([[-3.0, 0.2, 0.1], [3.0 + THICK, -0.3, 0.2]])
    cloud = clouds.Cloud(points, np.array([0, 3000, 6000]), np.array([0.0, 1.0]), sensors)
    right_hand = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    cameras = np.stack([np.eye(4), np.eye(4)])
    cameras[0, :3, :3] = right_hand
    cameras[1, :3, :3] = np.diag([-1.0, -1, 1]) @ right_hand
    cameras[:, :3, 3] = [[-2.8, 0, 0], [2.8 + THICK, 0, 0]]
    pictures = [np.tile(color, (CAMERA.height, CAMERA.width, 1)) for color in (RED, BLUE)]
    return cloud, Views(lambda i: pictures[i], CAMERA, np.arange(2.0), cameras, np.zeros(2))


def test_a_wall_has_the_color_of_the_room_on_its_own_side():
    cloud, views = two_rooms()
    found = map_file.build(cloud, views, map_file.MapConfig(voxel_m=0))
    assert (found.views > 0).mean() > 0.95
    seen = found.views > 0
    right = (found.rgb == np.stack([RED, BLUE])[found.scan]).all(1)
    assert right[seen].mean() > 0.9, "but for slivers of too few points"
    blind = colorize.blended(cloud.points_world, views)
    assert (blind.views == 2).mean() > 0.5, (
        "the depth test alone lets both cameras see it, or this proves nothing"
    )


def test_surfaces_match_their_twin_and_face_who_measured():
    cloud, _ = two_rooms()
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(500, 3))
    ball = (ball / np.linalg.norm(ball, axis=1, keepdims=True) * 0.1 + [0.5, 0.5, 0.2]).astype(np.float32)
    points = np.concatenate([cloud.points_world, ball, ball[:1] + 30.0])
    scan = np.concatenate([cloud.scan_of(np.arange(6000)), np.zeros(501, np.int32)])
    blocks = clouds.sort_into_blocks(points)
    ordered = points[blocks.order]
    sensors = cloud.sensor_world.astype(np.float32)
    got = facing.surfaces(
        np.ascontiguousarray(ordered.T), blocks.start, scan[blocks.order], sensors, np.radians(80)
    )
    want = naive.surfaces(ordered, blocks.start, sensors[scan[blocks.order]], np.radians(80))
    np.testing.assert_array_equal((got[:, :3] != 0).any(1), (want[:, :3] != 0).any(1))
    np.testing.assert_allclose(got, want, atol=3e-3, rtol=3e-3)
    on_wall = blocks.order < 6000
    assert (np.abs(got[on_wall, 0]) > 0.9).mean() > 0.9
    assert not got[blocks.order == len(points) - 1, :3].any(), "one point alone has no normal"


def test_nothing_is_behind_where_the_sensor_is_unknown():
    cloud, views = two_rooms()
    unknown = clouds.Cloud(cloud.points_world, cloud.scan_offsets, cloud.scan_times)
    assert unknown.origins(np.arange(3)) is None
    found = map_file.build(unknown, views, map_file.MapConfig(voxel_m=0))
    assert (found.views == 2).mean() > 0.5


def test_where_the_sensor_was_moves_with_its_scan():
    pose = geometry.exp(np.array([[0.0, 0, 0.5, 1.0, 2.0, 3.0]]))
    point = np.ones((1, 3), np.float32)
    cloud = clouds.assemble(lambda s: point, pose, np.zeros(1), sensor_position=np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(
        cloud.sensor_world, geometry.transform_points(pose[0], np.array([[0.1, 0.2, 0.3]]))
    )
