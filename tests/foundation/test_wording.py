"""Lists in sentences that people read."""

import pytest

from lvba.wording import first_of, joined, runs


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((), ""),
        ((7,), "7"),
        ((3, 4), "3, 4"),
        ((0, 1, 2, 5, 7, 8, 9, 10), "0 to 2, 5, 7 to 10"),
        ((1, 2, 4, 6, 8), "1, 2, 4 and 2 more"),
        ((*range(0, 2477), *range(6407, 12000)), "0 to 2476, 6407 to 11999"),
    ],
)
def test_numbers_in_a_row_are_named_by_the_first_and_the_last(numbers, words):
    assert runs(numbers, 3) == words


def test_what_is_not_listed_is_counted():
    assert first_of(["a", "b"], 2) == "a, b"
    assert first_of(["a", "b", "c"], 2) == "a, b and 1 more"


@pytest.mark.parametrize(
    ("words", "last", "expected"),
    [
        ([], "and", ""),
        (["a"], "and", "a"),
        (["a", "b"], "or", "a or b"),
        (["a", "b", "c"], "and", "a, b and c"),
    ],
)
def test_words_are_joined_by_commas_and_a_word_before_the_last(words, last, expected):
    assert joined(words, last) == expected
