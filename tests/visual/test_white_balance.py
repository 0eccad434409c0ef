"""Exposures by color: what is common to the colors is the exposure, the rest the white balance."""

from dataclasses import dataclass

import numpy as np
import pytest
from rectangle_world import CAMERA, room_with_screen

from lvba.camera import Camera
from lvba.products.views import Views
from lvba.visual import exposure, radiometry, white_balance
from lvba.visual.image import build_pyramid, grey
from lvba.visual.response import LINEAR, Response
from lvba.visual.result import with_white_balance
from lvba.visual.white_balance import WhiteBalance


def balances(count, size, seed=3):
    """(count, 3) log gains that drift, each 0 on average over images and over colors."""
    gain = size * np.sin(np.random.default_rng(seed).uniform(0, 6, 3) + 0.7 * np.arange(count)[:, None])
    gain -= gain.mean(axis=1, keepdims=True)
    return gain - gain.mean(axis=0)


def solve(rec, gain, **options):
    def colors(color):
        return np.clip(np.rint(rec.images * np.exp(gain[:, color])[:, None, None, None]), 0, 255).astype(
            np.uint8
        )

    given = colors, CAMERA, rec.cameras, rec.surfaces, None, radiometry.NONE, None
    return white_balance.solve(*given, **options)


def test_white_balance_and_exposures_of_a_room():
    rec = room_with_screen(count=5)
    gain = balances(len(rec.times), 0.08)
    found = solve(rec, gain)
    truth = np.log(rec.exposure)
    assert np.abs(found.log_exposure - truth + truth.mean()).max() < 0.006
    assert np.abs(found.log_gain - gain).max() < 0.006
    assert np.abs(found.log_gain.sum(axis=1)).max() < 1e-12


def test_white_balance_by_patches_that_are_there_already():
    """As where exposures were solved at the same poses before."""
    rec = room_with_screen(count=5)
    gain = balances(len(rec.times), 0.08)
    pyramid = build_pyramid(rec.images, CAMERA, 2)
    points = exposure.placed(pyramid, rec.cameras, rec.surfaces)
    depth = exposure.depth_of(pyramid, rec.cameras, rec.surfaces)
    found = solve(rec, gain, depth=depth, points=points)
    assert np.abs(found.log_gain - gain).max() < 0.006


def test_images_without_color_are_seen_at_once():
    rec = room_with_screen(count=3)
    assert solve(rec, np.zeros((3, 3))) is None


@pytest.mark.parametrize(("size", "full"), [(0.0, []), (0.08, [0, 1, 2])])
def test_large_images_are_asked_in_full_only_where_smaller_ones_see_a_change(size, full):
    rec, asked = room_with_screen(count=5), []
    gain = np.add(balances(len(rec.times), size), [0.0, 0.2, -0.2])

    def smaller(color):
        images = rec.images * np.exp(gain[:, color])[:, None, None, None]
        return np.clip(np.rint(images), 0, 255).astype(np.uint8)

    def colors(color):
        asked.append(color)
        return smaller(color).repeat(2, axis=1).repeat(2, axis=2)

    given = colors, CAMERA.scaled(2.0), rec.cameras, rec.surfaces, None, radiometry.NONE, None
    solved = white_balance.solve(*given, smaller=(smaller, CAMERA))
    assert asked == full
    assert (solved is None) == (size == 0.0)
    if solved is not None:
        assert np.abs(solved.log_gain - gain + gain.mean(axis=0)).max() < 0.006


@pytest.mark.parametrize(("size", "solves"), [(0.0, 3), (0.08, 6)])
def test_all_patches_are_asked_only_where_few_see_a_change(monkeypatch, size, solves):
    rec, asked, real = room_with_screen(count=3), [], white_balance.exposure.solve

    def counted(*arguments, points, **options):
        asked.append(len(points))
        return real(*arguments, points=points, **options)

    monkeypatch.setattr(white_balance.exposure, "solve", counted)
    found = solve(rec, np.add(balances(len(rec.times), size), [0.0, 0.2, -0.2]))
    assert (found is None) == (size == 0)
    assert len(asked) == solves
    assert asked[0] < asked[-1] / 3 or solves == 3


