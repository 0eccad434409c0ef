"""LZF decompression, plain: one byte after the other into a list."""


def decompress(packed: bytes, longest: int) -> bytes | None:
    """The plain bytes, or None where the input is no LZF or gives more than `longest`."""
    plain: list[int] = []
    rest = list(packed)
    while rest:
        control = rest.pop(0)
        if control < 32:
            if len(rest) < control + 1:
                return None
            plain += rest[: control + 1]
            del rest[: control + 1]
        else:
            length = control // 32
            if length == 7:
                if not rest:
                    return None
                length += rest.pop(0)
            if not rest:
                return None
            distance = (control % 32) * 256 + rest.pop(0) + 1
            if distance > len(plain):
                return None
            for _ in range(length + 2):
                plain.append(plain[-distance])
        if len(plain) > longest:
            return None
    return bytes(plain)
