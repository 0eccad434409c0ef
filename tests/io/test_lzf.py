import naive_lzf
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lvba.kernels import lzf


def _decompress(packed: bytes, longest: int) -> bytes | None:
    out = np.zeros(longest, np.uint8)
    written = lzf.decompress(np.frombuffer(packed, np.uint8), out)
    return None if written < 0 else out[:written].tobytes()


def _compress(plain: bytes) -> bytes:
    out = np.empty(len(plain) + len(plain) // 32 + 2, np.uint8)
    return out[: lzf.compress(np.frombuffer(plain, np.uint8), out)].tobytes()


@given(st.binary(max_size=200), st.integers(0, 400))
@settings(deadline=None)
def test_decompression_is_the_plain_twin_s_on_any_bytes(packed: bytes, longest: int):
    assert _decompress(packed, longest) == naive_lzf.decompress(packed, longest)


@given(st.lists(st.integers(0, 3), max_size=700).map(bytes) | st.binary(max_size=700))
@settings(deadline=None)
def test_what_was_compressed_comes_back(plain: bytes):
    packed = _compress(plain)
    assert naive_lzf.decompress(packed, len(plain)) == plain
    assert _decompress(packed, len(plain)) == plain


def test_a_long_match_at_the_longest_distance_comes_back():
    rng = np.random.default_rng(0)
    block = rng.integers(0, 256, 8192, np.uint8).tobytes()
    plain = block + block[:300] + rng.integers(0, 256, 20, np.uint8).tobytes() + block
    assert naive_lzf.decompress(_compress(plain), len(plain)) == plain


def test_patterns_get_short():
    assert len(_compress(b"abcd" * 1000)) < 100


def test_a_known_stream():
    assert _decompress(b"\x02abc\xe0\x05\x02", 100) == b"abc" + b"abcabcabcabcab"


@pytest.mark.parametrize("packed", [b"\x05abc", b"\x20\x00", b"\x00a\xe0", b"\x00a\x20\x01"])
def test_damaged_streams_are_refused(packed: bytes):
    assert _decompress(packed, 100) is None


def test_no_input_expands_more_than_said():
    packed = b"\x00a" + b"\xe0\xff\x00" * 50
    plain = _decompress(packed, 100_000)
    assert plain is not None
    assert len(plain) <= lzf.MAX_EXPANSION * len(packed)