@pytest.mark.parametrize(
    ("size", "sigma", "found"), [(0.02, 0.002, True), (0.02, 0.02, False), (0.003, 1e-4, False)]
)
def test_changes_count_beyond_chance_and_where_they_can_be_seen(size, sigma, found):
    truth, gain = np.linspace(-0.2, 0.2, 40), balances(40, size)
    uncertain = np.full((40, 3), sigma)
    uncertain[5] = np.inf
    judged = white_balance.judged(truth[:, None] + gain + [0.0, 0.4, -0.3], uncertain)
    assert (judged is not None) == found
    if judged is not None:
        assert np.corrcoef(judged.log_exposure, truth)[0, 1] > 0.999
        assert judged.sigma[0] == pytest.approx(sigma)
        assert np.isinf(judged.sigma[5])


def test_nothing_that_is_compared_has_no_white_balance():
    assert white_balance.judged(np.zeros((5, 3)), np.full((5, 3), np.inf)) is None


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("curve", [LINEAR, Response((1.3, 1.2, 1.1, 1.0, 0.9, 0.8, 0.7), 0.01)])
def test_white_balance_is_taken_out_of_images(channels, curve):
    """Colored surfaces are as bright in all images then; what is clipped or dark stays what it is."""
    rng, gain = np.random.default_rng(7), balances(4, 0.08)
    true = rng.uniform(40, 200, (32, 48, 3)).astype(np.float32)
    seen = np.rint(curve.grey(curve.light(true) * np.exp(gain)[:, None, None])).astype(np.uint8)
    seen[:, 0, :5], seen[:, 1, :5] = 255, 0
    full = seen if channels == 3 else np.stack([grey(each) for each in seen])[..., None]
    pyramid = build_pyramid(full, Camera(width=48, height=32, fx=40.0, fy=40.0, cx=24.0, cy=16.0), 1)
    balance = WhiteBalance(np.zeros(4), np.full(4, 1e-3), gain)
    [found] = white_balance.taken_out_of(pyramid, lambda k: seen[..., k : k + 1], balance, curve).levels
    assert found.dtype == np.uint8
    assert (found[:, 0, :5] == 255).all()
    assert (found[:, 1, :5] == 0).all()
    wanted = true if channels == 3 else (true @ [0.299, 0.587, 0.114])[..., None]
    np.testing.assert_allclose(found[:, 2:], np.tile(wanted[2:], (4, 1, 1, 1)), atol=1.3)
    assert np.abs(full[:, 2:] - wanted[2:]).max() > 5


@pytest.mark.parametrize("light", [None, np.full((24, 32), 0.5, np.float32)])
def test_colors_are_divided_by_the_white_balance(light):
    picture = np.full((24, 32, 3), (50, 60, 70), np.uint8)
    picture[0, 0] = 255
    gain = np.log([[1.0, 1.0, 1.0], [1.25, 1.0, 0.7]])
    views = Views(
        lambda index: picture, CAMERA, np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)), np.zeros(2), light=light,
        white_balance=gain,
    )  # fmt: skip
    more = 1 if light is None else 2
    assert (views.load_even(0)[1:] == np.array([50, 60, 70]) * more).all()
    assert (views.load_even(1)[1:] == np.array([40, 60, 100]) * more).all()
    assert (views.load_even(1)[0, 0] == 255).all()


@dataclass(frozen=True)
class Solved:
    """What of a `VisualResult` colors change."""

    keyframes: np.ndarray
    log_exposure: np.ndarray
    log_exposure_sigma: np.ndarray
    white_balance: np.ndarray | None = None


def test_exposures_by_color_are_as_uncertain_as_vignetting_and_response_make_those_of_grey_values():
    """Both are taken out of the colors as grey values have them: what they may be off by, colors do not show."""
    times, keyframes = np.arange(5.0), np.array([0, 2, 4])
    grey_sigma = np.array([0.02, 0.02, 0.001, 0.001, np.inf])
    balance = WhiteBalance(np.array([0.0, 0.1, 0.2]), np.full(3, 0.004), np.zeros((3, 3)))
    result = with_white_balance(Solved(keyframes, np.zeros(5), grey_sigma), balance, times)
    np.testing.assert_allclose(result.log_exposure, [0.0, 0.05, 0.1, 0.1, 0.1], atol=1e-12)
    assert np.isinf(result.log_exposure_sigma[4]), (
        "grey values tell nothing of it: it is taken from its neighbor"
    )
    np.testing.assert_allclose(result.log_exposure_sigma[keyframes[:2]], [0.02, 0.004])
    assert result.log_exposure_sigma[1] >= 0.004
