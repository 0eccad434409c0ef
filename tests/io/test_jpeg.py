from pathlib import Path

import cv2
import naive_jpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lvba.errors import InputError
from lvba.io import images, jpeg
from lvba.kernels import jpeg as kernel


def _encode(height: int, width: int, *options: int, gray: bool = False, seed: int = 0) -> bytes:
    pixels = np.random.default_rng(seed).integers(
        0, 256, (height, width) if gray else (height, width, 3), np.uint8
    )
    return cv2.imencode(".jpg", cv2.blur(pixels, (3, 3)), list(options))[1].tobytes()


TABLES = jpeg.read_segments(_encode(8, 8)).tables
KEYS = sorted(TABLES)  # DC 0, DC 1, AC 0, AC 1


def _walk(data: bytes, dc: list[int], ac: list[int], units: int) -> int:
    codes = np.stack([jpeg._lookup(TABLES[key]) for key in KEYS])
    padded = np.frombuffer(data + bytes(-len(data) % 4), ">u4").astype(np.uint32)
    return kernel.walk(padded, 8 * len(data), codes, np.array(dc), np.array(ac), units)


@given(st.binary(max_size=120), st.lists(st.booleans(), min_size=1, max_size=3), st.integers(1, 4))
@settings(deadline=None, max_examples=300, derandomize=True)
def test_the_walk_is_the_plain_twin_s_on_any_bytes(data: bytes, second: list[bool], units: int):
    books = [naive_jpeg.code_book(TABLES[key]) for key in KEYS]
    dc, ac = [int(flag) for flag in second], [2 + int(flag) for flag in second]
    assert _walk(data, dc, ac, units) == naive_jpeg.walk(
        data, [books[i] for i in dc], [books[i] for i in ac], units
    )


BOOKS = [naive_jpeg.code_book(TABLES[key]) for key in KEYS]
CODES = {symbol: bits for bits, symbol in BOOKS[2].items()}


@given(st.lists(st.sampled_from(sorted(CODES)), max_size=40), st.integers(1, 3))
@settings(deadline=None, max_examples=300, derandomize=True)
def test_the_walk_is_the_plain_twin_s_on_valid_codes_of_any_runs(symbols: list[int], units: int):
    """Blocks end early, exactly full, or one coefficient too late."""
    size_zero = next(bits for bits, symbol in BOOKS[0].items() if symbol == 0)
    bits = size_zero + "".join(CODES[symbol] + "1" * (symbol % 16) for symbol in symbols)
    data = int(bits + "0" * (-len(bits) % 8), 2).to_bytes(-(-len(bits) // 8), "big")
    assert _walk(data, [0], [2], units) == naive_jpeg.walk(data, [BOOKS[0]], [BOOKS[2]], units)


def test_a_block_may_be_full_but_not_fuller():
    size_zero = next(bits for bits, symbol in BOOKS[0].items() if symbol == 0)
    for last, expected in ((0xE1, True), (0xF1, False)):  # 48 coefficients, then 15 or 16
        bits = size_zero + 3 * CODES[0xF0] + CODES[last] + "1"
        data = int(bits + "0" * (-len(bits) % 8), 2).to_bytes(-(-len(bits) // 8), "big")
        assert _walk(data, [0], [2], 1) == (len(bits) if expected else -1)


def test_the_walk_ends_where_an_encoder_ended():
    content = _encode(40, 56)
    segments = jpeg.read_segments(content)
    layout, pieces = jpeg._layout(segments), jpeg._pieces(content, segments.data_start)
    data = pieces[0].tobytes()
    books = [naive_jpeg.code_book(TABLES[key]) for key in KEYS]
    rows = [next(i for i in range(4) if (jpeg._lookup(TABLES[KEYS[i]]) == row).all()) for row in layout.codes]
    dc, ac = [rows[i] for i in layout.dc], [rows[i] for i in layout.ac]
    bits = _walk(data, dc, ac, layout.units)
    assert 8 * len(data) - 8 < bits <= 8 * len(data)
    assert bits == naive_jpeg.walk(data, [books[i] for i in dc], [books[i] for i in ac], layout.units)


@pytest.mark.parametrize("gray", [False, True])
@pytest.mark.parametrize("quality", [1, 60, 100])
@pytest.mark.parametrize("sampling", [0x111111, 0x211111, 0x221111, 0x411111, 0x121111])
@pytest.mark.parametrize("restart", [0, 1, 3])
def test_whole_files_pass(gray: bool, quality: int, sampling: int, restart: int):
    for optimize, (height, width) in enumerate([(1, 1), (7, 9), (16, 33), (40, 61)]):
        options = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling)
        more = (cv2.IMWRITE_JPEG_RST_INTERVAL, restart, cv2.IMWRITE_JPEG_OPTIMIZE, optimize % 2)
        assert jpeg.problem(_encode(height, width, *options, *more, gray=gray)) == ""


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_RST_INTERVAL, 4), (cv2.IMWRITE_JPEG_OPTIMIZE, 1)])
def test_a_hole_in_the_middle_is_damage_though_the_end_is_there(tmp_path: Path, options: tuple[int, ...]):
    """The decoder gives back an image for most of these; by chance the number of blocks may be right again."""
    content = _encode(160, 200, *options)
    start = jpeg.read_segments(content).data_start
    found = 0
    for place in np.linspace(start, len(content) - 2500, 20).astype(int):
        for hole in (b"", bytes(2000)):
            (tmp_path / "a.jpg").write_bytes(content[:place] + hole + content[place + 2000 :])
            try:
                images.read_image(tmp_path / "a.jpg")
            except InputError as error:
                found += "a.jpg: damaged" in str(error)
    assert found >= 36


def test_padding_before_the_end_passes_and_left_over_data_do_not():
    content = _encode(40, 56)
    assert content.endswith(b"\xff\xd9")
    assert jpeg.problem(content[:-2] + b"\0\0\xff\xd9") == ""
    assert jpeg.problem(content[:-2] + b"\x35\x71\xff\xd9").startswith("damaged")
