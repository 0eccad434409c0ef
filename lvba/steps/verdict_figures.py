"""What a verdict is made from, and the reasons it is made of: plain data."""

from dataclasses import dataclass, field
from typing import Literal

from lvba.dataset import InputFindings

Level = Literal["good", "check", "bad"]

CONSISTENT = 3.0
"""Times the predicted error up to which an error is consistent with it."""


@dataclass(frozen=True)
class Judged:
    """A part of the result that was judged against its input. accepted: None if there is nothing to judge; confirmed:
    whether the input's is used because it is as good"""

    accepted: bool | None = None
    reason: str = ""
    confirmed: bool = False


@dataclass(frozen=True)
class InputFits:
    """How well the input's scan poses lay points on planes, where nothing speaks against them.

    further_m: by how much more points scatter about the planes that scans share than at the refined poses (squared: the
        difference of the squares); noise_m: what they scatter by there
    """

    further_m: float
    noise_m: float


@dataclass(frozen=True)
class Truth:
    """An error against the reference, of the result and of the input, and the predicted one (None: nothing is predicted).

    what: scans or cameras; unit: m or degrees
    scaled: the error after one common factor, which predictions do not include; None: not known
    """

    what: str
    unit: Literal["m", "degrees"]
    error: float
    rough: float | None = None
    predicted: float | None = None
    scaled: float | None = None

    @property
    def inconsistent(self) -> bool:
        """Whether the error is too large for the predicted one, in the scale of the LiDAR's ranges: nothing in a
        recording tells that."""
        error = self.error if self.scaled is None else self.scaled
        return self.predicted is not None and error > CONSISTENT * self.predicted


@dataclass(frozen=True)
class Figures:
    """What the verdict is made from; None or 0 where there is none.

    overdispersion: actual variance of the pixels over what their noise makes of it, which patches share
    spline_error: how far the path through the cameras misses the scans, as part of the error of leaving a camera out
    camera_refined: whether images corrected the calibration of the camera
    fusion_variance_factor: actual over predicted variance of the differences between scans and cameras
    uncertain_scans, uncertain_cameras: how many frames have expected errors that are unknown or more than
        `verdict.UNCERTAIN` times the median
    uncertain_exposures: numbers of the images whose exposures have, if errors of this size can be seen
    white_balance: percent, root mean square, by which it changes between images that joint rounds take as they are
    apart_from_cameras_m: root mean square distance of scans from where cameras would have moved them, where that is not
        used; scans_m: their expected error
    moved_m: how far a scan moved at most in the last round that did not converge; scan_p95_m: what 95 % of the scans are
        expected to be off by less
    range_errors: systematic errors of the range sensor that are in the points
    registered: whether rough poses were so far off that scans were registered to each other first; rough_m, rough_deg: by
        how much from scan to scan; open_steps, left_steps: motions between scans that this left open and images do not
        confirm, and that are wrong in the result; unconnected_ends: scans at the ends that only an open motion ties;
        steps_by_images: motions that features of images gave instead
    jumps: frames after which the rough poses jump; jump_m, jump_deg: by at most; unconfirmed_jumps: those where
        neither surfaces nor images determine the motion; open_pauses: frames after which the recording paused, and
        only the odometry determines the motion meanwhile
    late_s: how long after their stamps images were taken, by the clock of the LiDAR
    patches_per_image: pairs of patches that determine cameras; None: no cameras are used
    alike: part of the patches that neighboring images should both show which look alike in them, of the worst part
    extrinsic_sigmas: by how many standard deviations the extrinsic found differs from the calibrated one
    scale: of the reference over the result; None: there is no reference
    input_fits: None: the input's poses are not as good as what was refined, or something speaks against both
    ssim: of images predicted from the map, before and after, where the loss is beyond chance
    thickness: of planes, m, before and after, where they have become thicker beyond chance
    small_losses: what used parts lost in how well images are predicted, beyond chance, without being refused for it
    input: what speaks against the files of the recording
    """

    scans: int = 0
    images: int = 0
    scan_poses: Judged = field(default_factory=Judged)
    camera_poses: Judged = field(default_factory=Judged)
    exposures: Judged = field(default_factory=Judged)
    scans_with_cameras: Judged = field(default_factory=Judged)
    overdispersion: float | None = None
    camera_refined: bool = False
    spline_error: float | None = None
    fusion_variance_factor: float | None = None
    common_degenerate: int = 0
    degenerate_scans: int = 0
    odometry_dependent_steps: int = 0
    uncertain_scans: int = 0
    uncertain_cameras: int = 0
    uncertain_exposures: tuple[int, ...] = ()
    white_balance: float | None = None
    apart_from_cameras_m: float | None = None
    scans_m: float | None = None
    moved_m: float | None = None
    scan_p95_m: float | None = None
    cameras_converged: bool = True
    range_errors: int = 0
    registered: bool = False
    rough_m: float = 0.0
    rough_deg: float = 0.0
    open_steps: int = 0
    unconnected_ends: tuple[int, ...] = ()
    left_steps: int = 0
    steps_by_images: int = 0
    jumps: int = 0
    jump_m: float = 0.0
    jump_deg: float = 0.0
    unconfirmed_jumps: tuple[int, ...] = ()
    open_pauses: tuple[int, ...] = ()
    extrinsic_sigmas: float | None = None
    extrinsic_m: float = 0.0
    extrinsic_deg: float = 0.0
    late_s: float = 0.0
    patches_per_image: float | None = None
    alike: float | None = None
    ssim: tuple[float, float] | None = None
    small_losses: tuple[str, ...] = ()
    thickness: tuple[float, float] | None = None
    truth: tuple[Truth, ...] = ()
    scale: float | None = None
    input_fits: InputFits | None = None
    input: InputFindings = field(default_factory=InputFindings)


@dataclass(frozen=True)
class Reason:
    """Why a result is not simply good, and what to do about it.

    level: what it makes of the result at best; more: whether errors may well be larger than the covariances predict
    unknown: whether the covariances say nothing about the errors
    """

    text: str
    mend: str
    level: Level = "check"
    more: bool = False
    unknown: bool = False
