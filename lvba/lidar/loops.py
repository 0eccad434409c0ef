"""Places that two parts both saw: which pairs may have, and where exactly one is in the other."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar.submap import Submap


@dataclass(frozen=True)
class CandidateConfig:
    """Which pairs of parts are looked at."""

    reach: float = 15.0
    """m: places whose trajectories come closer than this are expected to share surfaces; 1 to 500."""
    drift: float = 0.01
    """Error of the rough position, as a fraction of the path between; 0 to 0.5."""
    drift_deg: float = 0.5
    """Error of the rough heading, degrees for 100 m of path; 0 to 90."""
    pairs_per_part: int = 4
    """Most pairs that a part is in as the later one; 0 to 1000."""


@dataclass(frozen=True)
class Candidate:
    """Two parts that may see the same place.

    first, second: parts; first_scan, second_scan: scans (in the whole) that come closest
    first_from_second: (4, 4) float64, between these by the rough poses
    distance: m, the same; path: m, traveled between them
    sigma_m, sigma_deg: standard deviations of that relative pose
    """

    first: int
    second: int
    first_scan: int
    second_scan: int
    first_from_second: np.ndarray
    distance: float
    path: float
    sigma_m: float
    sigma_deg: float


@dataclass(frozen=True)
class Loop:
    """Where a part is relative to another, as their surfaces say.

    first, second: parts; first_scan, second_scan: indices in the whole, scans near the middle of what both saw
    first_from_second: (4, 4) float64, pose of the second scan in the frame of the first
    information: (6, 6) float64, inverse covariance, local tangent [rotation | translation] at the second scan; zero in
        directions that the surfaces leave open
    overlap: part of what both could see that agrees, 0 to 1; residual: m, typical distance of surfaces
    weak: number of directions left open
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
    weak: int
    accepted: bool
    reason: str


def candidates(
    world_from_scan: np.ndarray, parts: tuple[np.ndarray, ...], config: CandidateConfig = CandidateConfig()
) -> tuple[Candidate, ...]:
    """Pairs of parts that may see the same place though they share no scans, from rough poses alone.

    world_from_scan: (S, 4, 4), rough; parts: indices (n,) of the scans of each
    """
    raise NotImplementedError


def register(a: Submap, b: Submap, candidate: Candidate) -> Loop:
    """Whether two parts see the same place, and their relative pose: looked for where the candidate says it may be."""
    raise NotImplementedError
