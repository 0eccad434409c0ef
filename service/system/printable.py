"""Text of others on its way to a terminal."""

import unicodedata

_OBEYED = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Categories of Unicode that a terminal obeys, that change what is around them, or that show nothing."""


def printable(text: str, keep: str = "") -> str:
    """The text with every control and format character written as its code, such as `\\x1b`.

    keep: of these, such as a line's end, what is wanted
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter if letter in keep or unicodedata.category(letter) not in _OBEYED else _code(letter)
        for letter in text
    )


def _code(letter: str) -> str:
    number = ord(letter)
    return (
        f"\\x{number:02x}"
        if number < 0x100
        else f"\\u{number:04x}"
        if number < 0x10000
        else f"\\U{number:08x}"
    )
