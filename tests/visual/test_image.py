import numpy as np
import pytest
from naive_points import blank_masked as naive_blank_masked
from naive_points import halve as naive_halve

from lvba import lens
from lvba.camera import Camera
from lvba.kernels.noise import block_residuals
from lvba.kernels.patches_pyramid import blank_masked, halve
from lvba.visual import image
from lvba.visual.image import ImageConfig

DISTORTED = Camera(160, 120, 130.0, 131.0, 81.0, 58.0, (-0.2, 0.05, 0.002, -0.001))


def _wave(u, v):
    return 128 + 50 * np.sin(0.11 * u + 0.3) * np.cos(0.09 * v) + 20 * np.sin(0.05 * (u + v))


def _distort(camera, u, v):
    """Where the ray of an undistorted pixel lies in the raw image: the radial-tangential model written out."""
    k1, k2, p1, p2 = camera.distortion
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return camera.fx * xd + camera.cx, camera.fy * yd + camera.cy


def test_undistorted_pixels_show_what_their_ray_saw():
    v, u = np.mgrid[:120, :160].astype(float)
    raw = np.round(_wave(u, v)).astype(np.uint8)
    ud, vd = _distort(DISTORTED, u, v)
    inside = (ud >= 1) & (ud <= 158) & (vd >= 1) & (vd <= 118)
    result = image.undistort(raw, DISTORTED).astype(float)
    assert np.abs(result - _wave(ud, vd))[inside].max() < 1.5
    assert np.abs(raw - _wave(ud, vd))[inside].max() > 10, "the distortion must matter here"


@pytest.mark.parametrize("channels", [1, 3])
def test_clipped_is_what_is_mixed_of_a_clipped_pixel_and_nothing_else(channels):
    rng = np.random.default_rng(5)
    raw = rng.integers(90, 110, (120, 160, channels)).astype(np.uint8)
    raw[rng.uniform(size=raw.shape) < 0.004] = 255
    raw = raw.reshape(raw.shape if channels > 1 else raw.shape[:2])
    v, u = np.mgrid[:120, :160].astype(float)
    ud, vd = _distort(DISTORTED, u, v)
    left, top = np.floor(ud).astype(int), np.floor(vd).astype(int)
    inside = (left >= 1) & (left <= 157) & (top >= 1) & (top <= 117)
    # the map is of float32: next to whole pixels it may be on the other side
    inside &= (np.abs(ud - np.rint(ud)) > 1e-3) & (np.abs(vd - np.rint(vd)) > 1e-3)
    result = image.undistort(raw, DISTORTED)
    for row, column in zip(*np.nonzero(inside), strict=True):
        mixed = raw[
            top[row, column] - 1 : top[row, column] + 3, left[row, column] - 1 : left[row, column] + 3
        ]
        np.testing.assert_array_equal(result[row, column] == 255, (mixed == 255).any(axis=(0, 1)))


def test_pixels_without_image_are_black_and_clipped_ones_stay_clipped():
    pincushion = Camera(160, 120, 130.0, 130.0, 79.5, 59.5, (0.3, 0.0, 0.0, 0.0))
    raw = np.full((120, 160, 3), 130, np.uint8)
    raw[60, 40] = 255
    result = image.undistort(raw, pincushion)
    assert (result[0, 0] == 0).all()
    assert (result[60, 80] == 130).all()
    values = np.unique(result)
    assert set(values) <= {0, 130, 255}, "no mixture of clipped and good pixels"
    assert (result == 255).any()


