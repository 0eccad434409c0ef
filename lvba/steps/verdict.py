"""Whether a result is good, in words: figures in, level and reasons out. Nothing here looks at the recording.

The limits of the alarms are those above which expected errors were too small, whatever the scene, before sensors were
refined with the poses: of 89 runs, most with one disturbance of the sensors each, one of the three was raised in 30 of
the 36 whose errors were far above the expected ones, and in 3 of the 53 others. That of the images was then 4.5 times
independent noise; what patches share was not known.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from lvba.products import lengths
from lvba.steps import verdict_input
from lvba.steps.verdict_figures import CONSISTENT, Figures, Level, Reason
from lvba.wording import runs

MOST_OVERDISPERSION, MOST_SPLINE_ERROR, MOST_FUSION_VARIANCE_FACTOR = 1.6, 0.8, 1.2
_FEWEST_FRAMES = 10
"""With fewer, one rigid alignment takes up much of what could be compared."""
_NAMED = 8
"""Images that are named at most."""
_FEW = 0.05
"""Part of the frames that may be less certain than the others: the 95th percentile leaves them out."""
UNCERTAIN = 3.0
"""Times the median expected error above which a frame counts as uncertain."""
_UNSURE = 3.0
"""Standard deviations of the calibrated extrinsic by which the one found may differ from it."""
_LATE_S = 0.06
"""s: stamps of cameras that are off by more are wrong: three times what recordings are supposed to be good for."""
_FEW_PATCHES = 15
"""Pairs of patches per image that chance may choose: of images in the wrong order, 6; textured scenes have hundreds."""
_FEW_ALIKE = 0.25
"""Part of the compared patches that look alike: .47 to .98 in right recordings, with mirrors and foliage, too; .23 if
images are mirrored, .11 if the focal length is 1.5 times as long, .04 and less if they are another recording's or in the
wrong order."""
_OF_EXPECTED = 0.05
"""Part of the expected error that scans may still move by."""
_NO_SOLUTION_M, _NO_SOLUTION_PART = 0.06, 0.5
"""m, and part of the expected error: scans that still move by more are no solution. With poses of odometries that had
lost the way, scans that ended .7 to 50 m off still moved by 86 mm and more, though 77 mm were expected; those that ended
up to 55 mm off, by 19 mm at most. Scans of a depth camera that moved by 51 mm were 11 mm off (113 expected)."""
_WORSE = 1.1
"""Times the input's error up to which a result counts as no worse: references have errors of their own."""


@dataclass(frozen=True)
class Verdict:
    """level: good, check (use it, but look at the reasons first) or bad (do not rely on it)
    at_least: whether errors may well be larger than expected; unknown: whether what is expected says nothing
    """

    level: Level
    reasons: tuple[Reason, ...]
    at_least: bool
    unknown: bool = False


def judge(figures: Figures) -> Verdict:
    """The verdict on a result: as good as the worst of its reasons allows."""
    reasons = [reason for rule in _RULES for reason in rule(figures)]
    reasons.sort(key=lambda reason: (reason.level != "bad", not reason.more))
    order: tuple[Level, ...] = ("good", "check", "bad")
    level: Level = max((reason.level for reason in reasons), key=order.index, default="good")
    more, unknown = any(reason.more for reason in reasons), any(reason.unknown for reason in reasons)
    return Verdict(level, tuple(reasons), more, unknown)


