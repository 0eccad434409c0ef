"""Settings of the visual bundle adjustment."""

from dataclasses import dataclass, field

from lvba.settings import Group, setting
from lvba.visual.image import ImageConfig
from lvba.visual.keyframes import KeyframeConfig
from lvba.visual.prior_config import PriorConfig
from lvba.visual.scene_points import PointsConfig
from lvba.visual.visibility import VisibilityConfig


@dataclass(frozen=True)
class VisualConfig(Group):
    """Visual bundle adjustment: how camera poses and exposures are refined."""

    levels: int = setting(
        4,
        meaning="Pyramid levels; the finest is the full image. Fewer are used where the coarsest would be narrower than "
        "80 px. Images of 160 px forgive 5 cm between neighbors, but a group of scans may be further off the others.",
        low=1,
        high=6,
        change_when="The rough poses are good to a few pixels (fewer: faster), or very rough (more).",
    )
    patch: int = setting(
        9,
        meaning="Side of the square patches that images are compared over.",
        unit="px",
        low=3,
        high=21,
        odd=True,
        change_when="Images are noisy or blurred (larger), or planes are small in them (smaller).",
    )
    iterations: int = setting(
        12,
        meaning="Most steps of the solver in one solve; it ends sooner where the cost hardly falls any more.",
        unit="steps",
        low=1,
        high=1000,
        change_when="The report says that cameras had not converged (more).",
        advanced=True,
    )
    calibrate: bool = setting(
        True,
        meaning="Refine focal lengths, principal point, lens and readout time of the rows with the poses, at the finest "
        "level, each only where its correction cannot be chance.",
        change_when="The intrinsics are known to be exact and the shutter is global (false).",
    )
    vignetting: bool = setting(
        True,
        meaning="Find how light falls off towards the corners of images, and the curve that grey values pass, and take "
        "both out of them.",
        change_when="Images were corrected for both before (false).",
        advanced=True,
    )
    images: ImageConfig = field(default_factory=ImageConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)


DEFAULTS = VisualConfig()
