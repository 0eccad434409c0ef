"""The walk through entropy-coded data, plain: a text of bits and a dictionary of codes."""


def code_book(table: bytes) -> dict[str, int]:
    """Symbols by the bits of their Huffman code. Source: ITU-T T.81, annex C."""
    book, code, symbols = {}, 0, list(table[16:])
    for length, count in enumerate(table[:16], 1):
        for _ in range(count):
            if symbols and code < 1 << length:
                book[f"{code:0{length}b}"] = symbols.pop(0)
            code += 1
        code *= 2
    return book


def walk(data: bytes, dc: list[dict[str, int]], ac: list[dict[str, int]], units: int) -> int:
    """The bits that the units take, or -1; dc, ac: a code book for each block of a unit."""
    bits = "".join(f"{byte:08b}" for byte in data)
    place = 0

    def symbol(book: dict[str, int]) -> int | None:
        nonlocal place
        for length in range(1, 17):
            found = book.get((bits + "0" * 16)[place : place + length])
            if found is not None:
                place += length + found % 16
                return found if place <= len(bits) else None
        return None

    for _ in range(units):
        for dc_book, ac_book in zip(dc, ac, strict=True):
            size = symbol(dc_book)
            if size is None or size > 15:
                return -1
            coefficients = 1
            while coefficients < 64:
                both = symbol(ac_book)
                if both is None:
                    return -1
                if both == 0:
                    break
                coefficients += both // 16 + 1
                if coefficients > 64:
                    return -1
    return place
