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

_EXTRINSIC_FIXED = ("visual.prior.extrinsic_position_m=0.0001", "visual.prior.extrinsic_rotation_deg=0.001")
_CLOCKS_FIXED = ("visual.prior.time_offset_s=0.000001",)

MODELS: dict[str, Ablation] = {
    "camera": Ablation(("visual.calibrate=false",)),
    "vignetting and response": Ablation(("visual.vignetting=false",)),
    "white balance": Ablation(variant=Variant(white_balance=False)),
    "extrinsic": Ablation(_EXTRINSIC_FIXED),
    "time offset": Ablation(_CLOCKS_FIXED),
    "errors of scans": Ablation(variant=Variant(scan_errors=False)),
    "all of these": Ablation(
        ("visual.calibrate=false", "visual.vignetting=false", *_EXTRINSIC_FIXED, *_CLOCKS_FIXED),
        Variant(white_balance=False, scan_errors=False),
    ),
}
"""Without one model of what sensors do, by the name of the model."""
