"""What hides an image is told by texture; blur, noise and plain walls are nothing that hides."""

import exposure_errors
import numpy as np
import pytest
from rectangle_world import CAMERA, room_with_screen

from lvba.visual import exposure, image, same_surface

IMAGES, PATCHES, CELLS = 12, 400, 20


def views(seen, noise=0.02, texture=0.05, plain=(), seed=0):
    """Comparisons of patches, each laid out in one image and seen in others: `hidden`'s arguments but for `images`.

    seen: (IMAGES,) part of the contrast of the surfaces that each image shows; plain: pieces of surface without any
    """
    rng = np.random.default_rng(seed)
    piece = rng.integers(0, CELLS, PATCHES)
    rough = np.where(np.isin(piece, plain), 0.0, texture) * rng.uniform(0.5, 2.0, PATCHES)
    reference = rng.integers(0, IMAGES, PATCHES)
    point = np.repeat(np.arange(PATCHES), 5)
    target = (reference[point] + rng.integers(1, IMAGES, len(point))) % IMAGES
    pattern = rng.normal(size=(PATCHES, 60))
    means = np.empty((len(point), 4))
    for row, (p, t) in enumerate(zip(point, target, strict=True)):
        one, other = (
            seen[i] * rough[p] * pattern[p] + noise * rng.normal(size=60) for i in (reference[p], t)
        )
        one, other = one - one.mean(), other - other.mean()
        means[row] = 1.0, 1.0, np.sqrt(np.mean((one - other) ** 2)), np.sqrt(np.mean(one**2 + other**2))
    position = np.column_stack([piece[point] + 0.5, np.full(len(point), 0.5), np.full(len(point), 0.5)])
    return means, position, reference[point], target


def of(given, image):
    """(N,) bool: comparisons of an image."""
    return (given[2] == image) | (given[3] == image)


def test_an_image_that_shows_something_else_is_told():
    seen = np.ones(IMAGES)
    seen[3] = 0.0
    given = views(seen)
    assert not same_surface.shown(*given, IMAGES)[of(given, 3)].any()
    assert same_surface.shown(*given, IMAGES)[~of(given, 3)].all()


def test_of_an_image_that_is_hidden_for_the_most_part_the_rest_counts():
    """Patches on the last pieces of surface are seen in it; others are not."""
    seen = np.ones(IMAGES)
    seen[3] = 0.0
    given, right = views(seen), views(np.ones(IMAGES))
    free = given[1][:, 0] > CELLS - 2
    means = np.where(free[:, None], right[0], given[0])
    shown = same_surface.shown(means, *given[1:], IMAGES)
    # half of the patches have less texture than is usual on their surfaces
    assert shown[of(given, 3) & free].mean() > 0.6
    assert shown[of(given, 3) & ~free].mean() < 0.02
    assert shown[~of(given, 3)].all()


@pytest.mark.parametrize("blurred", [0.45, 0.7])
def test_a_blurred_image_shows_the_surfaces(blurred):
    seen = np.ones(IMAGES)
    seen[3] = blurred
    assert same_surface.shown(*views(seen), IMAGES).all()


def test_plain_walls_and_noise_tell_nothing():
    seen = np.ones(IMAGES)
    seen[3] = 0.0
    assert same_surface.shown(*views(seen, texture=0.005), IMAGES).all()
    # some walls are plain: the others tell
    given = views(seen, plain=range(8))
    assert not same_surface.shown(*given, IMAGES)[of(given, 3)].any()
    assert same_surface.shown(*views(np.ones(IMAGES), plain=range(8)), IMAGES).all()


def test_no_comparison_tells_nothing():
    none = np.zeros(0, int)
    assert len(same_surface.shown(np.zeros((0, 4)), np.zeros((0, 3)), none, none, 3)) == 0


def test_the_exposure_of_an_image_that_something_fills_is_not_known():
    """As dark as it is, it agrees with all others about that; the exposures of these are as good as without it."""
    rec = room_with_screen()
    images, rng = rec.images.copy(), np.random.default_rng(4)
    usual = images[5].mean()
    images[5] = np.clip(0.9 * usual + 1.5 * rng.normal(size=images[5].shape), 1, 254).astype(np.uint8)
    pyramid = image.build_pyramid(images, CAMERA, 2)
    given = pyramid, rec.cameras, rec.surfaces, None
    taken = exposure.solve(*given)
    assert np.isfinite(taken.sigma[5])
    found = exposure.solve(*given, refined=True)
    others = np.arange(len(images)) != 5
    assert np.isinf(found.sigma[5])
    assert np.isfinite(found.sigma[others]).all()
    error = (found.log_exposure - np.log(rec.exposure))[others]
    assert np.std(error) < 0.003
    right = exposure.solve(image.build_pyramid(rec.images, CAMERA, 2), *given[1:], refined=True)
    assert np.isfinite(right.sigma).all()
    assert np.sqrt((exposure_errors.error(right, rec.exposure) ** 2).mean()) < 0.003
