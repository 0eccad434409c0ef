"""Which pairs of parts may have seen the same place, from rough poses alone."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from lvba import geometry
from lvba.arrays import Poses
from lvba.loop_closure.alignments import SIGMAS
from lvba.settings import check_ranges


@dataclass(frozen=True)
class CandidateConfig:
    """Which pairs of parts are looked at."""

    reach: float = 15.0
    """m: places whose trajectories come closer than this are expected to share surfaces; 1 to 500."""
    drift: float = 0.01
    """Error of the rough position, as a fraction of the path between; 0 to 0.5."""
    drift_deg: float = 0.5
    """Error of the rough heading, degrees for 100 m of path; 0 to 90."""
    least_m: float = 0.5
    """m, added to the error of the rough position: an odometry that starts anew jumps; 0 to 100."""
    least_deg: float = 1.5
    """The same of the rough heading, degrees; 0 to 45."""
    most_m: float = 15.0
    """m: errors of the rough position beyond are not allowed for, as the search would take too long; 0.1 to 200."""
    most_deg: float = 10.0
    """The same of the rough heading, degrees; 0.1 to 45."""
    pairs_per_part: int = 4
    """Most pairs that a part is in as the later one; 0 to 1000."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "loops",
            reach=(1, 500),
            drift=(0, 0.5),
            drift_deg=(0, 90),
            least_m=(0, 100),
            least_deg=(0, 45),
            most_m=(0.1, 200),
            most_deg=(0.1, 45),
            pairs_per_part=(0, 1000),
        )


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


def candidates(
    world_from_scan: Poses, parts: tuple[np.ndarray, ...], config: CandidateConfig | None = None
) -> tuple[Candidate, ...]:
    """Pairs of parts that may see the same place though they share no scans, from rough poses alone.

    world_from_scan: (S, 4, 4), rough; parts: indices (n,) of the scans of each
    The later part of a pair keeps those that are expected to be closest.
    """
    config = config or CandidateConfig()
    odometry = _Odometry.of(world_from_scan, config)
    kept: list[Candidate] = []
    for second, first in odometry.in_reach(parts):
        near = [replace(odometry.closest(parts[k], parts[second]), first=k, second=second) for k in first]
        near = [pair for pair in near if pair.distance < config.reach + SIGMAS * pair.sigma_m]
        near.sort(key=lambda pair: pair.distance / (config.reach + pair.sigma_m))
        kept.extend(sorted(near[: config.pairs_per_part], key=lambda pair: pair.first))
    return tuple(kept)


@dataclass(frozen=True)
class _Odometry:
    """Rough poses (S, 4, 4), the path up to each (S,), and how wide all of it is, m."""

    world_from_scan: np.ndarray
    path: np.ndarray
    widest: float
    config: CandidateConfig

    @staticmethod
    def of(world_from_scan: np.ndarray, config: CandidateConfig) -> "_Odometry":
        position = world_from_scan[:, :3, 3]
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        path = np.concatenate([[0.0], np.cumsum(steps)])
        return _Odometry(world_from_scan, path, float(np.linalg.norm(np.ptp(position, axis=0))), config)

    def sigmas(self, traveled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (m, degrees) of relative poses, by the path between (m)."""
        config = self.config
        turned = config.drift_deg * traveled / 100.0
        lever = np.minimum(0.5 * traveled, self.widest)
        sigma_m = config.drift * traveled + np.radians(turned) * lever + config.least_m
        return np.minimum(sigma_m, config.most_m), np.minimum(turned + config.least_deg, config.most_deg)

    def in_reach(self, parts: tuple[np.ndarray, ...]) -> Iterator[tuple[int, list[int]]]:
        """Each part with those before it that share no scan with it and may come near it, by spheres around both."""
        position = [self.world_from_scan[part, :3, 3] for part in parts]
        center = np.array([0.5 * (p.min(0) + p.max(0)) for p in position])
        radius = np.array(
            [np.linalg.norm(p - c, axis=1).max() for p, c in zip(position, center, strict=True)]
        )
        low, high = (np.array([what(self.path[part]) for part in parts]) for what in (np.min, np.max))
        for second, later in enumerate(parts):
            longest = np.maximum(high[second] - low[:second], high[:second] - low[second])
            away = np.linalg.norm(center[:second] - center[second], axis=1) - radius[:second] - radius[second]
            near = np.flatnonzero(away < self.config.reach + SIGMAS * self.sigmas(longest)[0]).tolist()
            yield second, [k for k in near if len(np.intersect1d(parts[k], later)) == 0]

    def closest(self, earlier: np.ndarray, later: np.ndarray) -> Candidate:
        """The two scans that come closest for what the odometry may be off between them."""
        apart = cdist(self.world_from_scan[earlier, :3, 3], self.world_from_scan[later, :3, 3])
        traveled = np.abs(self.path[later][None] - self.path[earlier][:, None])
        sigma_m, sigma_deg = self.sigmas(traveled)
        i, j = np.unravel_index(np.argmin(apart / (self.config.reach + sigma_m)), apart.shape)
        one, other = int(earlier[i]), int(later[j])
        relative = geometry.inverse(self.world_from_scan[one]) @ self.world_from_scan[other]
        return Candidate(
            first=0,
            second=0,
            first_scan=one,
            second_scan=other,
            first_from_second=relative,
            distance=float(apart[i, j]),
            path=float(traveled[i, j]),
            sigma_m=float(sigma_m[i, j]),
            sigma_deg=float(sigma_deg[i, j]),
        )
