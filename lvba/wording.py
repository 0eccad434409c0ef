"""Words of sentences that people read."""

from collections.abc import Sequence


def joined(words: Sequence[str], last: str = "and") -> str:
    """The words with commas, and a word before the last one."""
    return f" {last} ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def first_of(words: Sequence[str], most: int) -> str:
    """The words with commas; of more than `most` of them the first ones, and how many more there are."""
    shown = ", ".join(words[:most])
    return shown if len(words) <= most else f"{shown} and {len(words) - most} more"


def runs(numbers: Sequence[int], most: int) -> str:
    """Ascending whole numbers with commas, three and more in a row as "first to last"; the rest as `first_of` has it."""
    rows: list[list[int]] = []
    for number in numbers:
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    words = [
        each
        for row in rows
        for each in ([f"{row[0]} to {row[-1]}"] if len(row) > 2 else [str(n) for n in row])
    ]
    return first_of(words, most)
