"""Images whose corners are dark, beside the map and the renderings that suppose it."""

from dataclasses import replace

import box_world
import numpy as np
import pytest
import yaml

from lvba.errors import InputError
from lvba.io import calibration
from lvba.products import colorize, evaluate, pictures
from lvba.products.evaluate import State
from lvba.visual import vignetting
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
    shown = pictures.leave_one_out(evaluate.color_by_paper(state), state, 2).astype(float)
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
    path = tmp_path / calibration.NAME
    facts = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(facts | {"vignetting": {"coefficients": [0.1, "x", 0], "center": [0, 0]}}))
    with pytest.raises(InputError, match="vignetting"):
        calibration.read_vignetting(tmp_path)
