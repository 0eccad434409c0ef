"""Settings of merging parts."""

from dataclasses import dataclass

from lvba.settings import check, setting


@dataclass(frozen=True)
class MergeConfig:
    """How the parts of a long recording become one."""

    loops: bool = setting(
        True,
        meaning="Look for places that parts see again.",
        change_when="Different places look alike, and the report names a loop that is none.",
    )
    coarse_rounds: int = setting(
        2,
        meaning="Rounds of the joint LiDAR bundle adjustment with the middle cells, which forgive what merging leaves.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report shows offsets of decimeters between parts after merging (more).",
        advanced=True,
    )
    scan_rounds: int = setting(
        5,
        meaning="Rounds of the joint LiDAR bundle adjustment with the finest cells; rounds after it has settled cost "
        "nothing. 0: no joint adjustment.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report says that scans of joined parts still moved in the last round (more).",
        advanced=True,
    )
    image_rounds: int = setting(
        5,
        meaning="Rounds of the joint visual bundle adjustment; rounds after it has settled cost nothing. 0: none.",
        unit="rounds",
        low=0,
        high=50,
        change_when="The report says that cameras of joined parts still moved in the last round (more).",
        advanced=True,
    )
    near_m: float = setting(
        8.0,
        meaning="Frames that other parts took within this distance of a part's path join its share of the joint visual "
        "bundle adjustment, so that places seen again tie poses and exposures. 0: none.",
        unit="m",
        low=0,
        high=100,
        change_when="Recordings from the air or of wide places (larger), or memory is short (smaller).",
        advanced=True,
    )

    def __post_init__(self) -> None:
        check(self)
