"""The entropy-coded data of a baseline JPEG, walked from Huffman code to Huffman code without making pixels.

Source: ITU-T T.81, annex F.2.2 (decoding of baseline sequential scans).
"""

import numpy as np

from lvba.kernels.compiled import kernel

_SHORT = 10


@kernel
def walk(words: np.ndarray, end: int, codes: np.ndarray, dc: np.ndarray, ac: np.ndarray, units: int) -> int:
    """The bits that `units` coded units take, or -1 where a code is none or the data end before.

    words: (N,) uint32, the data without stuffed zeros as big-endian numbers; end: bits of data
    codes: (T, 65536) uint16: for the next 16 bits, the length of the code they start with times 256, plus its symbol; 0
        where they start with none
    dc, ac: (B,) int64, rows of `codes` for each block of a unit
    """
    short_codes = codes[:, :: 1 << (16 - _SHORT)].copy()  # fits the nearest cache; long codes are rare
    window, held, word, bit = np.uint64(0), 0, 0, 0
    for _ in range(units):
        for block in range(dc.size):
            position, row = 0, dc[block]
            while position < 64:
                if bit > end:
                    return -1
                if held < 32:
                    if (
                        word < words.size
                    ):  # codes are looked up by more bits than the last ones have; the rest are zeros
                        window |= np.uint64(words[word]) << np.uint64(32 - held)
                    word += 1
                    held += 32
                code = int(short_codes[row, np.int64(window >> np.uint64(64 - _SHORT))])
                if code == 0 or code >= (_SHORT + 1) << 8:
                    code = int(codes[row, np.int64(window >> np.uint64(48))])
                    if code == 0:
                        return -1
                taken = (code >> 8) + (code & 15)
                window <<= np.uint64(taken)
                held -= taken
                bit += taken
                if position == 0:
                    if code & 240:
                        return -1
                    position, row = 1, ac[block]
                    continue
                if code & 255 == 0:  # end of block
                    break
                position += ((code >> 4) & 15) + 1
                if position > 64:
                    return -1
    return bit if bit <= end else -1
