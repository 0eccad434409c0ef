"""Settings of merging parts."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MergeConfig:
    """How parts become one."""

    align: bool = True
    """Tie the parts by a pose graph over their overlaps; False: every scan is where the part whose core it is in put
    it, with steps at the seams (for comparison)."""
    loops: bool = True
    """Look for places that parts see again."""
    coarse_rounds: int = 2
    """Rounds of the joint LiDAR bundle adjustment with the middle cells, which forgive what merging leaves; 0 to 50."""
    scan_rounds: int = 5
    """Its rounds with the finest cells; rounds after it has settled cost nothing; 0 (no joint adjustment) to 50."""
    image_rounds: int = 5
    """Rounds of the joint visual bundle adjustment; rounds after it has settled cost nothing; 0 (none) to 50."""
    near_m: float = 8.0
    """Frames that other parts took within this distance of a part's path, m, join its share of the joint visual bundle
    adjustment, so that places seen again tie poses and exposures; 0 (none) to 100."""

    def __post_init__(self) -> None:
        for name, high in (("coarse_rounds", 50), ("scan_rounds", 50), ("image_rounds", 50), ("near_m", 100)):
            if not 0 <= getattr(self, name) <= high:
                raise ValueError(f"merge.{name} is {getattr(self, name)}, must be within 0 to {high}")