def _fine_texture(rng, x, y, focal):
    """Waves of 2.6 to 4 pixels in all directions over normalized coordinates."""
    total = np.zeros(x.shape)
    for _ in range(80):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        wave = focal * rng.uniform(1.6, 2.4)
        total += np.cos(wave * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return 128 + 6 * total


def _pulled_outwards(found, meant, x, y):
    """By how many pixels details lie further from the middle than they should, least squares over a ring."""
    down, across = np.gradient(meant)
    radius = np.hypot(x, y)
    outwards = (across * x + down * y) / np.maximum(radius, 1e-9)
    ring = (radius > 0.1) & (radius < 0.2)
    return -float((outwards * (found - meant))[ring].sum() / np.square(outwards[ring]).sum())


def test_fine_details_are_not_pulled_to_one_side_where_poses_are_measured():
    camera = Camera(480, 400, 500.0, 500.0, 239.5, 199.5, (-0.08, 0.0, 0.0, 0.0))
    wider = image.measuring_camera(camera)
    row, column = np.mgrid[:400, :480].astype(float)
    pulled = {camera.undistorted(): [], wider: []}
    for seed in range(6):
        raw_x, raw_y = lens.undistort(
            camera.lens, camera.distortion, (column - 239.5) / 500, (row - 199.5) / 500
        )
        raw = np.round(_fine_texture(np.random.default_rng(seed), raw_x, raw_y, 500)).astype(np.uint8)
        for pinhole, errors in pulled.items():
            x, y = (column - pinhole.cx) / pinhole.fx, (row - pinhole.cy) / pinhole.fy
            meant = _fine_texture(np.random.default_rng(seed), x, y, 500)
            errors.append(_pulled_outwards(image.Undistorter(camera, pinhole)(raw), meant, x, y))
    usual, ours = (abs(np.mean(errors)) for errors in pulled.values())
    assert usual > 0.02, "there is something to avoid"
    assert ours < 0.003


def test_poses_are_measured_in_images_that_show_all_that_the_usual_ones_show():
    wider = image.measuring_camera(DISTORTED)
    assert (wider.cx, wider.cy, wider.width, wider.height) == (81.0, 58.0, 160, 120)
    assert wider.fx < DISTORTED.fx
    assert not any(wider.distortion)
    plain = DISTORTED.undistorted()
    assert image.measuring_camera(plain) == plain, "nothing is resampled without need"
    raw = np.full((120, 160, 3), 120, np.uint8)
    pyramid = image.load_images(lambda _: raw, 2, DISTORTED, 2)
    assert pyramid.camera == wider
    assert (pyramid.levels[0][0, 50:70, 70:90] == 120).all()


FISHEYE = Camera(320, 240, 115.0, 114.0, 157.0, 121.0, (0.02, -0.005, 0.003, 0.001), lens.Lens.EQUIDISTANT)


def _off_axis(pinhole, u, v):
    return np.degrees(np.arctan(np.hypot((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy)))


def test_images_of_a_fisheye_are_used_up_to_65_degrees_or_their_rim():
    wide = image.measuring_camera(FISHEYE)
    left, right = _off_axis(wide, 0, wide.cy), _off_axis(wide, wide.width - 1, wide.cy)
    assert 64 < left <= 65
    assert 64 < right <= 65
    # upwards the picture ends before
    _, y = lens.undistort(FISHEYE.lens, FISHEYE.distortion, np.array([0.0]), np.array([-121.0 / 114.0]))
    rim = np.degrees(np.arctan(-y[0]))
    assert rim < 64
    assert rim - 1 < _off_axis(wide, wide.cx, 0) <= rim


def test_a_fisheye_in_a_wide_pinhole_shows_what_each_ray_saw():
    v, u = np.mgrid[:240, :320].astype(float)
    pyramid = image.load_images(
        lambda _: np.round(_wave(u, v)).astype(np.uint8)[..., None].repeat(3, 2), 1, FISHEYE, 2
    )
    wide = pyramid.camera
    assert pyramid.levels[0].shape == (1, wide.height, wide.width, 1)
    v, u = np.mgrid[: wide.height, : wide.width].astype(float)
    x, y = lens.distort(FISHEYE.lens, FISHEYE.distortion, (u - wide.cx) / wide.fx, (v - wide.cy) / wide.fy)
    raw_u, raw_v = FISHEYE.fx * x + FISHEYE.cx, FISHEYE.fy * y + FISHEYE.cy
    inside = (raw_u >= 1) & (raw_u <= 318) & (raw_v >= 1) & (raw_v <= 238)
    seen = pyramid.levels[0][0, ..., 0].astype(float)
    assert np.abs(seen - _wave(raw_u, raw_v))[inside].max() < 1.5
    assert (seen[(raw_u < -1) | (raw_u > 320) | (raw_v < -1) | (raw_v > 240)] == 0).all()
    assert inside[:, :20].any(), "the borders show something"
    assert inside[:, -20:].any()


def test_no_distortion_leaves_the_image_alone():
    raw = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    assert image.undistort(raw, DISTORTED.undistorted()) is raw


@pytest.mark.parametrize("shape", [(2, 12, 16, 1), (1, 13, 15, 3)])
def test_halve_matches_its_twin(shape):
    images = np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)
    np.testing.assert_array_equal(halve(images, 250), naive_halve(images, 250))


def test_halve_keeps_pixel_centres_and_brightness():
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    v, u = np.mgrid[:48, :64]
    ramp = (10 + 3 * u + v)[None, :, :, None].astype(np.uint8)
    half, small = halve(ramp, 256), camera.at_level(1)
    # the same rays at both levels
    vh, uh = np.mgrid[:24, :32]
    x, y = (uh - small.cx) / small.fx, (vh - small.cy) / small.fy
    at_full = 10 + 3 * (camera.fx * x + camera.cx) + camera.fy * y + camera.cy
    assert np.abs(half[0, :, :, 0] - at_full).max() <= 0.5
    noise = np.random.default_rng(0).integers(60, 180, (4, 256, 256, 1)).astype(np.uint8)
    assert halve(halve(noise, 256), 256).mean() == pytest.approx(noise.mean(), abs=0.02)


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_blank_masked_matches_its_twin(reach):
    images = np.random.default_rng(2).integers(0, 256, (3, 20, 30, 2)).astype(np.uint8)
    images[:, 5:15, 5:25] = np.clip(images[:, 5:15, 5:25], 30, 200)
    np.testing.assert_array_equal(
        blank_masked(images, reach, 4.0, 248.0), naive_blank_masked(images, reach, 4, 248)
    )


@pytest.mark.parametrize("sigma", [0.8, 2.0, 6.0])
def test_sensor_noise_of_white_noise_on_a_slope(sigma):
    rng = np.random.default_rng(3)
    ramp = np.linspace(60, 180, 320)[None, None, :, None]
    images = np.clip(np.round(ramp + sigma * rng.standard_normal((6, 240, 320, 1))), 0, 255).astype(np.uint8)
    assert image.sensor_noise(images) == pytest.approx(np.hypot(sigma, 0.289), rel=0.05)


def test_sensor_noise_looks_past_texture_and_masked_pixels():
    rng = np.random.default_rng(4)
    clean = np.full((4, 240, 320), 100.0)
    clean[:, :, 80:] += 40 * rng.standard_normal((4, 240, 240))
    clean[:, 100:150, :] = 255
    images = np.clip(np.round(clean + 2 * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)
    images[:, 100:150] = 255
    assert image.sensor_noise(images[..., None]) == pytest.approx(2.02, rel=0.1)


def test_pyramid_noise_falls_with_every_level():
    rng = np.random.default_rng(5)
    full = np.clip(100 + 30 * rng.standard_normal((3, 120, 160, 1)), 1, 249).astype(np.uint8)
    pyramid = image.build_pyramid(full, DISTORTED.undistorted(), 3)
    assert (pyramid.noise[1:] <= np.hypot(0.66 * pyramid.noise[:-1], 0.3)).all()
    assert [level.shape[1:3] for level in pyramid.levels] == [(120, 160), (60, 80), (30, 40)]


def test_load_images_makes_grey_and_color_alike():
    rng = np.random.default_rng(6)
    raw = rng.integers(20, 220, (5, 120, 160, 3)).astype(np.uint8)
    raw[2, 50, 60] = (255, 30, 30)
    calls = []
    camera = DISTORTED.undistorted()
    config = ImageConfig(channels=1)
    pyramid = image.load_images(raw.__getitem__, 5, camera, 2, config, lambda *a: calls.append(a))
    expected = raw @ [0.299, 0.587, 0.114]
    expected[2, 50, 60] = 255
    assert np.abs(pyramid.levels[0][..., 0] - expected).max() <= 1
    assert calls[-1] == ("images", 5, 5)
    assert sum(level.nbytes for level in pyramid.levels) == image.memory_bytes(5, camera, 2)
    color = image.load_images(raw.__getitem__, 5, camera, 1, ImageConfig(channels=3))
    np.testing.assert_array_equal(color.levels[0], raw)


def test_usable_levels_stop_before_images_get_tiny():
    assert image.usable_levels(Camera(640, 480, 500, 500, 320, 240), 6) == 4
    assert image.usable_levels(Camera(1408, 376, 500, 500, 320, 240), 6) == 5
    assert image.usable_levels(Camera(1408, 376, 500, 500, 320, 240), 4) == 4
    assert image.usable_levels(Camera(150, 100, 100, 100, 74.5, 49.5), 3) == 1


@pytest.mark.parametrize("bad", [{"channels": 2}])
def test_image_config_refuses(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        ImageConfig(**bad)


def naive_block_residuals(picture, block, saturated):
    """By the definition, block by block."""
    values, kept = picture.astype(float), []
    for top in range(1, picture.shape[0] - block, block):
        for left in range(1, picture.shape[1] - block, block):
            inner = picture[top : top + block, left : left + block]
            if inner.shape != (block, block) or (inner == 0).any() or (inner >= saturated).any():
                continue
            outer = values[top - 1 : top + block + 1, left - 1 : left + block + 1]
            kept.append(np.abs(np.diff(np.diff(outer, 2, axis=0), 2, axis=1)).mean())
    return np.array(kept)


@pytest.mark.parametrize("shape", [(18, 18), (17, 40), (50, 67), (80, 35), (1, 30), (40, 0)])
def test_residuals_of_blocks_are_as_by_the_definition(shape):
    rng = np.random.default_rng(shape[1])
    picture = rng.integers(1, 250, shape, np.uint8)
    picture[rng.random(shape) < 0.001] = 0
    picture[rng.random(shape) < 0.001] = 252
    blocks = block_residuals(picture, 16, image.SATURATED)
    assert blocks.dtype == np.float32
    assert np.array_equal(blocks, naive_block_residuals(picture, 16, image.SATURATED).astype(np.float32))
