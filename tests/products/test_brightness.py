"""Exposures by what a colored map shows of each image in the colors of the others."""

from dataclasses import replace

import box_world
import numpy as np
import pytest

from lvba import geometry
from lvba.products import brightness, evaluate


@pytest.mark.parametrize("off", [0.0, 0.03])
def test_exposures_are_those_of_the_images_wherever_poses_are_a_little_off(off):
    world = box_world.make()
    moved = np.random.default_rng(1).normal(0, [0.3 * off] * 3 + [off] * 3, (6, 6))
    views = [
        world.views(poses, log_exposure=np.zeros(6))
        for poses in (world.world_from_camera, geometry.retract(world.world_from_camera, moved))
    ]
    states = [evaluate.State(world.cloud(), each) for each in views]
    maps = list(zip(evaluate.color_by_paper(states), views, strict=True))
    estimated = brightness.log_exposures(maps[1:] if off else maps)
    true = world.log_exposure - world.log_exposure[0]
    assert np.abs(true).max() > 0.2
    np.testing.assert_allclose(estimated - estimated[0], true, atol=0.03 if off else 0.01)


def test_images_that_share_nothing_are_taken_as_they_are():
    world = box_world.make()
    views = world.views(log_exposure=np.zeros(6))
    cloud = world.cloud()
    nothing = evaluate.color_by_paper([evaluate.State(cloud, views)], np.arange(1, 6))[0]
    alone = brightness.log_exposures([(nothing, views)])
    assert alone.shape == (6,)
    assert np.isfinite(alone).all()


def test_a_map_that_no_image_colored_tells_nothing():
    world = box_world.make()
    views = world.views(log_exposure=np.zeros(6))
    blank = evaluate.color_by_paper([evaluate.State(world.cloud(), views)], np.arange(6))[0]
    assert not len(blank.source)
    np.testing.assert_array_equal(brightness.log_exposures([(blank, views)]), np.zeros(6))
    estimated, sigma = brightness.of_others(blank, views, np.array([1], np.int32), np.array([0], np.int32))
    assert np.isnan(estimated).all()
    assert np.isinf(sigma).all()


def test_exposures_of_images_that_colored_nothing_are_told_by_the_others():
    world = box_world.make()
    known, other = np.array([0, 1, 3, 4, 5], np.int32), np.array([2], np.int32)
    views = world.views()
    colored = evaluate.color_by_paper([evaluate.State(world.cloud(), views)], other)[0]
    dull = world.views(log_exposure=np.where(np.arange(6) == 2, 0.0, world.log_exposure))
    estimated, sigma = brightness.of_others(colored, dull, other, known)
    assert abs(world.log_exposure[2]) > 0.1
    assert estimated[0] == pytest.approx(world.log_exposure[2], abs=0.01)
    assert sigma[0] < 0.02


def test_an_image_that_somebody_stands_before_is_known_no_better_than_its_pixels_agree():
    world = box_world.make()
    known, other = np.array([0, 1, 3, 4, 5], np.int32), np.array([2], np.int32)
    views = world.views()
    colored = evaluate.color_by_paper([evaluate.State(world.cloud(), views)], other)[0]

    def behind_somebody(image):
        picture = views.load(image).copy()
        if image == 2:
            picture[: int(0.6 * len(picture))] = 35
        return picture

    covered = replace(views, load=behind_somebody)
    estimated, sigma = brightness.of_others(colored, covered, other, known)
    off = abs(estimated[0] - world.log_exposure[2])
    assert off > 0.1
    assert sigma[0] > 0.3 * off
    assert sigma[0] > 10 * brightness.of_others(colored, views, other, known)[1][0]


def test_few_known_images_tell_nothing_of_how_good_others_are():
    world = box_world.make()
    other = np.array([2], np.int32)
    colored = evaluate.color_by_paper([evaluate.State(world.cloud(), world.views())], other)[0]
    _, sigma = brightness.of_others(colored, world.views(), other, np.array([0, 1], np.int32))
    assert np.isinf(sigma).all()
