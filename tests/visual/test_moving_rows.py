"""Rows of a moving camera beside transforms that are made one by one of their twists."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lvba import geometry, lens
from lvba.camera import Camera
from lvba.kernels import moving_rows
from lvba.kernels.scene import Intrinsics, PlanePatches
from lvba.lens import Lens
from lvba.visual import image

INTRINSICS = Intrinsics(300.0, 310.0, 160.0, 120.0)
IMAGES, PATCHES, SEEN = 5, 40, 700


@pytest.fixture(params=[0.0, 1e-4, 0.02, 1.5], ids="turn {}".format)
def scene(request):
    """Cameras that turn by so many rad while an image is read, and patches two to six meters in front of them."""
    rng = np.random.default_rng(3)
    poses = geometry.exp(rng.normal(size=(IMAGES, 6)) * [0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
    over = rng.normal(size=(IMAGES, 6)) * 0.05
    over[:, :3] *= request.param / 0.05
    normal = rng.normal(size=(PATCHES, 3)) * 0.2 + [0, 0, -1]
    patches = PlanePatches(
        position=rng.uniform([-1, -1, 2], [1, 1, 6], (PATCHES, 3)),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        reference=rng.integers(0, IMAGES, PATCHES).astype(np.int32),
        pixel=rng.uniform(0, [320, 240], (PATCHES, 2)),
    )
    point = rng.integers(0, PATCHES, SEEN).astype(np.int32)
    return poses, over, rng.uniform(-0.5, 0.5, SEEN), point, patches


def posed(poses, over, part, image):
    return poses[image] @ geometry.exp(over[image] * part[:, None])


def test_pixels_meet_their_planes_from_where_their_rows_are_read(scene):
    poses, over, part, point, patches = scene
    world = moving_rows.onto_planes(point, poses, over, part, INTRINSICS, patches)
    camera_from_world = geometry.inverse(posed(poses, over, part, patches.reference[point]))
    local = np.einsum("oij,oj->oi", camera_from_world[:, :3, :3], world) + camera_from_world[:, :3, 3]
    pixel = local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    np.testing.assert_allclose(pixel, patches.pixel[point], atol=1e-8)
    above = np.einsum("oi,oi->o", patches.normal[point], world - patches.position[point])
    np.testing.assert_allclose(above, 0.0, atol=1e-10 * np.abs(world).max())


def test_points_are_where_the_rows_that_show_them_have_the_camera(scene):
    poses, over, part, point, patches = scene
    image = np.roll(patches.reference[point], 7).astype(np.int32)
    world = patches.position[point] + 0.1
    place = moving_rows.into_images(world, image, poses, over, part, INTRINSICS)
    camera_from_world = geometry.inverse(posed(poses, over, part, image))
    local = np.einsum("oij,oj->oi", camera_from_world[:, :3, :3], world) + camera_from_world[:, :3, 3]
    expected = local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    np.testing.assert_allclose(place, expected, rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("turn", [(0.03, 0.0, 0.0), (0.0, -0.04, 0.0), (0.02, 0.05, -0.06)])
@pytest.mark.parametrize(
    ("kind", "coefficients"),
    [
        (Lens.RADIAL_TANGENTIAL, (0.0,) * 4),
        (Lens.RADIAL_TANGENTIAL, (-0.12, 0.03, 5e-4, -3e-4)),
        (Lens.EQUIDISTANT, (0.01, -0.004, 1e-3, 0.0)),
    ],
)
def test_pixels_are_where_the_row_that_shows_their_ray_has_turned_it(turn, kind, coefficients):
    """Raw pixels, back through the lens and the turn until their row, by rotations of another library."""
    camera = Camera(160, 120, 90.0, 91.0, 80.3, 58.6, coefficients, kind)
    pinhole = camera.undistorted()
    across, down = image._maps(camera, pinhole)
    x, y = np.empty_like(across), np.empty_like(down)
    turn = np.array(turn)
    moving_rows.turned_back(across, down, image.intrinsics_of(pinhole), turn, camera.height, x, y)
    raw = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    seen = np.stack(lens.undistort(kind, coefficients, *camera.normalized(raw)), axis=-1)
    part = raw[:, 1] / camera.height - 0.5
    rows = Rotation.from_rotvec(part[:, None] * turn)
    ray = rows.apply(np.concatenate([seen, np.ones((len(seen), 1))], axis=1))
    place = ray[:, :2] / ray[:, 2:] * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]
    expected = np.stack(np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height)), axis=-1)
    # the lens is linear between pixels, 0.5 degrees each, and beyond the rim
    inside = ((raw >= 0) & (raw <= [camera.width - 1, camera.height - 1])).all(axis=1)
    assert inside.mean() > 0.7
    np.testing.assert_allclose(place[inside], expected.reshape(-1, 2)[inside], atol=0.2)
    assert np.abs(raw - np.stack([across, down], axis=-1).reshape(-1, 2))[inside].max() > 1.0
