"""LZF, the byte compression of PCD's `binary_compressed`.

A control byte c < 32 is followed by c + 1 literal bytes; else its upper 3 bits are a length (7: add the next byte) and
its lower 5 bits with the next byte a distance - 1; length + 2 bytes are copied from there.
Source: the format description of liblzf (M. Lehmann); written anew.
"""

import numpy as np

from lvba.kernels.compiled import kernel

MAX_EXPANSION = 88
"""No 3 input bytes stand for more than 264 output bytes."""

_HASH_BITS = 14
_MAX_DISTANCE = 8192
_MAX_LENGTH = 264
_MAX_LITERALS = 32


@kernel
def decompress(packed: np.ndarray, out: np.ndarray) -> int:
    """The number of bytes written to `out`, or -1 where the input is no LZF or does not fit.

    packed: (N,) uint8; out: (M,) uint8, filled
    """
    read, written = 0, 0
    while read < packed.size:
        control = int(packed[read])
        read += 1
        if control < 32:
            count = control + 1
            if read + count > packed.size or written + count > out.size:
                return -1
            for i in range(count):
                out[written + i] = packed[read + i]
            read += count
        else:
            count = control >> 5
            if count == 7:
                if read >= packed.size:
                    return -1
                count += int(packed[read])
                read += 1
            if read >= packed.size:
                return -1
            source = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            count += 2
            if source < 0 or written + count > out.size:
                return -1
            for i in range(
                count
            ):  # byte by byte: source and destination may overlap, which repeats a pattern
                out[written + i] = out[source + i]
        written += count
    return written


@kernel
def compress(plain: np.ndarray, out: np.ndarray) -> int:
    """The number of bytes written to `out`: `plain` in LZF.

    plain: (N,) uint8; out: (N + N // 32 + 2,) uint8 or longer, filled
    """
    last_seen = np.full(1 << _HASH_BITS, -1, np.int64)
    position, literals_from, written = 0, 0, 0
    while position + 2 < plain.size:
        key = (np.uint32(plain[position]) << 16) | (np.uint32(plain[position + 1]) << 8) | plain[position + 2]
        slot = int(np.uint32(key * np.uint32(2654435761)) >> np.uint32(32 - _HASH_BITS))
        candidate = last_seen[slot]
        last_seen[slot] = position
        length = _match_length(plain, candidate, position)
        if length < 3:
            position += 1
            continue
        written = _put_literals(plain, literals_from, position, out, written)
        written = _put_copy(position - candidate - 1, length - 2, out, written)
        position += length
        literals_from = position
    return _put_literals(plain, literals_from, plain.size, out, written)


@kernel
def _match_length(plain: np.ndarray, candidate: int, position: int) -> int:
    if candidate < 0 or position - candidate > _MAX_DISTANCE:
        return 0
    longest = min(_MAX_LENGTH, plain.size - position)
    length = 0
    while length < longest and plain[candidate + length] == plain[position + length]:
        length += 1
    return length


@kernel
def _put_literals(plain: np.ndarray, start: int, stop: int, out: np.ndarray, written: int) -> int:
    while start < stop:
        count = min(_MAX_LITERALS, stop - start)
        out[written] = count - 1
        for i in range(count):
            out[written + 1 + i] = plain[start + i]
        written += count + 1
        start += count
    return written


@kernel
def _put_copy(distance: int, length: int, out: np.ndarray, written: int) -> int:
    if length < 7:
        out[written] = (length << 5) | (distance >> 8)
        out[written + 1] = distance & 255
        return written + 2
    out[written] = (7 << 5) | (distance >> 8)
    out[written + 1] = length - 7
    out[written + 2] = distance & 255
    return written + 3
