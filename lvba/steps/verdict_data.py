"""The verdict on a run from the facts of its report, and the `verdict` and `alarms` parts of the report."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from lvba.lidar.bundle_adjustment import loose_steps
from lvba.steps import verdict
from lvba.steps.verdict import Figures, Judged, Truth, Verdict

Facts = Mapping[str, Any]

_SSIM_SURE, _SSIM_LOSS = 2.0, 0.005
"""Standard errors, over images, by which SSIM must fall, and the least loss that means something."""


def add(facts: Facts) -> dict[str, Any]:
    """The facts with `verdict` and `alarms`, and `at_least` among the expected errors: whether these are lower bounds.

    facts: plain data, the contents of report.json
    """
    found = figures(facts)
    judged = verdict.judge(found)
    expected = {**(facts.get("expected_error") or {}), "at_least": judged.at_least}
    return {
        **facts,
        "expected_error": expected,
        "alarms": _alarms(found),
        "verdict": {
            "level": judged.level,
            "summary": summary(judged, expected, found.truth),
            "reasons": [{"text": each.text, "mend": each.mend} for each in judged.reasons],
        },
    }


def _alarms(found: Figures) -> dict[str, dict[str, float | None]]:
    """What tells that covariances promise too much, each with the limit above which it does."""
    return {
        "variance_inflation": {"value": found.inflation, "limit": verdict.MOST_INFLATION},
        "spline_error": {"value": found.spline_error, "limit": verdict.MOST_SPLINE_ERROR},
        "disagreement": {"value": found.disagreement, "limit": verdict.MOST_DISAGREEMENT},
    }


def figures(facts: Facts) -> Figures:
    """What the verdict is made from; parts that the facts lack count as nothing to complain of."""
    dataset, lidar, visual = (facts.get(name) or {} for name in ("dataset", "lidar", "visual"))
    fusion, odometry = facts.get("fusion") or {}, facts.get("odometry") or {}
    expected, planes = facts.get("expected_error") or {}, facts.get("planes") or {}
    last = (visual.get("levels") or [{}])[-1]
    history = lidar.get("history") or [{}]
    used = lidar.get("accepted") is not False
    loose = np.asarray(lidar.get("loose") or [], float)
    weak_scans = np.asarray(lidar.get("weak_scans") or np.zeros(len(loose) + 1), int)
    mount = visual.get("extrinsic") or {}
    fused = "moved_m" in fusion and visual.get("accepted") is not False and used
    return Figures(
        scans=dataset.get("scans") or 0,
        images=dataset.get("images") or 0,
        scan_poses=Judged(lidar.get("accepted"), _why(lidar)),
        camera_poses=Judged(visual.get("accepted"), _why(visual)),
        exposures=Judged(visual.get("exposures_accepted"), _because(visual.get("exposures_reason"))),
        scans_with_cameras=Judged(fusion.get("accepted") if fused else None, _why(fusion)),
        inflation=last.get("inflation"),
        spline_error=fusion.get("between"),
        disagreement=fusion.get("disagreement"),
        common_weak=len(lidar.get("weak_directions") or []) if used else 0,
        weak_scans=int(np.count_nonzero(weak_scans)) if used else 0,
        loose_steps=len(loose_steps(loose, weak_scans)) if used else 0,
        vague_scans=_vague(expected.get("scans")),
        vague_cameras=_vague(expected.get("cameras")),
        moved_m=history[-1].get("moved") if used and lidar.get("converged") is False else None,
        scan_p95_m=(expected.get("scans") or {}).get("position_p95_m"),
        cameras_settled=last.get("converged") is not False,
        jumps=len(odometry.get("jumps_after") or []),
        jump_m=max(odometry.get("jumps_m") or [0.0]),
        jump_deg=max(odometry.get("jumps_deg") or [0.0]),
        jump_left=bool(odometry.get("jump_left")),
        mount_sigmas=_mount_sigmas(mount, facts.get("config") or {}),
        mount_m=mount.get("change_m") or 0.0,
        mount_deg=mount.get("change_deg") or 0.0,
        ssim=_lost_ssim(facts.get("evaluation") or {}),
        thickness=(planes["thickness_before_m"], planes["thickness_after_m"]) if planes else None,
        truth=tuple(_truth(facts.get("reference") or {})),
    )


def _why(part: Facts) -> str:
    return _because(part.get("reason") or part.get("problem"))


def _because(reason: Any) -> str:
    """The reason without saying again that the input was kept."""
    words = str(reason or "no reason is known")
    head, colon, rest = words.partition(": ")
    return rest if colon and ("kept" in head or "stay" in head) else words


def _vague(expected: Facts | None) -> int:
    """Frames that are known verdict.VAGUE times less well than the others, or not at all."""
    if not expected:
        return 0
    errors = np.array([np.nan if value is None else value for value in expected["per_frame_m"]], float)
    return int(np.sum(~(errors <= verdict.VAGUE * np.nanmedian(errors))))


def _mount_sigmas(mount: Facts, config: Facts) -> float | None:
    prior = (config.get("visual") or {}).get("prior") or {}
    if not mount or not prior:
        return None
    # three axes each: as unlikely as so many standard deviations of one
    ratio = max(
        mount["change_m"] / prior["mount_position_m"], mount["change_deg"] / prior["mount_rotation_deg"]
    )
    return float(stats.norm.isf(stats.chi2.sf(ratio**2, 3) / 2))


def _lost_ssim(evaluation: Facts) -> tuple[float, float] | None:
    """SSIM before and after, where it fell beyond chance over the pixels that both maps cover."""
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
    if -change.mean() <= max(_SSIM_LOSS, _SSIM_SURE * change.std(ddof=1) / np.sqrt(len(change))):
        return None
    return float(both[0].mean()), float(both[1].mean())


def _truth(reference: Facts) -> list[Truth]:
    before = reference.get("rough") or {}
    found = []
    for key, what in (("lidar", "scans"), ("camera", "cameras")):
        error, rough = reference.get(key) or {}, before.get(key) or {}
        if error.get("ate_m") is None:
            continue
        found += [
            Truth(what, "m", error["ate_m"], rough.get("ate_m"), error.get("predicted_ate_m")),
            Truth(
                what,
                "degrees",
                error["rotation_deg"],
                rough.get("rotation_deg"),
                error.get("predicted_rotation_deg"),
            ),
        ]
    return found


_FRAME = "relative to the trajectory's own frame (after one rigid alignment)"


def summary(judged: Verdict, expected: Facts, truth: Sequence[Truth] = ()) -> str:
    """One sentence with the errors to expect, in mm."""
    amounts = [
        f"{millimeters(part['position_m'])} in the {name}"
        for key, name in (("map", "map"), ("scans", "scan poses"), ("cameras", "camera poses"))
        if (part := expected.get(key))
    ]
    if amounts:
        size = "at least" if judged.at_least else "about"
        sentence = f"Expect errors of {size} {_listed(amounts)}, {_FRAME}"
    else:
        sentence = "How large the errors are is not known, for the scan poses are the input's"
    measured = [f"{each.what} are off by {millimeters(each.error)}" for each in truth if each.unit == "m"]
    if measured:
        own = f"{sentence[0].lower()}{sentence[1:]}"
        sentence = f"Against the reference, {_listed(measured)}; without it: {own}"
    return f"Do not rely on this result. {sentence}." if judged.level == "bad" else f"{sentence}."


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def millimeters(meters: float) -> str:
    """A length in mm with two digits, or in m from one meter on."""
    value, unit = (meters, "m") if meters >= 1 else (1000 * meters, "mm")
    digits = 2 if value < 1 else 1 if value < 10 else 0
    return f"{value:.{digits}f} {unit}"
