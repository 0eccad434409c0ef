"""What the method is made of."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Variant:
    """Parts of the method, some of them in the form of the paper. Runs use the default; it is no setting of a run.

    prior: hold cameras to the LiDAR trajectory; False: no prior, as in the paper
    plane_offsets: planes may move along their normals as far as the LiDAR's noise lets them; False: as in the paper
    exposures: "means": from robust log ratios of patch means; "joint": unknowns of the photometric cost, as in the
        paper; "none": all images are taken as equally exposed
    reference_pixels: "fixed": a patch stays at its whole pixels of the reference image; "moving": it moves with the
        reference's pose, as in the paper: slower and less accurate
    global_points: points and targets through the global visibility voxel map
    score: best view of a voxel, eq. (4): "area", pixels per m^2, or "as printed"
    white_balance: where it changes from image to image, it is taken out of the images
    scan_errors: what is systematically wrong with scans is measured and taken out of their points
    camera: "refined": what images call to correct of its calibration is; "as calibrated": nothing is, and what images
        want otherwise counts as an error of the poses
    """

    prior: bool = True
    plane_offsets: bool = True
    exposures: Literal["means", "joint", "none"] = "means"
    reference_pixels: Literal["fixed", "moving"] = "fixed"
    global_points: bool = True
    score: Literal["area", "as printed"] = "area"
    white_balance: bool = True
    scan_errors: bool = True
    camera: Literal["refined", "as calibrated"] = "refined"


PRODUCT = Variant()
"""What runs use."""
