from dataclasses import replace

import numba
import numpy as np
import pytest
from rectangle_world import CAMERA, room_with_screen

from lvba.camera import Camera
from lvba.lens import Lens
from lvba.visual import exposure, image, radiometry, vignetting
from lvba.visual.exposure_graph import BLOCKS
from lvba.visual.image import Undistorter
from lvba.visual.radiometry import Radiometry
from lvba.visual.ratios import Ratios
from lvba.visual.vignetting import NONE, PairPlaces, Vignetting

TRUE = Vignetting((-0.3, -0.2, 0.05), (0.01, -0.015))
LENSES = {
    "pinhole": Camera(160, 120, 130.0, 131.0, 82.0, 57.0),
    "radial": Camera(160, 120, 130.0, 131.0, 82.0, 57.0, (-0.12, 0.03, 5e-4, -4e-4)),
    "fisheye": Camera(160, 120, 70.0, 70.5, 82.0, 57.0, (0.02, -0.01, 0.003, 0.0), Lens.EQUIDISTANT),
}


def make(rng, found=TRUE, images=12, per_pair=60, sigma=0.01):
    """Log ratios of patches that move by a quarter of the picture in successive images, and their exposures."""
    truth = np.cumsum(0.2 * rng.standard_normal(images))
    first = np.repeat(np.arange(images - 2), 2 * per_pair)
    second = first + 1 + np.tile(np.repeat([0, 1], per_pair), images - 2)
    reference = rng.uniform(-0.7, 0.7, (len(first), 2))
    target = np.clip(reference + rng.uniform(-0.25, 0.25, reference.shape), -0.7, 0.7)
    places = PairPlaces(reference, target)
    value = truth[second] - truth[first] + places.log_ratio(found) + sigma * rng.standard_normal(len(first))
    block = rng.integers(0, BLOCKS, len(first))
    spread = np.full(len(first), sigma)
    level = np.full(len(first), np.log(100.0))
    return truth, Ratios(
        first.astype(np.int32), second.astype(np.int32), value, spread, block, block, level,
        np.arange(len(first)), places,
    )  # fmt: skip


def solve(ratios, images=12):
    return exposure.solve_ratios(ratios, images)


def light_at(found, squares):
    return np.exp(found.log_light(np.stack([np.sqrt(squares), np.zeros_like(squares)], axis=1)))


def test_derivatives_are_differences():
    rng = np.random.default_rng(0)
    places = PairPlaces(*rng.uniform(-0.65, 0.65, (2, 50, 2)))
    found = places.by_numbers(TRUE)
    for number in range(vignetting.NUMBERS):
        step = np.zeros(vignetting.NUMBERS)
        step[number] = 1e-6
        ends = [places.log_ratio(vignetting.of_numbers(TRUE.numbers + sign * step)) for sign in (1, -1)]
        np.testing.assert_allclose(found[:, number], (ends[0] - ends[1]) / 2e-6, atol=1e-8)


def test_it_is_found_beside_exposures_that_change():
    truth, ratios = make(np.random.default_rng(1))
    found = solve(ratios)
    squares = np.linspace(0, 1, 11)
    np.testing.assert_allclose(
        light_at(replace(found.radiometry.vignetting, center=(0, 0)), squares),
        light_at(replace(TRUE, center=(0, 0)), squares),
        atol=0.02,
    )
    np.testing.assert_allclose(found.radiometry.vignetting.center, TRUE.center, atol=0.01)
    assert found.radiometry.vignetting.corner_loss == pytest.approx(
        TRUE.corner_loss, abs=4 * found.radiometry.vignetting.loss_sigma
    )
    error = found.log_exposure - truth
    assert np.std(error) < 0.005
    without = solve(replace(ratios, places=None))
    assert without.radiometry.vignetting == NONE


def test_wrong_patches_do_little():
    rng = np.random.default_rng(2)
    _, ratios = make(rng)
    value = ratios.value.copy()
    value[rng.random(len(value)) < 0.15] -= 0.5
    found = solve(replace(ratios, value=value)).radiometry.vignetting
    assert found.corner_loss == pytest.approx(TRUE.corner_loss, abs=0.03)


def test_what_drifts_with_the_images_is_no_vignetting():
    """Every image seems brighter than the one before by the same: only an exposure can be that."""
    rng = np.random.default_rng(3)
    _, ratios = make(rng, NONE)
    drifting = ratios.value + 0.2 * (ratios.second - ratios.first)
    assert not solve(replace(ratios, value=drifting)).radiometry.vignetting


def test_none_is_found_where_there_is_none_and_where_nothing_tells():
    assert (
        sum(
            bool(solve(make(np.random.default_rng(seed), NONE)[1]).radiometry.vignetting)
            for seed in range(40)
        )
        == 0
    )
    _, ratios = make(np.random.default_rng(4))
    still = replace(ratios, places=PairPlaces(ratios.places.reference, ratios.places.reference))
    assert solve(still).radiometry.vignetting.coefficients == NONE.coefficients
    none = np.zeros(0, int)
    assert not radiometry.solve(exposure.radiometry_sums(none, np.zeros(0), ratios.take(none)))


