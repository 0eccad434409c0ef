"""The method with parts of it left out, or in the form of the paper: for tables, not for results."""

from dataclasses import dataclass

from lvba.visual.variant import PRODUCT, Variant


@dataclass(frozen=True)
class Ablation:
    """What differs from a run. settings: as for `--set`; align_parts: see `lvba.pipeline.refine`."""

    settings: tuple[str, ...] = ()
    variant: Variant = PRODUCT
    align_parts: bool = True


ABLATIONS: dict[str, Ablation] = {
    "full": Ablation(),
    "without global scene points": Ablation(variant=Variant(global_points=False)),
    "without exposures": Ablation(variant=Variant(exposures="none")),
    "joint exposures, as in the paper": Ablation(variant=Variant(exposures="joint")),
    "as-printed score (4)": Ablation(variant=Variant(score="as printed")),
    "without the pose prior": Ablation(variant=Variant(prior=False)),
    "without LiDAR BA": Ablation(("refine_scans=false",)),
    "without plane offsets": Ablation(variant=Variant(plane_offsets=False)),
    "reference pixels that move, as in the paper": Ablation(variant=Variant(reference_pixels="moving")),
    "without visual BA": Ablation(("refine_cameras=false",)),
    "without scans learning from cameras": Ablation(("fusion.enabled=false",)),
    "parts side by side": Ablation(align_parts=False),
}
"""By the name that the tables give them."""
