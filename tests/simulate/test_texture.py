"""Textures: kernels against their twins, and what makes them fit for photometry."""

import naive_texture
import numpy as np
import pytest

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import texture as kernel
from lvba.simulate import camera as cameras
from lvba.simulate import texture
from lvba.simulate.world import Builder, World

CAMERA = Camera(16, 12, 14.0, 14.0, 7.5, 5.5)
WALL_FROM_CAMERA = geometry.exp(np.array([0.5, 0.3, -0.2, 0.0, 0.0, 0.0]))


def wall(patches: float = 0.0, contrast: float = 1.0) -> World:
    """One square of 40 m in the plane z = 0."""
    world = Builder(np.random.default_rng(3))
    world.rectangle((-20, -20, 0), (40, 0, 0), (0, 40, 0), np.array([0.5, 0.4, 0.3, contrast, patches]))
    return world.build()


@pytest.fixture(scope="module")
def look() -> texture.Texture:
    return texture.build(wall(), np.random.default_rng(7))


def before_the_wall(distance: float) -> np.ndarray:
    scene_from_camera = WALL_FROM_CAMERA.copy()
    scene_from_camera[:3, 3] = (0.3, -0.2, -distance)
    return scene_from_camera


@pytest.mark.parametrize("foot", [1e-4, 3e-3, 0.05, 3.0])
def test_octaves_equal_their_twin(look, foot):
    for u, v in np.random.default_rng(1).uniform(-5, 30, (20, 2)):
        fast = kernel.octaves_product(u, v, foot, 0.0, 0, 1.0, look.phases[0], look.octaves, look.tile)
        np.testing.assert_allclose(fast[:3], naive_texture.octaves_product(look, 0, u, v, foot), rtol=2e-5)


def test_an_image_equals_its_twin(look):
    """Coarse octaves are taken once a pixel: that costs less than 2 % anywhere, and nothing in the mean."""
    rays = cameras.rays(CAMERA)
    quads = np.zeros(rays.shape[:3], np.int32)
    quads[0, 0, 1:] = -1
    pose, width = before_the_wall(2.0), 0.5 / CAMERA.fx
    fast = look.render(pose, rays, quads, width)
    slow = naive_texture.render(look, pose, rays, quads, width)
    np.testing.assert_allclose(fast, slow, rtol=0.02)
    assert abs(fast.mean() / slow.mean() - 1) < 5e-4
    np.testing.assert_allclose(fast[0, 0], slow[0, 0], rtol=1e-5)


def test_a_patch_covers_as_much_as_a_count_of_places_in_it():
    rng, spots, found = np.random.default_rng(5), (np.arange(60) + 0.5) / 60 - 0.5, 0
    for u, v in rng.uniform(0, 7, (400, 2)):
        covered = kernel.patch(u, v, 1e-9, 4, 0.9)[0]
        assert min(abs(covered), abs(covered - 1)) < 1e-6
        foot = 0.02
        share = kernel.patch(u, v, foot, 4, 0.9)[0]
        if 0 < share < 1:
            found += 1
            counted = np.mean(
                [kernel.patch(u + foot * a, v + foot * b, 1e-9, 4, 0.9)[0] for a in spots for b in spots]
            )
            # the footprint is a square along the patch's edges, the count one along u and v
            assert abs(share - counted) < 0.2
    assert found > 10


@pytest.mark.parametrize("foot", [0.01, 0.05])
def test_patches_seen_from_afar_have_the_area_they_have_from_near(foot):
    places = (np.arange(210) + 0.5) * 0.01
    area = {
        width: np.mean([kernel.patch(u, v, width, 4, 0.9)[0] for u in places for v in places])
        for width in (1e-9, foot)
    }
    assert area[1e-9] > 0.05
    assert area[foot] == pytest.approx(area[1e-9], rel=0.005)


def test_every_octave_fades_to_a_mean_of_one(look):
    places = np.random.default_rng(2).uniform(0, 40, (40_000, 2))
    products = np.array(
        [
            kernel.octaves_product(u, v, 1e-4, 0.0, 0, 1.0, look.phases[0], look.octaves, look.tile)[:3]
            for u, v in places
        ]
    )
    assert np.all(np.abs(products.mean(0) - 1) < 4 * products.std(0) / np.sqrt(len(places)) + 0.01)
    assert products.min() > 0
    assert products.std() > 0.2
    np.testing.assert_allclose(look.tile[..., :3].mean((0, 1)), 0, atol=1e-6)


def test_the_mean_over_an_area_does_not_depend_on_the_distance():
    """An exposure ratio measured from patch means must be the true one: 0.1 % would be seen."""
    look = texture.build(wall(patches=0.4), np.random.default_rng(11))
    straight = np.eye(4)
    means = []
    for zoom in (1, 2, 4):
        camera = Camera(64 * zoom, 64 * zoom, 64.0 * zoom, 64.0 * zoom, 32.0 * zoom - 0.5, 32.0 * zoom - 0.5)
        straight[:3, 3] = (0.5, 0.7, -4.0)
        rays = cameras.rays(camera)
        means.append(
            look.render(straight, rays, np.zeros(rays.shape[:3], np.int32), 0.5 / camera.fx).mean((0, 1))
        )
    np.testing.assert_allclose(means[0], means[2], rtol=1e-3)
    np.testing.assert_allclose(means[1], means[2], rtol=1e-3)


def test_a_render_has_the_same_bytes_for_any_number_of_threads(look):
    import numba

    rays = cameras.rays(CAMERA)
    quads = np.zeros(rays.shape[:3], np.int32)
    before = numba.get_num_threads()
    images = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            images.append(look.render(before_the_wall(3.0), rays, quads, 0.03).tobytes())
    finally:
        numba.set_num_threads(before)
    assert images[0] == images[1]
