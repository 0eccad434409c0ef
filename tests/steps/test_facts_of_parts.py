"""What parts of a recording say together: pairs of patches that tie images across gaps, and what they warn of."""

from types import SimpleNamespace

import numpy as np

from lvba.steps import joint_cameras


def part(first, last, ties=None, number=0, warnings=(), problem=""):
    result = None if ties is None else SimpleNamespace(ties=np.array(ties, np.int64), warnings=warnings)
    return SimpleNamespace(images=(first, last), number=number), SimpleNamespace(
        result=result, problem=problem
    )


def test_a_gap_has_the_pairs_of_the_part_that_has_most():
    cores, stages = zip(
        part(0, 4, [5, 6, 7]), part(2, 6, [9, 1, 2]), part(5, 7, None), part(6, 8, []), strict=True
    )
    np.testing.assert_array_equal(joint_cameras._ties(cores, stages, 8), [5, 6, 9, 1, 2, 0, 0])


def test_what_several_parts_warn_of_is_one_sentence():
    every = [part(0, 4, [], number, ("open",)) for number in range(10)]
    every[3] = part(0, 4, [], 3, ("open", "vague"))
    every[5] = part(0, 4, None, 5, problem="too dark")
    assert joint_cameras._warnings(*zip(*every, strict=True)) == (
        "parts 1, 2, 3, 4, 5, 7, 8, 9 and 1 more of 10: open",
        "part 4 of 10: vague",
        "part 6 of 10: no visual solution (too dark); cameras move with the scans there",
    )