def _rejected(figures: Figures) -> Iterator[Reason]:
    nothing = figures.scan_poses.accepted is False and figures.camera_poses.accepted in (False, None)
    fits = figures.input_fits if nothing else None
    if fits is not None:
        parts = (("scan poses", figures.scan_poses), ("camera poses", figures.camera_poses))
        listed = " and ".join(f"{name} ({part.reason})" for name, part in parts if part.accepted is False)
        yield Reason(
            f"Not used: refined {listed}. The input's are about as good as the data can tell: by them, points lie "
            f"{lengths.text(fits.further_m)} further off the planes that scans share than by refined ones, beside a "
            f"noise of {lengths.text(fits.noise_m)}.",
            "Nothing to do; gate.min_entropy_gain and gate.confidence let smaller gains count.",
        )
    for part, name, mend in (
        (figures.scan_poses, "refined scan poses",
         "Make sure that scans overlap, and that rough poses are within a few decimeters from scan to scan."),
        (figures.camera_poses, "refined camera poses",
         "Check focal length, distortion, extrinsic and time stamps; images need texture, and overlap."),
        (figures.exposures, "refined relative exposures",
         "Nothing to do if all images were exposed alike; else check that neighboring images overlap."),
        (figures.scans_with_cameras, "scans refined with the cameras",
         "The scans keep the LiDAR result. Check time stamps and extrinsic if you expect the cameras to be better."),
    ):  # fmt: skip
        if (
            part.accepted is False
            and not part.confirmed
            and (fits is None or part not in (figures.scan_poses, figures.camera_poses))
        ):
            yield Reason(
                f"Not used: {name} ({part.reason}).",
                mend,
                "bad" if nothing and part in (figures.scan_poses, figures.camera_poses) else "check",
            )


def _alarms(figures: Figures) -> Iterator[Reason]:
    if figures.scan_poses.accepted is False and figures.camera_poses.accepted is not True:
        return  # of the input, no errors are predicted
    yield from _images(figures)
    for value, limit, text, mend in (
        (figures.spline_error, MOST_SPLINE_ERROR,
         "Between frames, cameras and scans do not move alike (spline error {value:.2f}, limit {limit})",
         "Check that scans were undistorted for the motion within them, that clocks agree, and for gaps in time."),
        (figures.fusion_variance_factor, MOST_FUSION_VARIANCE_FACTOR,
         "Scans and cameras differ by {value:.2f} times the variance that their covariances predict (limit {limit})",
         "Check extrinsic, time stamps and camera calibration."),
    ):  # fmt: skip
        if value is not None and value > limit:
            words = text.format(value=value, limit=limit)
            yield Reason(f"{words}: errors are likely larger than the expected ones.", mend, more=True)


def _images(figures: Figures) -> Iterator[Reason]:
    """Images that contradict each other: the expected camera errors include the factor.

    That is not enough where the calibration may be to blame: with one that is wrong and stays as it is, cameras were 9 to
    20 times further off. It is enough where images corrected it: of 50 runs no camera was off by twice what was expected,
    of real recordings 0.3 to 1.2 times.
    """
    factor = figures.overdispersion
    if factor is None or factor <= MOST_OVERDISPERSION:
        return
    words = (
        f"Images contradict each other {factor:.1f} times more than their noise explains "
        f"(limit {MOST_OVERDISPERSION})"
    )
    if figures.camera_refined:
        yield Reason(
            f"{words}, also with the camera refined; the expected camera errors include this factor.",
            "Look at the pictures below: blur, people who walk by and surfaces that shine do that.",
        )
    else:
        yield Reason(
            f"{words}: errors are likely larger than the expected ones.",
            "Check focal length, principal point and distortion in config.yaml; rolling shutter and blur do the same.",
            more=True,
        )


def _ranges(figures: Figures) -> Iterator[Reason]:
    if figures.range_errors and figures.scan_poses.accepted is not False:
        yield Reason(
            "Ranges have systematic errors that were not corrected, or only as single scans show them (see the "
            "warnings): errors may be larger than the expected ones.",
            "Calibrate the range sensor.",
            more=True,
        )


