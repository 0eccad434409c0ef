"""Pairs of patches that tie images across gaps, where a recording is in parts."""

from types import SimpleNamespace

import numpy as np

from lvba.steps import joint_cameras


def part(first, last, ties):
    result = None if ties is None else SimpleNamespace(ties=np.array(ties, np.int64))
    return SimpleNamespace(images=(first, last)), SimpleNamespace(result=result)


def test_a_gap_has_the_pairs_of_the_part_that_has_most():
    cores, stages = zip(
        part(0, 4, [5, 6, 7]), part(2, 6, [9, 1, 2]), part(5, 7, None), part(6, 8, []), strict=True
    )
    np.testing.assert_array_equal(joint_cameras._ties(cores, stages, 8), [5, 6, 9, 1, 2, 0, 0])
