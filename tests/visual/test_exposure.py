import cv2
import exposure_errors
import numba
import numpy as np
import pytest
from naive_points import blank_masked as naive_blank_masked
from naive_points import compare as naive_compare
from naive_points import warp_by_plane
from rectangle_world import CAMERA, look, plane_points, planes_of, rectangle, render, room_with_screen, scan

from lvba.camera import Camera
from lvba.kernels import patches_mean
from lvba.kernels.scene import PlanePatches
from lvba.lidar.plane import Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import exposure, image, visibility
from lvba.visual.image import Pyramid, intrinsics_of


def _solve(rec, images=None, levels=2):
    pyramid = image.build_pyramid(rec.images if images is None else images, CAMERA, levels)
    return exposure.solve(pyramid, rec.cameras, rec.surfaces, None)


def test_exposures_of_a_room():
    rec = room_with_screen()
    found = _solve(rec)
    error = exposure_errors.error(found, rec.exposure)
    assert np.sqrt((error**2).mean()) < 0.003
    assert (found.component == 0).all()
    assert 0.2 < np.mean((error / found.sigma) ** 2) < 4


def test_clipped_light_does_not_darken_the_brighter_image(monkeypatch):
    rec = room_with_screen()
    gain = np.where(np.arange(len(rec.images)) % 2, 1.7, 1.0)
    rng = np.random.default_rng(0)
    bright = np.clip(
        rec.images * gain[:, None, None, None] + rng.uniform(-0.5, 0.5, rec.images.shape), 0, 255
    )
    clipped = np.round(bright).astype(np.uint8)
    assert (clipped[1::2] >= 250).mean() > 0.05
    found = _solve(rec, clipped)
    error = exposure_errors.error(found, rec.exposure * gain)
    assert abs(error[1::2].mean() - error[::2].mean()) < 0.004
    # without keeping away from clipped spots the same images are off
    monkeypatch.setattr(exposure, "MASK_REACH", 0)
    monkeypatch.setattr(exposure, "BRIGHT", 250.0)
    near = exposure_errors.error(_solve(rec, clipped), rec.exposure * gain)
    assert abs(near[1::2].mean() - near[::2].mean()) > abs(error[1::2].mean() - error[::2].mean())


def _approach(seed):
    """A wall with fine texture seen from nearer and nearer, every view blurred by its pixels."""
    rng = np.random.default_rng(seed)
    wall = [rectangle([6, -6, -4], [0, 12, 0], [0, 0, 8], seed)]
    poses = np.array([look([0.5 * i, 0, 0], [6, 0.2, 0]) for i in range(6)])
    images = np.stack(
        [render(wall, CAMERA, p, 0.8, 1.0, rng, samples=3, finest=0.05, waves=10) for p in poses]
    )
    scans = plane_points([scan(wall, p[:3, 3], 8000, 0.01, rng) for p in poses])
    return images, poses, scans, planes_of(wall, 0.01)


def test_walking_ahead_does_not_add_up():
    slopes = []
    for seed in range(2):
        images, poses, scans, planes = _approach(seed)
        times = 0.2 * np.arange(len(poses))
        pyramid = image.build_pyramid(images, CAMERA, 2)
        found = exposure.solve(pyramid, Trajectory(times, poses), Surfaces(planes, scans, times), None)
        assert (found.component == 0).all()
        slopes.append(found.log_exposure[-1] - found.log_exposure[0])
    assert abs(np.mean(slopes)) < 0.003
    assert np.max(np.abs(slopes)) < 0.01


def test_hidden_patches_are_not_compared():
    rec = room_with_screen(sideways=True)
    pyramid = image.build_pyramid(rec.images, CAMERA, 2)
    args = (pyramid, rec.cameras, rec.surfaces, None)
    with_depth = exposure.solve(*args)
    without = exposure.solve(*args, depth=visibility.NOTHING_HIDES)
    assert with_depth.pairs < without.pairs
    assert np.sqrt((exposure_errors.error(with_depth, rec.exposure) ** 2).mean()) < 0.003


def test_a_part_of_the_patches_gives_exposures_to_begin_a_finer_level_from():
    rec = room_with_screen()
    pyramid = image.build_pyramid(rec.images, CAMERA, 2)
    few, every = (
        exposure.solve(pyramid, rec.cameras, rec.surfaces, None, cells=cells)
        for cells in (12, exposure.CELLS)
    )
    assert few.pairs < 0.5 * every.pairs
    assert np.sqrt((exposure_errors.error(few, rec.exposure) ** 2).mean()) < 0.005


def test_placing_does_not_look_at_the_images():
    rec = room_with_screen()
    args = (CAMERA.at_level(1), rec.cameras, rec.surfaces)
    half = image.build_pyramid(rec.images, CAMERA, 2).levels[1]
    first = exposure.place(half, *args)
    second = exposure.place(np.clip(255 - half, 1, 249).astype(np.uint8), *args)
    np.testing.assert_array_equal(first.pixel, second.pixel)
    assert len(first) > 100


