import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import image_header, images


def _rgb(height: int = 40, width: int = 60, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    return cv2.blur(noise, (5, 5))


def _encode(pixels: np.ndarray, suffix: str = ".png", options: tuple[int, ...] = ()) -> bytes:
    return cv2.imencode(suffix, pixels, list(options))[1].tobytes()


def test_png_comes_back_exactly_and_jpeg_nearly(tmp_path: Path):
    rgb = _rgb()
    rgb[..., 0] //= 4  # red and blue must not be swapped
    for name, tolerance in (("a.png", 0), ("a.jpg", 12), ("a.JPEG", 12)):
        images.write_image(tmp_path / name, rgb)
        back = images.read_image(tmp_path / name)
        assert back.dtype == np.uint8
        assert back.flags["C_CONTIGUOUS"]
        assert np.abs(back.astype(int) - rgb).mean() <= tolerance
        assert images.check_image(tmp_path / name) == image_header.ImageSize(60, 40)
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.png"), rgb)


def test_gray_and_alpha(tmp_path: Path):
    rgb = _rgb()
    gray = rgb[..., 0]
    (tmp_path / "gray.png").write_bytes(_encode(gray))
    np.testing.assert_array_equal(
        images.read_image(tmp_path / "gray.png"), np.repeat(gray[..., None], 3, axis=2)
    )
    (tmp_path / "gray.jpg").write_bytes(_encode(gray, ".jpg"))
    assert images.read_image(tmp_path / "gray.jpg").shape == (40, 60, 3)
    (tmp_path / "alpha.png").write_bytes(_encode(np.dstack([rgb[..., ::-1], gray])))
    np.testing.assert_array_equal(images.read_image(tmp_path / "alpha.png"), rgb)


def test_sixteen_bits_are_scaled_to_the_nearest_of_eight(tmp_path: Path):
    deep = np.random.default_rng(0).integers(0, 65536, (30, 20, 3)).astype(np.uint16)
    deep[0, 0], deep[0, 1] = 65535, 0
    (tmp_path / "deep.png").write_bytes(_encode(deep))
    np.testing.assert_array_equal(images.read_image(tmp_path / "deep.png"), np.round(deep[..., ::-1] / 257.0))
    (tmp_path / "gray.png").write_bytes(_encode(deep[..., 0]))
    np.testing.assert_array_equal(
        images.read_image(tmp_path / "gray.png")[..., 1], np.round(deep[..., 0] / 257.0)
    )


def test_progressive_jpeg_and_one_with_a_thumbnail_and_a_tail(tmp_path: Path):
    plain = _encode(_rgb(), ".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2))
    thumbnail = _encode(_rgb(8, 8), ".jpg")
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    content = plain[:2] + segment + plain[2:] + bytes(1000)
    (tmp_path / "a.jpg").write_bytes(content)
    assert images.read_image(tmp_path / "a.jpg").shape == (40, 60, 3)
    assert images.check_image(tmp_path / "a.jpg") == image_header.ImageSize(60, 40)
    end = content.rindex(b"\xff\xd9")  # the thumbnail's own end marker must not stand for the image's
    (tmp_path / "b.jpg").write_bytes(content[:end])
    with pytest.raises(InputError, match="truncated"):
        images.read_image(tmp_path / "b.jpg")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("part", [0.0, 0.02, 0.3, 0.7, 0.97])
def test_part_of_a_file_is_refused(tmp_path: Path, suffix: str, part: float):
    content = _encode(_rgb(), suffix)
    path = tmp_path / f"part{suffix}"
    path.write_bytes(content[: int(len(content) * part)])
    with pytest.raises(InputError) as caught:
        images.read_image(path)
    assert str(path) in str(caught.value)
    with pytest.raises(InputError):
        images.check_image(path)


def test_a_changed_byte_of_a_png_is_refused(tmp_path: Path):
    content = bytearray(_encode(_rgb()))
    content[len(content) // 2] ^= 0x10
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png.*checksum"):
        images.read_image(tmp_path / "a.png")


def test_a_header_that_asks_for_too_many_pixels_is_refused_before_decoding(tmp_path: Path):
    content = bytearray(_encode(_rgb()))
    content[16:24] = (100_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    (tmp_path / "bomb.png").write_bytes(content)
    with pytest.raises(InputError, match="100000 x 100000 pixels"):
        images.read_image(tmp_path / "bomb.png")


@pytest.mark.parametrize("content", [b"GIF89a" + bytes(100), b"BM" + bytes(100), bytes(100), b"<svg/>"])
def test_other_formats_are_refused(tmp_path: Path, content: bytes):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match="neither PNG nor JPEG"):
        images.read_image(tmp_path / "a.png")


def test_an_unknown_suffix_is_not_written(tmp_path: Path):
    with pytest.raises(ValueError, match="suffix"):
        images.write_image(tmp_path / "a.exe", _rgb())
