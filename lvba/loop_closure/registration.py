"""The relative pose of two parts that may have seen the same place, or why there is none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.loop_closure import alignments, surfel_icp
from lvba.loop_closure.alignments import Expected
from lvba.loop_closure.candidates import Candidate
from lvba.loop_closure.submap import Patch, Submap, around, uncertainty
from lvba.loop_closure.surfel_icp import Certainty, Target
from lvba.loop_closure.verification import OverlapEvidence
from lvba.optim.pose_graph import Edges
from lvba.settings import check_ranges


@dataclass(frozen=True)
class RegisterConfig:
    """How two submaps are aligned, and when the result is believed."""

    radius: float = 20.0
    """m, surfaces around the two scans that are compared; 2 to 200."""
    starts: int = 48
    """Rough alignments that are tried; 1 to 1000."""
    tolerance: float = 0.06
    """m, furthest that a surface may be from one that it agrees with; 0.01 to 1."""
    min_surfels: int = 150
    """Fewest surfels that agree; 10 to 100000."""
    min_overlap: float = 0.12
    """Least part of the surfels of either submap that agree; 0.01 to 1."""
    min_agreeing: float = 0.975
    """Least part that agrees of the surfels that agree or contradict (are seen through); 0.5 to 1."""
    max_noise_ratio: float = 2.5
    """Furthest that surfaces may lie apart, in standard deviations of their points; 0.1 to 100."""
    rival: float = 0.7
    """Refuse when another alignment gathers more than this part of what the best one does; 0 to 1."""
    open_sigma: float = 0.05
    """m, a direction that is known worse (rotations times the size of the place) counts as open; 0.001 to 10."""
    most_open: int = 2
    """Most directions that may be left open; 0 to 5."""
    blind_m: float = 3.0
    """m: a place that leaves directions open is measured but not recognized, as one corridor is like the next. It is not
    believed where the odometry may be off by more; 0 to 100."""
    floor_m: float = 0.005
    """m, no loop is taken to be known better: the parts' maps bend a little; 0 to 1."""
    floor_deg: float = 0.03
    """The same of its rotation, degrees; 0 to 10."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "loops",
            radius=(2, 200),
            starts=(1, 1000),
            tolerance=(0.01, 1),
            min_surfels=(10, 100_000),
            min_overlap=(0.01, 1),
            min_agreeing=(0.5, 1),
            max_noise_ratio=(0.1, 100),
            rival=(0, 1),
            open_sigma=(0.001, 10),
            most_open=(0, 5),
            blind_m=(0, 100),
            floor_m=(0, 1),
            floor_deg=(0, 10),
        )


@dataclass(frozen=True)
class Loop:
    """Where a part is relative to another, as their surfaces say.

    first, second: parts; first_scan, second_scan: indices in the whole, scans near the middle of what both saw
    first_from_second: (4, 4) float64, pose of the second scan in the frame of the first
    information: (6, 6) float64, inverse covariance, local tangent [rotation | translation] at the second scan; zero in
        directions that the surfaces leave open
    overlap: part of what both could see that agrees, 0 to 1; residual: m, typical distance of surfaces
    open_directions: how many are left open
    accepted: False: the poses above mean nothing; reason: why, or why not
    """

    first: int
    second: int
    first_scan: int
    second_scan: int
    first_from_second: np.ndarray
    information: np.ndarray
    overlap: float
    residual: float
    open_directions: int
    accepted: bool
    reason: str


def edges(loops: Sequence[Loop]) -> Edges:
    """Accepted loops as edges of a pose graph over all scans."""
    return Edges(
        np.array([loop.first_scan for loop in loops], np.int64),
        np.array([loop.second_scan for loop in loops], np.int64),
        np.array([loop.first_from_second for loop in loops]).reshape(-1, 4, 4),
        np.array([loop.information for loop in loops]).reshape(-1, 6, 6),
        np.ones(len(loops), bool),
    )


def register(a: Submap, b: Submap, candidate: Candidate, config: RegisterConfig | None = None) -> Loop:
    """Whether two parts see the same place, and their relative pose: looked for where the candidate says it may be.

    a, b: submaps of the candidate's first and second part
    """
    config = config or RegisterConfig()
    expected = Expected(candidate.first_from_second, candidate.sigma_m, candidate.sigma_deg)
    patches = (
        around(a, candidate.first_scan, config.radius + expected.reach_m),
        around(b, candidate.second_scan, config.radius),
    )
    if min(len(patch) for patch in patches) < config.min_surfels:
        return _refused(candidate, "too few surfaces are known around it")
    target, source = Target.of(patches[0]), Target.of(patches[1])
    tolerance = config.tolerance
    ways = alignments.find(target, source, expected, tolerance=tolerance, starts=config.starts)
    if not ways:
        return _refused(candidate, "no alignment within what the odometry may be off")
    best = alignments.best_of(ways, target, source, tolerance)
    pose = alignments.polished(target, source.patch, best.a_from_b, expected)
    known = _known(target, source.patch, pose, config)
    reason = _contradiction(best.evidence, known, target, source, config) or _blind(known, expected, config)
    if not reason:
        others = alignments.rivals(best, ways, known.open, target, source, tolerance)
        reason = _look_alike(others, config)
    loop = replace(
        _refused(candidate, reason),
        first_from_second=pose,
        overlap=best.evidence.overlap,
        residual=known.sigma,
        open_directions=len(known.open),
    )
    if reason:
        return loop
    uncertainties = (
        uncertainty(a, candidate.first_scan, config.radius),
        uncertainty(b, candidate.second_scan, config.radius),
    )
    information = _with_scans(known.information, *uncertainties, pose)
    left_open = f"; {len(known.open)} of 6 directions open" if len(known.open) else ""
    reason = f"{best.evidence.overlap:.0%} of the surfaces agree within {known.sigma * 1e3:.0f} mm{left_open}"
    return replace(loop, information=information, accepted=True, reason=reason)


_MATCH_M, _MATCH_DEG = 0.5, 20.0


def _known(target: Target, patch: Patch, pose: np.ndarray, config: RegisterConfig) -> Certainty:
    matches = surfel_icp.match(target, patch, pose, _MATCH_M, _MATCH_DEG)
    floor = np.repeat([np.radians(config.floor_deg), config.floor_m], 3)
    return surfel_icp.certainty(target, patch, pose, matches, floor, config.open_sigma)


def _contradiction(
    evidence: OverlapEvidence, known: Certainty, target: Target, source: Target, config: RegisterConfig
) -> str:
    """Why an alignment is not believed; empty if it is."""
    noise = float(np.median(np.concatenate([target.patch.thickness, source.patch.thickness])))
    if evidence.surfels < config.min_surfels:
        return f"only {evidence.surfels} surfels agree, {config.min_surfels} are needed"
    if evidence.overlap < config.min_overlap:
        return f"only {evidence.overlap:.0%} of the surfaces agree, {config.min_overlap:.0%} are needed"
    if evidence.agreeing < config.min_agreeing:
        return f"{1 - evidence.agreeing:.1%} of the surfaces contradict: one place is seen through the other"
    if known.sigma > config.max_noise_ratio * noise:
        return f"surfaces are {known.sigma * 1e3:.0f} mm apart, their noise is {noise * 1e3:.0f} mm"
    if len(known.open) > config.most_open:
        return f"{len(known.open)} of 6 directions are left open"
    return ""


def _blind(known: Certainty, expected: Expected, config: RegisterConfig) -> str:
    """Why a place that leaves directions open is not recognized; empty if it need not be."""
    if len(known.open) == 0 or expected.reach_m <= config.blind_m:
        return ""
    return (
        f"{len(known.open)} of 6 directions are left open: it may be another place that looks alike, "
        f"and the odometry may be off by {expected.reach_m:.1f} m"
    )


def _look_alike(others: list[tuple[float, np.ndarray]], config: RegisterConfig) -> str:
    """Which other alignment could be true as well; empty if none."""
    for part, off in others:
        if part > config.rival:
            away = f"{np.linalg.norm(off[3:]):.1f} m and {np.degrees(np.linalg.norm(off[:3])):.1f} degrees"
            return f"another alignment, {away} away, fits as well: the place looks like others"
    return ""


def _with_scans(
    information: np.ndarray, one: np.ndarray, other: np.ndarray, a_from_b: np.ndarray
) -> np.ndarray:
    """Information (6, 6) of the relative pose of two scans, which are themselves a little off their maps.

    one, other: (6, 6), covariances of the two against the surfaces that were aligned
    """
    second_from_first = geometry.adjoint(geometry.inverse(a_from_b))
    noise = second_from_first @ one @ second_from_first.T + other
    # (information^-1 + noise)^-1, for information of any rank
    total = information @ np.linalg.inv(np.eye(6) + noise @ information)
    return np.asarray(0.5 * (total + total.T))


def _refused(candidate: Candidate, reason: str) -> Loop:
    return Loop(
        first=candidate.first,
        second=candidate.second,
        first_scan=candidate.first_scan,
        second_scan=candidate.second_scan,
        first_from_second=candidate.first_from_second,
        information=np.zeros((6, 6)),
        overlap=0.0,
        residual=float("nan"),
        open_directions=0,
        accepted=False,
        reason=reason,
    )