def _registered(figures: Figures) -> Iterator[Reason]:
    """Rough poses that no bundle adjustment could start from."""
    if not figures.registered:
        return
    if figures.scan_poses.accepted is False:
        yield Reason(
            "Surfaces that successive scans see contradict the rough poses, which were kept: they are decimeters off, or "
            "jump.",
            "Run the odometry again, or cut the recording where the map is double.",
            "bad",
            unknown=True,
        )
        return
    if figures.left_steps:
        yield Reason(
            f"{figures.left_steps} motions from scan to scan contradict what both scans see: the result is wrong there.",
            "Run the odometry again, or cut the recording there.",
            "bad",
            more=True,
            unknown=True,
        )
    if figures.open_steps:
        yield Reason(
            f"Where the rough poses are wrong, surfaces and images leave {figures.open_steps} motions from scan to scan "
            "open.",
            "Look at the map on both sides; cut the recording there if surfaces are double.",
            "bad",
            more=True,
            unknown=True,
        )
    if ends := figures.unconnected_ends:
        yield Reason(
            f"Where the rough poses are wrong, neither surfaces nor images determine the pose of {_scans(ends)} at the "
            "end of the recording relative to the others.",
            "Leave it out, or take only the map of the others.",
            more=True,
        )
    instead = "scans were registered to each other first"
    if figures.steps_by_images:
        instead = f"features of the images gave {figures.steps_by_images} motions from scan to scan instead"
    yield Reason(
        "The rough poses were too far off to start from (typically "
        f"{lengths.text(figures.rough_m)} and {figures.rough_deg:.1f} degrees from scan to scan, or jumps): {instead}.",
        "Look at the map for double surfaces; correct the odometry if you can.",
        more=figures.odometry_dependent_steps > 0,  # on one that has proved to be wrong
    )


def _odometry(figures: Figures) -> Iterator[Reason]:
    if figures.jumps:
        sizes = [f"{figures.jump_m:.2f} m"] if figures.jump_m else []
        size = " and ".join(sizes + ([f"{figures.jump_deg:.1f} degrees"] if figures.jump_deg else []))
        times = {1: "once", 2: "twice"}.get(figures.jumps, f"{figures.jumps} times")
        words = f"The rough poses jump {times}, by {'up to ' * (figures.jumps > 1)}{size}"
        if unconfirmed := figures.unconfirmed_jumps:
            yield Reason(
                f"{words}; neither surfaces nor images determine the motion after {_scans(unconfirmed)}.",
                "Run the odometry again, or cut the recording there.",
                "bad",
                more=True,
                unknown=True,
            )
        else:
            yield Reason(
                f"{words}.",
                "Look at the map on both sides of the jump; if surfaces are double there, cut the recording in two.",
            )
    if figures.open_pauses:
        yield Reason(
            "The recording paused, and neither surfaces nor images determine the motion meanwhile, after "
            f"{_scans(figures.open_pauses)}: the odometry alone does.",
            "Look at the map on both sides of the pause; cut the recording there if surfaces are double.",
            more=True,
        )
    if figures.odometry_dependent_steps:
        yield Reason(
            f"{figures.odometry_dependent_steps} motions from scan to scan depend on the odometry alone: scans "
            "before and after them share too few planes.",
            "Look at the map there; record more slowly, or with more overlap between scans.",
        )
    if figures.common_degenerate:
        yield _open_map(figures)
    elif figures.degenerate_scans > _FEW * figures.scans:
        yield Reason(
            f"{figures.degenerate_scans} of {figures.scans} scans see too few surfaces to be held in every direction: "
            "there they follow the odometry or the cameras.",
            "Look at these frames: they are among those with the largest expected errors.",
        )


def _open_map(figures: Figures) -> Reason:
    """Motions of the whole map that surfaces leave open. Unused cameras may show that the odometry is wrong there: in
    corridors, by odometries 0.2 to 1.7 m off, they had scans elsewhere by 4 to 22 times the expected error."""
    words = f"Surfaces leave {figures.common_degenerate} motions of the whole map open (as along a corridor)"
    apart, expected = figures.apart_from_cameras_m, figures.scans_m
    if apart is not None and expected is not None and apart > CONSISTENT * expected:
        return Reason(
            f"{words}: there it is as the odometry has it, and images contradict that. By them, scans are "
            f"{lengths.text(apart)} elsewhere.",
            "Compare a length along the open direction with one that you know; run another odometry, or record "
            "surfaces that face that direction.",
            "bad",
            more=True,
            unknown=True,
        )
    return Reason(
        f"{words}: there it is as the {'images have' if figures.scans_with_cameras.accepted else 'odometry has'} it.",
        "Nothing to do if that is good enough there; else record surfaces that face the open direction.",
    )


