"""What several kernels build on: hash tables and Morton order, against dictionaries and bits one by one."""

import numpy as np
import pytest

from lvba.kernels import hash_table, morton


def spread(number):
    return sum(((number >> bit) & 1) << 3 * bit for bit in range(21))


@pytest.mark.parametrize("number", [0, 1, 5, 0xFFFF, 0x155555, (1 << 21) - 1])
def test_bits_are_spread_to_every_third_and_gathered_again(number):
    assert int(morton.spread(number)) == spread(number)
    assert int(morton.gather(np.uint64(spread(number)))) == number
    assert int(morton.gather(np.uint64(spread(number) | spread((1 << 21) - 1) << 1))) == number


def test_a_table_finds_its_keys_again_also_in_twice_the_places():
    rng = np.random.default_rng(0)
    keys = [0, 1 << 47, *rng.integers(0, 1 << 48, 29).tolist()]
    table, known = np.full(64, hash_table.FREE), {}
    for key in keys:
        place = int(hash_table.place_of(table, key))
        assert table[place] in (hash_table.FREE, key)
        table[place], known[key] = key, place
    assert len(set(known.values())) == len(known) == len(set(keys))
    assert {key: int(hash_table.place_of(table, key)) for key in keys} == known
    wider, went = hash_table.doubled(table)
    assert len(wider) == 128
    assert sorted(wider[wider != hash_table.FREE]) == sorted(known)
    for key, place in known.items():
        assert wider[went[place]] == key
        assert hash_table.place_of(wider, key) == went[place]


def test_keys_that_hash_alike_have_places_of_their_own():
    table = np.full(4, hash_table.FREE)
    for key in (3, 7, 11):
        table[hash_table.place_of(table, key)] = key
    assert sorted(table) == [-1, 3, 7, 11]
