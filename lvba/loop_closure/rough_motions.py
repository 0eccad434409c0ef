"""Motions from scan to scan that rough poses have, held against the surfaces that the scans see.

Scans that overlap little fit together in several ways, and two scans on both sides of a door see too little of each other
to tell: then those before and behind are asked.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Poses
from lvba.loop_closure import scan_steps
from lvba.loop_closure.scan_steps import Step
from lvba.loop_closure.submap import Patch
from lvba.loop_closure.surfel_icp import Target
from lvba.parallel import in_order
from lvba.trajectory import JUMP_DEG, JUMP_M

_TESTED = 6
"""Steps that are tested, those by which surfaces agree least."""
_SAMPLED = 6
"""Steps, spread over all, that tell how good poses are."""
WRONG_MINIMUM_M = 0.05
"""Steps of refined poses that are typically off by more are in a wrong minimum: right ones are 1 to 20 mm from where two
thin scans have them, those of a cabinet that was walked round with 0.1 m of error from scan to scan were 100."""
_GAIN = 0.1
"""Part of a scan's surfels by which the agreement must grow: what overlaps little could be anything."""
_FAR_GAIN = 0.3
"""The same where neither scan sees through surfaces of the other: a narrow sensor that moves along a wall sees again only
part of what it saw, and the wall agrees with more of itself a meter further back."""
_IN_SIGHT = 0.05
"""Part of what two scans say that contradicts the odometry's motion, where they determine another one in all directions:
of motions that were right it was .01 at most, of jumps by a meter at which much still agrees .1 and more."""
_MORE = 0.1
"""Part of what scans on either side say by which more may contradict a motion that replaces the odometry's; by which less
must, where they are what it is known by."""
_SAME_M, _SAME_DEG = 0.1, 1.0
"""Motions that differ by less are the same: two thin scans do not tell it better."""
BESIDE = 4
"""Scans on either side of a motion that are asked where two do not tell."""
MANY = 2 * BESIDE
ASKED = ((1, _SAME_M, _SAME_DEG), (BESIDE, _SAME_M, _SAME_DEG), (MANY, 0.02, 0.3))
"""So many on either side are asked whether they confirm a motion that differs from theirs by so much at most. Many
determine one nearly always, also where poses are wrong: right motions are within 4 mm of theirs, wrong ones were
3 to 9 cm away."""


def contradicted(patches: Sequence[Patch | None], world_from_scan: Poses) -> np.ndarray:
    """(K,) int64, ascending: scans after which the step of poses (S, 4, 4) is decimeters off, of those that were tested.

    Tested are the steps by which surfaces agree least.
    """
    steps = geometry.steps(world_from_scan)
    agree = np.full(len(steps), np.inf)
    for k, (first, second) in enumerate(pairwise(patches)):
        if first is not None and second is not None:
            agree[k] = scan_steps.overlap(Target.of(first), second, steps[k])
    wrong = []
    tested = np.argsort(agree, kind="stable")[:_TESTED].tolist()
    for k, step in zip(tested, _all_registered(patches, world_from_scan, tested), strict=True):
        if step is not None and _far(step.correction(steps[k])) and step.overlap > agree[k] + _GAIN:
            wrong.append(k)
    return np.array(sorted(wrong), np.int64)


def typically_off(patches: Sequence[Patch | None], world_from_scan: Poses) -> float:
    """m: how far steps of poses (S, 4, 4) typically are from where surfaces of the two scans have them, median over some;
    0.0 where surfaces leave most of these open.

    patches: of `surfels_of`
    """
    steps, off = geometry.steps(world_from_scan), []
    chosen = np.unique(np.linspace(0, max(len(steps) - 1, 0), _SAMPLED).astype(int)).tolist()[: len(steps)]
    for k, step in zip(chosen, _all_registered(patches, world_from_scan, chosen), strict=True):
        if step is not None and step.aligned and not step.open:
            off.append(float(np.linalg.norm(step.correction(steps[k])[3:])))
    return float(np.median(off)) if 2 * len(off) > len(chosen) else 0.0


def confirmed(
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    after: np.ndarray,
    expected: Poses,
    most: int = MANY,
) -> np.ndarray:
    """(K,) int64, ascending: of some scans, those whose motion to the next one surfaces confirm.

    patches: of `surfels_of`; world_from_scan: (S, 4, 4); after: (J,) int64, the scans
    expected: (S - 1, 4, 4), motions as those before and after let expect; most: scans on either side that are asked
    Surfaces confirm a motion if they determine it in all directions, agree with it, and do not agree as well with
    another one that is nearer to what is expected: those of both scans, of some on both sides where these are few, or of
    many.
    """
    sure = []
    for k in np.unique(after):
        motion = geometry.inverse(world_from_scan[k]) @ world_from_scan[k + 1]
        for scans, *near in ASKED:
            pair = beside(patches, world_from_scan, k, scans) if scans <= most else None
            if pair is not None and _agreed(*pair, motion, expected[k], *near):
                sure.append(int(k))
                break
    return np.array(sure, np.int64)