def _frames(figures: Figures) -> Iterator[Reason]:
    for count, total, kind in (
        (figures.uncertain_scans, figures.scans, "scans"),
        (figures.uncertain_cameras, figures.images, "cameras"),
    ):
        if count > _FEW * total:
            yield Reason(
                f"{count} of {total} {kind} have expected errors that are unknown or more than {UNCERTAIN:.0f} times the "
                "median.",
                "See the expected error by frame.",
            )
    if uncertain := figures.uncertain_exposures:
        yield Reason(
            f"The exposures of {len(uncertain)} of {figures.images} images ({runs(uncertain, _NAMED)}) have expected "
            f"errors that are unknown or more than {UNCERTAIN:.0f} times the median: few surfaces tie them to others, or "
            "they contradict each other.",
            "Look at these images: people who walk by, glass and mirrors do that. Colors may differ there.",
        )
    if figures.white_balance is not None:
        yield Reason(
            f"The white balance changes between images by {figures.white_balance:.1f} % (root mean square): in parts, "
            "exposures and cameras depend a little on the colors that images show.",
            "A fixed white balance makes better maps; so does a run in one part, where memory allows.",
        )
    few = [
        f"{count} {kind}"
        for count, kind in ((figures.scans, "scans"), (figures.images, "images"))
        if 0 < count < _FEWEST_FRAMES
    ]
    if few:
        yield Reason(
            f"Only {' and '.join(few)}: expected errors of so few frames mean little.", "Use more frames."
        )


def _converged(figures: Figures) -> Iterator[Reason]:
    moved, known = figures.moved_m, figures.scan_p95_m
    if moved is not None and (known is None or moved > _OF_EXPECTED * known):
        yield Reason(
            f"Scan poses had not converged: they still moved by {1000 * moved:.1f} mm in the last round.",
            "Give more rounds (lidar.rounds, in parts merge.scan_rounds), or better rough poses.",
            level="bad" if moved > max(_NO_SOLUTION_M, _NO_SOLUTION_PART * (known or 0.0)) else "check",
            more=known is not None and moved > known,
        )
    if not figures.cameras_converged:
        yield Reason(
            "Camera poses had not converged at full resolution.",
            "Give more iterations (visual.iterations).",
        )


def _clock(figures: Figures) -> Iterator[Reason]:
    if abs(figures.late_s) > _LATE_S:
        yield Reason(
            f"By the clock of the LiDAR, images were taken {1e3 * abs(figures.late_s):.0f} ms "
            f"{'after' if figures.late_s > 0 else 'before'} their stamps; the cameras are corrected for it.",
            "Correct the stamps by as much and run again; check that each image has its own stamp.",
        )


def _patches(figures: Figures) -> Iterator[Reason]:
    if figures.alike is not None and figures.alike < _FEW_ALIKE:
        yield Reason(
            f"The images do not show what the scans see: only {100 * figures.alike:.0f} % of the patches that "
            "neighboring images should both show look alike in them. Camera poses and colors are wrong.",
            "Check that images belong to this recording and to their stamps, are neither mirrored nor turned, and that "
            "focal length and extrinsic are right.",
            "bad",
            more=True,
        )
    elif figures.patches_per_image is not None and figures.patches_per_image < _FEW_PATCHES:
        yield Reason(
            f"Only {figures.patches_per_image:.0f} pairs of patches per image look alike: chance may have chosen them.",
            "Check that images belong to their stamps and to this recording, and look at the colors of the map.",
            more=True,
        )


