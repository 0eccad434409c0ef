"""What parts of a recording say together: which images are of one group, and what they warn of."""

from types import SimpleNamespace

import numpy as np

from lvba.steps import joint_cameras


def part(first, last, group=None, number=0, warnings=(), problem=""):
    keyframes = np.flatnonzero(np.array(group or [], np.int64) >= 0)
    result = None
    if group is not None:
        result = SimpleNamespace(group=np.array(group, np.int64), keyframes=keyframes, warnings=warnings)
    return SimpleNamespace(images=(first, last), number=number), SimpleNamespace(
        result=result, problem=problem
    )


def test_groups_of_two_parts_are_one_by_the_images_that_both_solved():
    cores, stages = zip(
        part(0, 4, [0, 0, -1, 1]), part(2, 6, [-1, 0, 0, 1]), part(5, 7, None), part(6, 9, [0, -1, 0]), strict=True
    )  # fmt: skip
    keyframes = np.array([0, 1, 3, 4, 5, 6, 8])
    group = joint_cameras._groups(cores, stages, keyframes, 9)
    assert (group[[2, 7]] == -1).all()
    assert group[0] == group[1] != group[3] == group[4]
    assert group[6] == group[8]
    assert len({int(group[k]) for k in (0, 3, 5, 6)}) == 4


def test_what_several_parts_warn_of_is_one_sentence():
    every = [part(0, 4, [], number, ("open",)) for number in range(10)]
    every[3] = part(0, 4, [], 3, ("open", "vague"))
    every[5] = part(0, 4, None, 5, problem="too dark")
    assert joint_cameras._warnings(*zip(*every, strict=True)) == (
        "parts 1, 2, 3, 4, 5, 7, 8, 9 and 1 more of 10: open",
        "part 4 of 10: vague",
        "part 6 of 10: no visual solution (too dark); cameras move with the scans there",
    )
