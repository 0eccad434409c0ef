"""Files of which pieces are here: what is in them is read, what is not is noted."""

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import files, partial_files
from lvba.sources.inspection import inspect
from lvba.sources.opening import open_source


def test_pieces_are_read_and_other_places_are_noted(tmp_path):
    content = bytes(np.random.default_rng(3).integers(0, 256, 100_000, np.uint8))
    path = tmp_path / "whole"
    path.write_bytes(content)
    partial = partial_files.declare(
        path, [(50_000, 60_000), (0, 20_000), (15_000, 30_000), (99_000, 100_000)]
    )
    assert [partial.end_of(place) for place in (0, 29_999, 30_000, 50_000)] == [
        30_000,
        30_000,
        30_000,
        60_000,
    ]
    with files.open_binary(path) as file:
        assert file.read(30_000) == content[:30_000]
        file.seek(99_500)
        assert file.read() == content[99_500:]
        assert partial.absent == []
        file.seek(29_000)
        with pytest.raises(InputError, match="not been looked at yet"):
            file.read(2000)
        assert partial.absent == [30_000]


def test_a_bag_asks_for_what_it_needs_and_then_says_what_the_whole_says(bags, tmp_path):
    whole = inspect(open_source(bags / "walk.bag"))
    content = (bags / "walk.bag").read_bytes()
    path = tmp_path / "walk.bag"
    path.write_bytes(content)
    pieces, asked = [(0, 8192), (len(content) - 4096, len(content))], 0
    while True:
        partial = partial_files.declare(path, pieces)
        try:
            seen = inspect(open_source(path))
        except InputError:
            assert partial.absent
        if not partial.absent:
            break
        pieces += [(place, place + 8192) for place in partial.absent]
        asked += 1
    assert asked > 1
    assert [each.facts for each in seen.streams] == [each.facts for each in whole.streams]
    assert (seen.missing, seen.choice) == (whole.missing, whole.choice)