def _extrinsic(figures: Figures) -> Iterator[Reason]:
    if figures.extrinsic_sigmas is not None and figures.extrinsic_sigmas > _UNSURE:
        yield Reason(
            f"The estimated camera extrinsic differs from its calibration by {100 * figures.extrinsic_m:.1f} cm and "
            f"{figures.extrinsic_deg:.2f} degrees.",
            "If you trust the calibration, doubt the camera poses; otherwise use the estimated extrinsic (report.json).",
        )


def _looks(figures: Figures) -> Iterator[Reason]:
    if figures.ssim is not None:
        before, after = figures.ssim
        yield Reason(
            f"Images predicted from the map have lost structure (SSIM {before:.3f} before, {after:.3f} after).",
            "Look at the pictures below, at edges above all.",
        )
    if figures.small_losses:
        yield Reason(
            f"Used although images are predicted worse: {'; '.join(figures.small_losses)}.",
            "This alone says nothing sure of geometry; a reference would tell (--reference).",
        )
    if figures.thickness is not None:
        before, after = (1000 * value for value in figures.thickness)
        yield Reason(
            f"Planes have become thicker ({before:.1f} mm before, {after:.1f} mm after).",
            "Look at the map from the side of a wall or the floor.",
        )


def _scale(figures: Figures) -> Iterator[Reason]:
    """Errors that are more than expected, and that a common factor takes out."""
    off = [
        one
        for one in figures.truth
        if one.scaled is not None and replace(one, scaled=None).inconsistent and not one.inconsistent
    ]
    if off and figures.scale is not None:
        way = "smaller" if figures.scale > 1 else "larger"
        yield Reason(
            f"Against the reference, the map is {100 * abs(1 - 1 / figures.scale):.2f} % {way}, as the LiDAR's ranges "
            "are: expected errors leave that out.",
            "Calibrate the scale of the LiDAR's ranges, or scale the map.",
        )


def _truth(figures: Figures) -> Iterator[Reason]:
    for what in dict.fromkeys(one.what for one in figures.truth):
        mine = [one for one in figures.truth if one.what == what]
        larger = [(one, one.predicted) for one in mine if one.predicted is not None and one.inconsistent]
        if larger:
            listed = " and ".join(
                f"{_amount(one.error, one.unit)} (expected: {_amount(predicted, one.unit)})"
                for one, predicted in larger
            )
            yield Reason(
                f"Against the reference, {what} are off by {listed}.",
                "Go by the error against the reference, unless that is no better itself.",
                more=True,
            )
        worse = [(one, one.rough) for one in mine if one.rough is not None]
        worse = [(one, rough) for one, rough in worse if one.error > _WORSE * rough]
        if worse:
            listed = " and ".join(
                f"{_amount(one.error, one.unit)} instead of {_amount(rough, one.unit)}"
                for one, rough in worse
            )
            spoiled = any(one.unit == "m" and one.error > (one.predicted or 0.0) for one, _ in worse)
            yield Reason(
                f"Against the reference, {what} are worse than the input: {listed}.",
                f"Keep the input's {what}, unless the reference is no better itself.",
                "bad" if spoiled else "check",
            )


def _scans(numbers: Sequence[int]) -> str:
    """Their numbers, for people."""
    return f"scan{'s' * (len(numbers) > 1)} {runs(numbers, _NAMED)}"


def _amount(value: float, unit: str) -> str:
    if unit == "m":
        return lengths.text(value)
    return f"{value:.2f} degrees"


_RULES: tuple[Callable[[Figures], Iterator[Reason]], ...] = (
    _rejected,
    verdict_input.reasons,
    _truth,
    _scale,
    _alarms,
    _ranges,
    _registered,
    _odometry,
    _frames,
    _converged,
    _clock,
    _patches,
    _extrinsic,
    _looks,
)
