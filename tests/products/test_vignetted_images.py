"""Images whose corners are dark, beside the map and the renderings that suppose it."""

from dataclasses import replace

import box_world
import numpy as np
import pytest
import yaml

from lvba.errors import InputError
from lvba.io import calibration
from lvba.products import colorize, evaluate, pictures, recorded_images
from lvba.products.evaluate import State
from lvba.visual import response, vignetting
from lvba.visual.vignetting import Vignetting

FOUND = Vignetting((-0.5, -0.15, 0.0), (0.01, 0.02))
LIGHT = vignetting.light_of_pixels(FOUND, box_world.CAMERA, box_world.CAMERA)


@pytest.fixture(scope="module")
def bright():
    return box_world.make()


@pytest.fixture(scope="module")
def dark(bright):
    seen = np.rint(bright.pictures * LIGHT[..., None]).astype(np.uint8)
    return replace(bright, pictures=seen)


def test_colors_are_those_of_even_images(bright, dark):
    cloud = bright.cloud()
    views = replace(dark.views(), light=LIGHT)
    truth = box_world.texture(cloud.points_world)
    for light, most in ((LIGHT, 4.0), (None, 60.0)):
        one = colorize.paper(cloud, replace(views, light=light))
        seen = one.source >= 0
        error = one.radiance(views.log_exposure)[seen] - truth[seen]
        assert (np.sqrt((error**2).mean()) < most) == (light is not None or most > 50)
    several = colorize.blended(cloud.points_world, views)
    seen = several.views > 0
    assert np.sqrt(((several.radiance - truth)[seen] ** 2).mean()) < 5
    plain = colorize.blended(cloud.points_world, dark.views())
    assert np.sqrt(((plain.radiance - truth)[seen] ** 2).mean()) > 15


@pytest.mark.parametrize("colors", ["paper", "blended"])
def test_a_state_with_vignetting_predicts_the_images_as_they_were_taken(bright, dark, colors):
    cloud, views = bright.cloud(), dark.views()
    states = {
        "even": State(cloud, views),
        "known": State(cloud, replace(views, light=LIGHT)),
        "wrong": State(cloud, replace(views, light=np.sqrt(LIGHT))),
    }
    alone = {name: evaluate.evaluate({name: state}, colors=colors)[name] for name, state in states.items()}
    assert alone["known"].psnr_leave_one_out > alone["wrong"].psnr_leave_one_out + 1
    assert alone["wrong"].psnr_leave_one_out > alone["even"].psnr_leave_one_out + 1
    states.pop("wrong")
    both = evaluate.evaluate(states, colors=colors)
    for name in states:
        np.testing.assert_array_equal(
            both[name].per_image["psnr_leave_one_out"], alone[name].per_image["psnr_leave_one_out"]
        )
    clean = evaluate.evaluate({"clean": State(cloud, bright.views())}, colors=colors)["clean"]
    assert alone["known"].psnr_leave_one_out > clean.psnr_leave_one_out - 0.5


def test_pictures_show_the_dark_corners(bright, dark):
    state = State(bright.cloud(), replace(dark.views(), light=LIGHT))
    shown = pictures.leave_one_out(evaluate.color_by_paper([state])[0], state, 2).astype(float)
    covered = shown.max(axis=2) > 0
    assert (
        np.abs(shown - dark.pictures[2])[covered].mean()
        < 8
        < np.abs(shown - bright.pictures[2])[covered].mean()
    )


def test_calibration_of_a_result_holds_it(tmp_path):
    numbers = FOUND.numbers
    calibration.write(tmp_path, box_world.CAMERA, np.eye(4), 0.0, 0.0, {}, numbers)
    np.testing.assert_array_equal(calibration.read_vignetting(tmp_path), numbers)
    assert calibration.read_camera(tmp_path).fx == box_world.CAMERA.fx
    calibration.write(tmp_path, box_world.CAMERA, np.eye(4), 0.0, 0.0, {})
    assert calibration.read_vignetting(tmp_path) is None
    assert calibration.read_vignetting(tmp_path / "none") is None
    assert not recorded_images.radiometry_of(tmp_path)
    curve = response.Response((0.6, 0.65, 0.7, 0.8, 1.0, 1.4, 2.2))
    calibration.write(tmp_path, box_world.CAMERA, np.eye(4), 0.0, 0.0, {}, numbers, curve.table)
    assert recorded_images.radiometry_of(tmp_path).response.slopes == pytest.approx(curve.slopes)
    assert recorded_images.radiometry_of(tmp_path).vignetting.numbers == pytest.approx(numbers)
    path = tmp_path / calibration.NAME
    facts = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(facts | {"vignetting": {"coefficients": [0.1, "x", 0], "center": [0, 0]}}))
    with pytest.raises(InputError, match="vignetting"):
        calibration.read_vignetting(tmp_path)
    path.write_text(yaml.safe_dump(facts | {"response": {"grey_values": [1, 2], "slopes": [1, 2]}}))
    with pytest.raises(InputError, match="response"):
        recorded_images.radiometry_of(tmp_path)


CURVE = response.Response((0.6, 0.65, 0.7, 0.8, 1.0, 1.4, 2.2))


@pytest.mark.parametrize("colors", ["paper", "blended"])
def test_a_state_with_the_curve_predicts_the_images_as_they_were_taken(bright, colors):
    taken = np.rint(CURVE.grey(bright.pictures.astype(np.float32) * LIGHT[..., None])).astype(np.uint8)
    curved = replace(bright, pictures=taken)
    cloud, views = curved.cloud(), curved.views()
    states = {
        "as taken": State(cloud, views),
        "known": State(cloud, replace(views, light=LIGHT, curve=CURVE)),
        "light alone": State(cloud, replace(views, light=LIGHT)),
    }
    score = {name: each.psnr_leave_one_out for name, each in evaluate.evaluate(states, colors=colors).items()}
    assert score["known"] > score["light alone"] + 1
    assert score["known"] > score["as taken"] + 1


def test_the_map_shows_colors_as_the_images_have_them(bright):
    radiance = np.array([[10.0, 60.0, 200.0], [100.0, 100.0, 100.0]], np.float32)
    shown = colorize.to_rgb8(radiance, 1.1, CURVE)
    np.testing.assert_allclose(shown, CURVE.grey(radiance * 1.1), atol=0.5)
    change = colorize.contrast(radiance[1:], 1.1, CURVE)[0]
    ends = CURVE.grey(np.array([109.0, 111.0], np.float32))
    assert change == pytest.approx((ends[1] - ends[0]) / 2, rel=0.02)
    assert colorize.contrast(radiance, 1.1, response.LINEAR) == 1
