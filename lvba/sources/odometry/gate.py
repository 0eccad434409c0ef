"""Whether an odometry has held: figures of every scan that a lost one gives away."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from lvba.sources.odometry.registration import OPEN, SURPRISING, Step

_WARM_UP = 10
"""Scans at the start: speed, gravity and biases are not known yet."""
_BRIDGED_S = {True: 1.25, False: 0.25}
"""From the last scan before to the first one after: how long the prediction alone may hold a direction, with an IMU that
feels accelerations, and without. Then half of `prediction._ACCELERATION` by the time squared is 6 cm."""
_SURPRISING_PART = {True: 0.04, False: 0.002}
"""Of scans whose registration is right: a bump, a scan with a gap. One that went to a wrong place and stays there
contradicts the motion again at the next scans."""
_CHANCE = 0.05
"""That so many scans contradict the motion though the odometry has held: what is less likely is not believed."""
_OPEN_PART = {True: 0.2, False: 0.05}
_ALONE = 0.5
"""A scan that finds less than this part of what scans usually find in the map is not registered."""
_UNMATCHED_PART = 0.05
_MOST_APART_S = {True: 0.5, False: 0.25}
"""From scan to scan: after longer, a prediction is so uncertain (half its acceleration by the time squared) that no wrong
registration surprises it."""


@dataclass(frozen=True)
class Verdict:
    """Whether the poses may be used.

    lost: they may not; reasons: why, one clause each; first_s: s, the time of the first scan that gives it away, or None
    open_part, surprising_part, unmatched_part: of all scans
    """

    lost: bool
    reasons: tuple[str, ...]
    first_s: float | None
    open_part: float
    surprising_part: float
    unmatched_part: float


def judge(steps: Sequence[Step], forces: bool) -> Verdict:
    """The verdict on an odometry. forces: an IMU measured accelerations

    Without them, a registration that slides along a surface is only told from a motion by how sudden it is; so less is
    tolerated.
    """
    judged = steps[_WARM_UP:]
    if not judged:
        return Verdict(
            lost=True,
            reasons=(f"there are only {len(steps)} scans",),
            first_s=None,
            open_part=0.0,
            surprising_part=0.0,
            unmatched_part=0.0,
        )
    open_ = np.array([step.sway > OPEN for step in judged])
    surprising = np.array([step.surprise > SURPRISING for step in judged])
    matched = np.array([step.registered.matched for step in judged])
    unmatched = matched < _ALONE * np.median(matched)
    finite = np.array([np.isfinite(step.world_from_lidar).all() for step in judged])
    held = ~(open_ | unmatched)
    seconds = _longest_without(held, np.array([step.time for step in judged]))
    count = int(surprising.sum())
    reasons = (
        [f"{count} of {len(judged)} scans move as no sensor does"]
        if _chance(count, len(judged), _SURPRISING_PART[forces]) < _CHANCE
        else []
    )
    reasons += [
        f"{part:.1%} of the scans {what}"
        for part, most, what in (
            (float(open_.mean()), _OPEN_PART[forces], "see too few surfaces to be held in every direction"),
            (float(unmatched.mean()), _UNMATCHED_PART, "do not fit the map of those before them"),
        )
        if part > most
    ]
    if seconds > _BRIDGED_S[forces]:
        reasons.append(f"for {seconds:.1f} s no scan is held in every direction")
    apart = float(np.median(np.diff([step.time for step in steps])))
    if apart > _MOST_APART_S[forces]:
        reasons.append(
            f"scans are {apart:.2f} s apart, so that nothing tells a wrong registration from a motion"
        )
    if not finite.all():
        reasons.append("poses are not finite")
    flagged = np.flatnonzero(open_ | surprising | unmatched | ~finite)
    first = float(judged[flagged[0]].time) if reasons and len(flagged) else None
    return Verdict(
        lost=bool(reasons),
        reasons=tuple(reasons),
        first_s=first,
        open_part=float(open_.mean()),
        surprising_part=float(surprising.mean()),
        unmatched_part=float(unmatched.mean()),
    )


def _chance(count: int, of: int, rate: float) -> float:
    """That `count` or more of so many scans are of a kind that comes at this rate."""
    return float(special.bdtrc(count - 1, of, rate)) if count else 1.0


def _longest_without(held: np.ndarray, times: np.ndarray) -> float:
    """s, the longest time from a held scan, or the first one, to the next that is held, or the last one, past others.

    held: (N,) bool; times: (N,) float64, s, ascending
    """
    ends = np.unique(np.r_[0, np.flatnonzero(held), len(held) - 1])
    past_others = (np.diff(ends) > 1) | ~held[ends[1:]] | ~held[ends[:-1]]
    return float((np.diff(times[ends]) * past_others).max(initial=0.0))
