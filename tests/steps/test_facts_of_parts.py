"""What parts of a recording say together: which images are of one group, and what they warn of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from lvba.steps import joint_cameras
from lvba.visual.result import LevelReport


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


def test_wrong_images_of_one_part_are_not_averaged_away():
    level = LevelReport(
        level=0, scene_points=9, global_points=0, local_pairs=90, global_pairs=0, sigma=2.0, shift=0.1, rms=2.0,
        variance_factor=2.0, noise_variance_factor=1.0, prior_position_m=(), prior_rotation_deg=(), iterations=(),
        converged=True,
    )  # fmt: skip
    parts = [replace(level, compared=1000, alike=900), replace(level, compared=200, alike=20), level]
    joint = joint_cameras._level(parts)
    assert (joint.alike, joint.compared, joint.local_pairs) == (20, 200, 270)