def _agreed(
    first: Patch, second: Patch, motion: np.ndarray, expected: np.ndarray, most_m: float, most_deg: float
) -> bool:
    """Whether surfaces determine a motion (4, 4), agree with it, and with none near the expected one (4, 4) as well.

    most_m, most_deg: by how much theirs may differ from it
    """
    target = Target.of(first)
    step = scan_steps.register(target, second, motion)
    if not step.aligned or step.open or apart(motion, step.first_from_second, most_m, most_deg):
        return False
    rival = scan_steps.register(target, second, expected)
    same = not apart(rival.first_from_second, step.first_from_second)
    return same or not rival.aligned or rival.overlap < step.overlap - _GAIN


def registered(patches: Sequence[Patch | None], world_from_scan: Poses, k: int) -> Step | None:
    """Scan k + 1 as `scan_steps.register` has it beside scan k; None: one of them sees too little. Nothing is known where
    that is far from what the odometry (S, 4, 4) has, without good reason.

    Scans that overlap little, as of a narrow sensor that turns, fit together in several ways: any wall fits any other
    one. Surfaces speak against an odometry if they contradict it in sight, or determine another motion in all directions,
    by which far more of them agree, and which those of the scans before and behind do not contradict any more than it.
    Where two scans do not agree on any motion, as on both sides of a door, those before and behind are asked for one.
    """
    first, second = patches[k], patches[k + 1]
    if first is None or second is None:
        return None
    rough, target = geometry.steps(world_from_scan[k : k + 2])[0], Target.of(first)
    step = scan_steps.register(target, second, rough)
    if not step.aligned:
        around = beside(patches, world_from_scan, k, BESIDE)
        return (_against(*around, rough) if around else None) or step
    if not _far(step.correction(rough)):
        return step
    if step.open:
        if scan_steps.contradicts(target, second, rough):
            return step
    else:
        if scan_steps.contradicting(target, second, rough) > _IN_SIGHT:
            return step
        around = beside(patches, world_from_scan, k, BESIDE)
        more = step.overlap > scan_steps.overlap(target, second, rough) + _FAR_GAIN
        if more and not (around and _more_against(*around, step.first_from_second, rough)):
            return step
    return replace(step, first_from_second=rough, information=np.zeros((6, 6)), open=6)


def _all_registered(
    patches: Sequence[Patch | None], world_from_scan: np.ndarray, steps: list[int]
) -> Iterator[Step | None]:
    """Each of some steps as `registered`."""
    return in_order(lambda k: registered(patches, world_from_scan, k), steps, parallel_kernels=True)


def beside(
    patches: Sequence[Patch | None], world_from_scan: Poses, k: int, most: int
) -> tuple[Patch, Patch] | None:
    """Surfels of scan k and so many before it, in its frame, and of those behind it in that of the first; None: none.

    patches: of each scan; world_from_scan: (S, 4, 4); most: scans on either side
    """
    before, behind = slice(max(0, k + 1 - most), k + 1), slice(k + 1, k + 1 + most)
    first = scan_steps.together(patches[before], world_from_scan[before], -1)
    second = scan_steps.together(patches[behind], world_from_scan[behind], 0)
    return None if first is None or second is None else (first, second)


def _against(first: Patch, second: Patch, rough: np.ndarray) -> Step | None:
    """Another motion than the odometry's (4, 4), with which more of the surfaces of several scans agree, and which they
    contradict far less; None: there is none."""
    target = Target.of(first)
    against = scan_steps.contradicting(target, second, rough)
    if against < _MORE:
        return None
    step = scan_steps.register(target, second, rough)
    if not step.aligned or not _far(step.correction(rough)):
        return None
    more = step.overlap > scan_steps.overlap(target, second, rough) + _GAIN
    less = scan_steps.contradicting(target, second, step.first_from_second) + _MORE < against
    return step if more and less else None


def _more_against(first: Patch, second: Patch, motion: np.ndarray, rough: np.ndarray) -> bool:
    """Whether surfaces contradict a motion (4, 4) by more than the odometry's (4, 4)."""
    target = Target.of(first)
    against, by_rough = (scan_steps.contradicting(target, second, each) for each in (motion, rough))
    return against > by_rough + _MORE


def _far(off: np.ndarray) -> bool:
    """Whether a motion that is off by so much, (6,) rad and m, is decimeters off."""
    return bool(np.linalg.norm(off[3:]) > JUMP_M or np.linalg.norm(off[:3]) > np.radians(JUMP_DEG))


def apart(one: Pose, other: Pose, most_m: float = _SAME_M, most_deg: float = _SAME_DEG) -> bool:
    """Whether two motions (4, 4) are not the same, as far as thin scans tell.

    most_m, most_deg: by which motions that are the same may differ
    """
    off = geometry.log(geometry.inverse(one) @ other)
    return bool(np.linalg.norm(off[3:]) > most_m or np.linalg.norm(off[:3]) > np.radians(most_deg))
