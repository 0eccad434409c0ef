"""Words of sentences that people read."""

from collections.abc import Sequence


def first_of(words: Sequence[str], most: int) -> str:
    """The words with commas; of more than `most` of them the first ones, and how many more there are."""
    shown = ", ".join(words[:most])
    return shown if len(words) <= most else f"{shown} and {len(words) - most} more"
