"""The size of the images that judge: how it follows from that of the images, and that nothing moves in them."""

import numpy as np
import pytest

from lvba.blocks import decoded_images
from lvba.camera import Camera
from lvba.lens import Lens
from lvba.products import judging_size


def camera_of(width: int, height: int, **more: object) -> Camera:
    return Camera(width, height, 0.8 * width, 0.79 * width, 0.49 * width, 0.52 * height, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("width", "height", "judging"),
    [
        (640, 480, (640, 480)),
        (1500, 1000, (1500, 1000)),
        (1501, 1000, (750, 500)),
        (2448, 2048, (1224, 1024)),
        (2449, 2049, (1224, 1024)),
        (4000, 3000, (1000, 750)),
        (1, 1, (1, 1)),
    ],
)
def test_large_images_are_halved_until_they_have_no_more_pixels_than_judge(
    width: int, height: int, judging: tuple[int, int]
) -> None:
    camera = judging_size.judging(camera_of(width, height))
    assert (camera.width, camera.height) == judging


def test_images_that_judge_are_themselves() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    assert judging_size.reduced(photo, camera_of(640, 480)) is photo


def test_a_pixel_is_the_mean_of_its_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judging_size, "MOST_PIXELS", 100)
    photo = np.random.default_rng(1).integers(0, 256, (35, 47, 3), np.uint8)
    reduced = judging_size.reduced(photo, camera_of(47, 35))
    assert reduced.shape == (8, 11, 3)
    blocks = photo[:32, :44].reshape(8, 4, 11, 4, 3).astype(float).mean(axis=(1, 3))
    assert np.abs(reduced - blocks).max() <= 0.5


@pytest.mark.parametrize("lens", [Lens.RADIAL_TANGENTIAL, Lens.EQUIDISTANT])
@pytest.mark.parametrize("edge", [2, 4])
def test_the_judging_camera_sees_things_where_they_are(
    monkeypatch: pytest.MonkeyPatch, lens: Lens, edge: int
) -> None:
    """A picture whose grey value is the place on the sensor: the reduced picture has that of its own pixel centers."""
    camera = camera_of(200, 160, distortion=(-0.05, 0.01, 0.0, 0.0), lens=lens)
    monkeypatch.setattr(judging_size, "MOST_PIXELS", 200 * 160 // edge**2)
    columns, rows = np.arange(200.0), np.arange(160.0)
    right, down = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    photo = np.stack([*np.meshgrid(125 + 200 * right, 125 + 200 * down), np.zeros((160, 200))], axis=-1)
    reduced = judging_size.reduced(np.rint(photo).astype(np.uint8), camera)
    judging = judging_size.judging(camera)
    assert (judging.lens, judging.distortion) == (camera.lens, camera.distortion)
    right = (np.arange(judging.width) - judging.cx) / judging.fx
    down = (np.arange(judging.height) - judging.cy) / judging.fy
    expected = np.stack(np.meshgrid(125 + 200 * right, 125 + 200 * down), axis=-1)
    assert np.abs(reduced[..., :2] - expected).max() <= 1.0


def test_photos_are_read_at_the_size_at_which_they_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without distortion of the lens what is read is the reduced photo itself, whichever piece it lies in."""
    monkeypatch.setattr(judging_size, "MOST_PIXELS", 400)
    monkeypatch.setattr(decoded_images, "PIECE_BYTES", 1 << 13)
    camera = camera_of(40, 30)
    photos = np.random.default_rng(2).integers(0, 256, (7, 30, 40, 3), np.uint8)
    full, judging = decoded_images.photo_ranges(camera, [(0, 4), (4, 7)])
    raw = [(each, lambda each=each: photos[each[0] : each[1]]) for each in full]
    dataset: object = type("Recording", (), {"camera": camera})()
    made = [(each, decoded_images.judging_photos(dataset, each, raw)) for each in judging]  # type: ignore[arg-type]
    assert len(made) < len(full)
    reader = decoded_images.PhotoReader([(each, lambda piece=piece: piece) for each, piece in made], camera)
    for number, photo in enumerate(photos):
        assert np.array_equal(reader(number), judging_size.reduced(photo, camera))


def test_small_photos_need_no_second_size() -> None:
    full, judging = decoded_images.photo_ranges(camera_of(640, 480), [(0, 3), (3, 9)])
    assert [number for each in full for number in range(*each)] == list(range(9))
    assert judging == []
