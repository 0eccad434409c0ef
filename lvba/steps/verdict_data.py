"""The verdict on a run from the facts of its report, and the `verdict` and `alarms` parts of the report."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lvba.dataset import InputFindings
from lvba.lidar.bundle_adjustment import odometry_dependent_steps
from lvba.products import lengths, renamed_facts
from lvba.steps import verdict
from lvba.steps.acceptance import CONTRADICTION, standard_error
from lvba.steps.verdict import Verdict
from lvba.steps.verdict_figures import Figures, InputFits, Judged, Truth
from lvba.wording import joined

Facts = Mapping[str, Any]

_SSIM_SURE, _SSIM_LEAST = 2.0, 0.005
"""Standard errors, over images, by which SSIM must fall or rise, and the least change that means something."""
_AS_GOOD = 1.25
"""Times the squared distances of points from planes at refined poses that those at the input's may have: points scatter
by a ninth more. Where inputs were refined with gain, it was mostly 4 to 300 times."""
_THIN = 1.5
"""Times the noise of points that planes of the whole map may be thick: of what refined poses leave double or apart, the
distances from planes found with them tell nothing."""
_NOISE_BEFORE = 2.0
"""The variance factor of noise in results from before it was known: cameras that move have 1.6 to 2.1."""

_JUDGED = (
    ("refined scans", "lidar", ""),
    ("exposures", "visual", "exposures_"),
    ("cameras", "visual", ""),
    ("scans refined with the cameras", "fusion", ""),
)
_HELD_OUT = {
    "psnr_leave_one_out": ("{:.2f} \N{PLUS-MINUS SIGN} {:.2f} dB PSNR", 0.02),
    "ssim_leave_one_out": ("{:.4f} \N{PLUS-MINUS SIGN} {:.4f} SSIM", 0.001),
}
"""Held-out scores, and the least losses that are told: rendering alone makes smaller ones."""


def add(facts: Facts) -> dict[str, Any]:
    """The facts with `verdict` and `alarms`, and `at_least` among the expected errors: whether errors may be larger.

    facts: plain data, the contents of report.json
    """
    known = figures(facts)
    judged = verdict.judge(known)
    expected = {**(facts.get("expected_error") or {}), "at_least": judged.at_least}
    return {
        **facts,
        "expected_error": expected,
        "alarms": _alarms(known),
        "verdict": {
            "level": judged.level,
            "summary": summary(judged, expected, known.truth),
            "reasons": [{"text": each.text, "mend": each.mend} for each in judged.reasons],
        },
    }


def _alarms(known: Figures) -> dict[str, dict[str, float | None]]:
    """What tells that covariances predict errors that are too small, each with the limit above which it does."""
    return {
        "overdispersion": {"value": known.overdispersion, "limit": verdict.MOST_OVERDISPERSION},
        "spline_error": {"value": known.spline_error, "limit": verdict.MOST_SPLINE_ERROR},
        "fusion_variance_factor": {
            "value": known.fusion_variance_factor,
            "limit": verdict.MOST_FUSION_VARIANCE_FACTOR,
        },
    }


def figures(facts: Facts) -> Figures:
    """What the verdict is made from; parts that the facts lack count as nothing to complain of."""
    dataset, lidar, visual = (facts.get(name) or {} for name in ("dataset", "lidar", "visual"))
    fusion, odometry = facts.get("fusion") or {}, facts.get("odometry") or {}
    ranges = lidar.get("range_errors") or {}
    expected, planes = facts.get("expected_error") or {}, facts.get("planes") or {}
    last = (visual.get("levels") or [{}])[-1]
    history = lidar.get("history") or [{}]
    used = lidar.get("accepted") is not False
    degenerate_scans, dependent_steps = _undetermined(lidar)
    extrinsic, balance = visual.get("extrinsic") or {}, visual.get("white_balance") or {}
    confirmed = visual.get("confirmed") is True
    fused = "moved_m" in fusion and (confirmed or visual.get("accepted") is not False) and used
    ssim = _changed_ssim(facts.get("evaluation") or {})
    ssim_rose = ssim is not None and ssim[1] > ssim[0]
    return Figures(
        scans=dataset.get("scans") or 0,
        images=dataset.get("images") or 0,
        scan_poses=Judged(lidar.get("accepted"), _cause(lidar)),
        camera_poses=Judged(visual.get("accepted"), _cause(visual), confirmed),
        exposures=Judged(visual.get("exposures_accepted"), _cause(visual, "exposures_")),
        scans_with_cameras=Judged(fusion.get("accepted") if fused else None, _cause(fusion)),
        overdispersion=_overdispersion(last),
        camera_refined=_camera_refined(visual),
        spline_error=renamed_facts.value(fusion, "interpolation_error_scale"),
        fusion_variance_factor=renamed_facts.value(fusion, "variance_factor"),
        common_degenerate=len(renamed_facts.value(lidar, "degenerate_directions") or []) if used else 0,
        degenerate_scans=degenerate_scans if used else 0,
        odometry_dependent_steps=dependent_steps if used else 0,
        uncertain_scans=_uncertain(expected.get("scans")),
        uncertain_cameras=_uncertain(expected.get("cameras")),
        uncertain_exposures=tuple(renamed_facts.value(visual, "uncertain_exposures") or ()),
        white_balance=balance.get("change_percent") if balance.get("used") and facts.get("merge") else None,
        apart_from_cameras_m=_apart_from_cameras(fusion) if used else None,
        scans_m=(expected.get("scans") or {}).get("position_m"),
        moved_m=history[-1].get("moved") if used and lidar.get("converged") is False else None,
        scan_p95_m=(expected.get("scans") or {}).get("position_p95_m"),
        cameras_converged=last.get("converged") is not False,
        range_errors=_left_ranges(ranges, in_parts=bool(facts.get("merge"))),
        **_rough_poses(odometry),
        extrinsic_sigmas=extrinsic.get("sigmas") if visual.get("accepted") is not False else None,
        extrinsic_m=extrinsic.get("change_m") or 0.0,
        extrinsic_deg=extrinsic.get("change_deg") or 0.0,
        **_images(visual),
        small_losses=tuple(_small_losses(facts, ssim_rose)),
        ssim=None if ssim_rose else ssim,
        thickness=_thicker(planes),
        truth=tuple(_truth(facts.get("reference") or {})),
        scale=((facts.get("reference") or {}).get("lidar") or {}).get("scale"),
        input=_input(dataset.get("findings") or {}),
        input_fits=_input_fits(
            lidar, visual, planes, bool(odometry.get("too_far_off")), degenerate_scans + dependent_steps
        ),
    )


def _images(visual: Facts) -> dict[str, Any]:
    """How much images look alike; how late they are, and how much ties them, where cameras are used."""
    observations, keyframes = visual.get("observations"), visual.get("keyframes")
    alike = {"alike": visual.get("alike")}
    if visual.get("accepted") is False or not keyframes:
        return alike
    late = (visual.get("time_offset") or {}).get("seconds") or 0.0
    return alike | {"late_s": late, "patches_per_image": observations and observations / keyframes}


def _input(findings: Facts) -> InputFindings:
    """What the report says against the files; names that only another version knows are passed over."""
    known = {field.name for field in dataclasses.fields(InputFindings)}
    return InputFindings(**{name: value for name, value in findings.items() if name in known})


def _apart_from_cameras(fusion: Facts) -> float | None:
    """m, root mean square: how far cameras would have moved the scans, which did not follow them."""
    moved = fusion.get("moved_m") or ()
    return float(np.sqrt(np.mean(np.square(moved)))) if moved and fusion.get("accepted") is False else None


def _overdispersion(level: Facts) -> float | None:
    """By what factor images contradict each other more than the noise of their pixels explains."""
    actual = renamed_facts.value(level, "variance_factor")
    return None if actual is None else actual / level.get("noise_variance_factor", _NOISE_BEFORE)


def _camera_refined(visual: Facts) -> bool:
    """Whether focal lengths, principal point, distortion or readout were refined with the poses."""
    refined = (visual.get("calibration") or {}).get("sigma") or {}
    return any(name in refined for name in ("focal", "principal_point", "distortion", "readout"))


def _left_ranges(ranges: Facts, in_parts: bool) -> int:
    """How many errors of ranges are in the points; by the planes of the map, joint rounds correct none."""
    by_single_scans = in_parts and "incidence" in (ranges.get("corrected") or [])
    return len(ranges.get("noticed") or []) + bool(ranges.get("problem")) + by_single_scans


def _rough_poses(odometry: Facts) -> dict[str, Any]:
    """The figures of rough poses that are too far off for planes, and of those that jump."""
    far = odometry.get("too_far_off") or {}
    return {
        "registered": bool(far),
        "rough_m": far.get("step_m") or 0.0,
        "rough_deg": far.get("step_deg") or 0.0,
        "open_steps": len(far.get("open_after") or []),
        "unconnected_ends": tuple(renamed_facts.value(far, "unconnected_ends") or ()),
        "left_steps": len(far.get("left_after") or []),
        "steps_by_images": len(far.get("by_images") or []),
        "jumps": len(odometry.get("jumps_after") or []),
        "jump_m": max(odometry.get("jumps_m") or [0.0]),
        "jump_deg": max(odometry.get("jumps_deg") or [0.0]),
        "open_pauses": tuple(odometry.get("pauses_after") or ()),
        "unconfirmed_jumps": tuple(renamed_facts.value(odometry, "unconfirmed_after") or ()),
    }


def _input_fits(lidar: Facts, visual: Facts, planes: Facts, far: bool, open_motions: int) -> InputFits | None:
    """How well rejected poses were not needed; None: they were, or it is not sure. far: scans were registered first"""
    before, after = lidar.get("cost_initial"), lidar.get("cost_final")
    noise = (lidar.get("history") or [{}])[-1].get("sigma")
    thick = planes.get("thickness_before_m")
    if lidar.get("accepted") is not False or not (before and after and noise and thick):
        return None
    judged = [*(lidar.get("judged") or []), *(visual.get("judged") or [])]
    against = {each["finding"] for each in judged} & {"worse", "unknown"}
    open_motions += len(renamed_facts.value(lidar, "degenerate_directions") or [])
    if far or open_motions or against or not lidar.get("judged") or lidar.get("converged") is not True:
        return None
    if before > _AS_GOOD * after or thick > _THIN * noise:
        return None
    return InputFits(noise * float(np.sqrt(max(before - after, 0.0))), noise)


def _undetermined(lidar: Facts) -> tuple[int, int]:
    """How many scans planes leave open in some direction, and how many steps hang on the odometry."""
    dependence = np.asarray(renamed_facts.value(lidar, "odometry_dependence") or [], float)
    directions = renamed_facts.value(lidar, "degenerate_scans") or np.zeros(len(dependence) + 1)
    steps = odometry_dependent_steps(dependence, np.asarray(directions, int))
    return int(np.count_nonzero(directions)), len(steps)


def _cause(part: Facts, prefix: str = "") -> str:
    """Why a part is used or not; reports of versions before 0.3 have the decision in front of it."""
    known = (part.get(f"{prefix}{name}") for name in ("cause", "reason"))
    return str(next(filter(None, known), None) or part.get("problem") or "no reason is known")


def _uncertain(expected: Facts | None) -> int:
    """How many frames have expected errors that are unknown or more than verdict.UNCERTAIN times the median."""
    if not expected:
        return 0
    errors = np.array([np.nan if value is None else value for value in expected["per_frame_m"]], float)
    return int(np.sum(~(errors <= verdict.UNCERTAIN * np.nanmedian(errors))))


def _small_losses(facts: Facts, ssim_rose: bool) -> Iterator[str]:
    """What each used part lost in held-out scores, beyond chance and not only in the last digits.

    Scans are judged with the input's cameras. Where these are off, a sharper map looks worse: of 28 simulations that lost
    so, scans were nearer to the truth in all. So not where refined cameras predict images better in the end.
    """
    better = ssim_rose and (facts.get("visual") or {}).get("accepted") is True
    for name, section, prefix in _JUDGED:
        part = facts.get(section) or {}
        if part.get(f"{prefix}accepted") is not True or (section == "lidar" and better):
            continue
        lost = [
            words.format(-each["gain"], each["error"])
            for each in part.get(f"{prefix}judged") or []
            for words, least in [_HELD_OUT.get(each["name"], ("", 0.0))]
            if words
            and each["gain"] is not None
            and each["error"] is not None
            and -each["gain"] > max(least, CONTRADICTION * _by_images(each))
        ]
        if lost:
            yield f"{name} (loss of {' and '.join(lost)})"


def _by_images(figure: Facts) -> float:
    """The standard error of a figure's gain without that of the cameras' calibration, which is no chance."""
    return float(np.sqrt(max(figure["error"] ** 2 - (figure.get("calibration") or 0.0) ** 2, 0.0)))


def _changed_ssim(evaluation: Facts) -> tuple[float, float] | None:
    """SSIM before and after, where it fell or rose beyond chance over the pixels that both maps cover."""
    rough, refined = (
        ((evaluation.get(name) or {}).get("per_image") or {}).get("ssim_common")
        for name in ("rough", "refined")
    )
    if not rough or not refined or len(rough) != len(refined):
        return None
    both = np.array([[np.nan if value is None else value for value in row] for row in (rough, refined)])
    both = both[:, np.isfinite(both).all(0)]
    change = both[1] - both[0]
    if len(change) < 3:
        return None
    if abs(change.mean()) <= max(_SSIM_LEAST, _SSIM_SURE * standard_error(change)):
        return None
    return float(both[0].mean()), float(both[1].mean())


def _truth(reference: Facts) -> list[Truth]:
    before = reference.get("rough") or {}
    truths = []
    for key, what in (("lidar", "scans"), ("camera", "cameras")):
        error, rough = reference.get(key) or {}, before.get(key) or {}
        if error.get("ate_m") is None:
            continue
        truths += [
            Truth(
                what=what,
                unit="m",
                error=error["ate_m"],
                rough=rough.get("ate_m"),
                predicted=error.get("predicted_ate_m"),
                scaled=error.get("scaled_ate_m"),
            ),
            Truth(
                what=what,
                unit="degrees",
                error=error["rotation_alone_deg"],
                rough=rough.get("rotation_alone_deg"),
                predicted=error.get("predicted_rotation_deg"),
            ),
        ]
    return truths


_SURELY_THICKER, _THICKER = 2.0, 1.01
"""Standard errors, and part of the thickness, by which planes must have become thicker: poses that are as good as before
make them so by chance, up to .3 % in simulations."""


def _thicker(planes: Facts) -> tuple[float, float] | None:
    """Thickness before and after, m, where planes have become thicker beyond chance."""
    if not planes:
        return None
    before, after = planes["thickness_before_m"], planes["thickness_after_m"]
    least = _SURELY_THICKER * (planes.get("thickness_change_error_m") or 0.0)  # before 0.3, not known
    return (before, after) if after > max(_THICKER * before, before + least) else None


_WORTH_A_CAUSE_M = 0.02
"""Expected errors that are less need no cause."""
_FRAME = (
    "relative to the trajectory's own frame (after one rigid alignment) and in the scale of the LiDAR's ranges, "
    "which nothing in a recording tells"
)


def summary(judged: Verdict, expected: Facts, truth: Sequence[Truth] = ()) -> str:
    """A sentence with the errors to expect, in mm, and one that says what most of them is, where that is one thing."""
    amounts = [
        f"{lengths.text(part['position_m'])} in the {name}"
        for key, name in (("map", "map"), ("scans", "scan poses"), ("cameras", "camera poses"))
        if (part := expected.get(key))
    ]
    if judged.unknown:
        sentence = "How large the errors are is not known"
    elif amounts:
        more = ", perhaps more" if judged.at_least else ""
        sentence = f"Expect errors of about {joined(amounts)}{more}, {_FRAME}"
    else:
        sentence = "How large the errors are is not known, for the scan poses are the input's"
    measured = [f"{each.what} are off by {lengths.text(each.error)}" for each in truth if each.unit == "m"]
    if measured:
        own = f"{sentence[0].lower()}{sentence[1:]}"
        sentence = f"Against the reference, {joined(measured)}; without it: {own}"
    if amounts and not judged.unknown:
        sentence += _along_open(expected) or _of_ranges(expected)
    return f"Do not rely on this result. {sentence}." if judged.level == "bad" else f"{sentence}."


def _along_open(expected: Facts) -> str:
    """That most of what is expected is along motions that surfaces leave open, if it is."""
    rest = _rest(expected, "along_open_m")
    if rest is None:
        return ""
    most = ". Most of it lies along directions that no surface determines (as in a corridor); there "
    others = f". In all other directions scan poses are off by about {lengths.text(rest)}"
    if expected.get("open_by") == "images":
        return f"{most}the scans follow the images{others}"
    by_images = expected.get("open_by_images_m")
    if by_images is None:
        return f"{most}the scans follow the odometry{others}"
    return (
        f"{most}the expected error is that of the odometry{others}. If the images are right, the error along the open "
        f"directions is about {lengths.text(by_images)}"
    )


def _of_ranges(expected: Facts) -> str:
    """That errors of ranges are most of what is expected, if they are."""
    rest = _rest(expected, "of_ranges_m")
    if rest is None:
        return ""
    return (
        ". Most of it is a possible bend of the map by beam errors too small for the planes to show; without such "
        f"errors, scan poses are off by about {lengths.text(rest)}"
    )


def _rest(expected: Facts, key: str) -> float | None:
    """What is expected of scans beside one of its parts, m; None: that is not most of it."""
    whole, part = (expected.get("scans") or {}).get("position_m") or 0.0, expected.get(key) or 0.0
    rest = math.sqrt(max(whole**2 - part**2, 0.0))
    return None if whole < _WORTH_A_CAUSE_M or rest > 0.5 * whole else rest