@pytest.mark.parametrize("dilation", [0, 1])
@pytest.mark.parametrize("channels", [1, 3])
def test_measuring_matches_its_twin(dilation, channels):
    rec = room_with_screen()
    images = np.repeat(rec.images[:4], channels, axis=3)
    images[1, 70:80, 90:110] = 255
    images = naive_blank_masked(images, dilation, 3, 250)
    finer = np.repeat(np.repeat(images, 2, axis=1), 2, axis=2)
    coarser = np.ascontiguousarray(images[:, ::2, ::2])
    camera, rng = CAMERA, np.random.default_rng(0)
    pixel = np.column_stack([rng.integers(20, 180, 40), rng.integers(20, 130, 40)]).astype(np.int32)
    reference = rng.integers(0, 4, 40).astype(np.int32)
    position = rec.poses[reference, :3, 3] + 3 * rec.poses[reference, :3, 2]
    normal = -rec.poses[reference, :3, 2]
    target = ((reference + rng.integers(1, 4, 40)) % 4).astype(np.int32)
    poses = rec.poses[:4].copy()
    poses[3, :3, 3] += 1.6 * poses[3, :3, 2]  # one much nearer, so that other levels are read
    gates = exposure.mean_gates()._replace(
        min_normal_cosine=0.2, min_scale=0.3, max_scale=4.0, min_usable=0.5
    )
    intrinsics = intrinsics_of(camera)
    found = patches_mean.measure_pairs(
        finer, images, coarser, poses, intrinsics, PlanePatches(position, normal, reference, pixel),
        np.arange(40, dtype=np.int32), target, 7, gates, visibility.NOTHING_HIDES.at(camera),
    )  # fmt: skip
    used = 0
    for k in range(40):
        r, t = poses[reference[k]], poses[target[k]]

        def moved(du, dv, k=k, r=r, t=t):
            return warp_by_plane(pixel[k, 0] + du, pixel[k, 1] + dv, r, t, position[k], normal[k], intrinsics)

        e = 1e-4
        jacobian = np.array(
            [np.subtract(moved(e, 0)[:2], moved(-e, 0)[:2]), np.subtract(moved(0, e)[:2], moved(0, -e)[:2])]
        )
        jacobian = jacobian.T / (2 * e)
        scale = np.sqrt(abs(np.linalg.det(jacobian)))
        shrink, source = (
            (0.5, coarser) if scale > 2**0.5 else (2.0, finer) if scale < 0.5**0.5 else (1.0, images)
        )
        expected = naive_compare(
            images[reference[k]], source[target[k]], pixel[k], moved, shrink, jacobian, 7, 0.5
        )
        if found[k, 0] < 0:
            continue
        used += 1
        np.testing.assert_allclose(found[k], expected, rtol=1e-6, atol=1e-6)
    assert used > 15


def test_a_farther_view_of_rough_texture_is_not_brighter():
    """Exact pictures of one plane from 1 and 1.4 m: pixels are means over 10 x 10 and 14 x 14 texels."""
    rng, side = np.random.default_rng(5), 300
    texels = np.exp(0.45 * 32 * cv2.GaussianBlur(rng.standard_normal((10 * side, 10 * side)), (0, 0), 9))
    texels *= 40 / texels.mean()
    near = texels.reshape(side, 10, side, 10).mean(axis=(1, 3))
    far, first, count = np.zeros((side, side)), side // 7 + 2, 5 * side // 7 - 4
    start = 14 * first - 2 * side
    part = texels[start : start + 14 * count, start : start + 14 * count]
    far[first : first + count, first : first + count] = part.reshape(count, 14, count, 14).mean(axis=(1, 3))
    rounded = [np.floor(each + rng.random(each.shape)) for each in (near, far)]
    images = np.minimum(np.stack(rounded), 255).astype(np.uint8)[..., None]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 2, 3] = -0.4
    camera = Camera(side, side, float(side), float(side), (side - 1) / 2, (side - 1) / 2)
    column, row = (each.ravel() for each in np.meshgrid(*2 * [np.arange(15, side - 15, 3)]))
    pixel = np.stack([column, row], axis=1).astype(np.int32)
    position = np.column_stack([(pixel - (side - 1) / 2) / side, np.ones(len(pixel))])
    patches = PlanePatches(
        position, np.tile([0.0, 0.0, -1.0], (len(pixel), 1)), np.zeros(len(pixel), np.int32), pixel
    )
    means = patches_mean.measure_pairs(
        images, images, images, poses, intrinsics_of(camera), patches,
        np.arange(len(pixel), dtype=np.int32), np.ones(len(pixel), np.int32), 11, exposure.mean_gates(),
        visibility.NOTHING_HIDES.at(camera),
    )  # fmt: skip
    good = means[:, 0] > 0
    ratio = np.log(means[good, 1] / means[good, 0])
    assert good.mean() > 0.8
    assert abs(ratio.mean()) < 0.0003


def test_same_bytes_for_any_number_of_threads():
    rec, results, before = room_with_screen(), [], numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        found = _solve(rec)
        results.append((found.log_exposure.tobytes(), found.sigma.tobytes()))
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_pyramid_too_short_is_extended():
    rec = room_with_screen()
    full = image.build_pyramid(rec.images, CAMERA, 3)
    short = Pyramid(full.levels[:1], CAMERA, full.noise[:1])
    args = (rec.cameras, rec.surfaces, None)
    np.testing.assert_array_equal(
        exposure.solve(short, *args).log_exposure, exposure.solve(full, *args).log_exposure
    )