@pytest.mark.parametrize(
    "impossible", [Vignetting((0.4, 0.0, 0.0)), Vignetting((-2.5, 0.0, 0.0)), Vignetting((-1.5, 1.5, 0.0))]
)
def test_what_no_lens_does_is_refused(impossible):
    found = solve(make(np.random.default_rng(5), impossible, sigma=0.002)[1]).radiometry.vignetting
    light = light_at(found, np.linspace(0, 1, 50))
    assert light.min() >= vignetting.LEAST_LIGHT
    assert (light <= np.minimum.accumulate(light) + vignetting.RISE).all()


def test_a_small_one_is_left_alone():
    small = Vignetting((-0.004, 0.0, 0.0))
    assert not solve(
        make(np.random.default_rng(6), small, per_pair=2000, sigma=0.001)[1]
    ).radiometry.vignetting


def test_parts_add_up_to_the_whole():
    _, ratios = make(np.random.default_rng(7))
    whole = exposure.edges_of(ratios, 12)

    def part(mine):
        return exposure.edges_of(ratios.take(mine), 12)

    halves = [part(ratios.first < 6), part(ratios.first >= 6)]
    joint = radiometry.solve(halves[0].known + halves[1].known)
    np.testing.assert_allclose(joint.numbers, whole.radiometry.numbers, atol=0.01)
    means = np.concatenate([each.supposing(joint) for each in halves])
    np.testing.assert_allclose(means, whole.supposing(joint), atol=1e-3)
    np.testing.assert_allclose(whole.supposing(whole.radiometry), whole.mean)


def test_a_mean_weighs_what_each_part_knows():
    sure, vague = replace(TRUE, loss_sigma=0.001), Vignetting((-1.0, 0.0, 0.0), (0.0, 0.0), 0.1)
    mean_of = {
        "both": radiometry.mean([Radiometry(sure), Radiometry(vague)]).vignetting,
        "one": radiometry.mean([Radiometry(NONE), Radiometry(sure)]).vignetting,
        "none": radiometry.mean([Radiometry(NONE), Radiometry(NONE)]).vignetting,
    }
    assert mean_of["both"].numbers == pytest.approx(TRUE.numbers, abs=2e-4)
    assert mean_of["one"].numbers == pytest.approx(TRUE.numbers)
    assert mean_of["one"].loss_sigma == pytest.approx(0.001)
    assert mean_of["none"] == NONE


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("measuring", [False, True])
def test_light_is_that_of_the_raw_pixel(name, measuring):
    camera = LENSES[name]
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    half = 0.5 * np.hypot(camera.width, camera.height)
    places = np.stack([column - camera.cx, row - camera.cy], axis=-1).reshape(-1, 2) / half
    raw = 240 * np.exp(TRUE.log_light(places)).reshape(camera.height, camera.width)
    pinhole = image.measuring_camera(camera) if measuring else camera.undistorted()
    seen = Undistorter(camera, pinhole)(np.rint(raw).astype(np.uint8))
    inside = seen > 0
    assert inside.mean() > 0.6
    light = vignetting.light_of_pixels(TRUE, camera, pinhole)
    np.testing.assert_allclose(240 * light[inside], seen[inside], atol=1.5)
    half_size = vignetting.light_of_pixels(TRUE, camera, pinhole.at_level(1))
    blocks = light[: 2 * half_size.shape[0], : 2 * half_size.shape[1]]
    blocks = blocks.reshape(half_size.shape[0], 2, half_size.shape[1], 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half_size, blocks, atol=2e-3)


def test_dividing_keeps_what_is_no_measurement():
    images = np.array([0, 1, 3, 4, 100, 200, 249, 250, 255], np.uint8)[None, None, :, None]
    light = np.full((1, 9), 0.5, np.float32)
    divided = radiometry.divided(images, light)
    assert divided.ravel().tolist() == [0, 1, 3, 8, 200, 255, 255, 255, 255]
    even = radiometry.divided(images, np.ones((1, 9), np.float32))
    assert even.ravel().tolist() == [0, 1, 3, 4, 100, 200, 249, 255, 255]
    assert radiometry.NONE.taken_out_of(images, CAMERA, CAMERA) is images


def dark_room(found):
    rec = room_with_screen()
    light = vignetting.light_of_pixels(found, CAMERA, CAMERA)
    rng = np.random.default_rng(0)
    dark = rec.images * light[..., None] + rng.uniform(-0.5, 0.5, rec.images.shape)
    return rec, np.clip(np.rint(dark), 0, 255).astype(np.uint8)


def found_in(rec, images, raw=CAMERA):
    pyramid = image.build_pyramid(images, CAMERA, 2)
    return exposure.solve(pyramid, rec.cameras, rec.surfaces, None, raw=raw)


def test_vignetting_of_a_room():
    rec, images = dark_room(TRUE)
    found = found_in(rec, images)
    assert found.radiometry.vignetting.corner_loss == pytest.approx(TRUE.corner_loss, abs=0.05)
    errors = []
    for each in (found, found_in(rec, images, raw=None)):
        error = each.log_exposure - np.log(rec.exposure)
        errors.append(float(np.std(error)))
    assert errors[0] < 0.005
    assert errors[0] < 0.5 * errors[1]


def test_a_clean_room_has_none():
    rec = room_with_screen()
    assert not found_in(rec, rec.images).radiometry.vignetting


def test_same_bytes_for_any_number_of_threads():
    rec, images = dark_room(TRUE)
    results, before = [], numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        found = found_in(rec, images)
        results.append((found.radiometry.vignetting, found.log_exposure.tobytes()))
    numba.set_num_threads(before)
    assert results[0] == results[1]
