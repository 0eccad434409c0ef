"""Progress of the two adjustments: planes by round, images by pyramid level, and the counts of each."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lvba.products import renamed_facts
from lvba.products.report import charts, formats
from lvba.products.report.charts import Line
from lvba.products.report.html import table, text

Facts = Mapping[str, Any]


def progress(facts: Facts) -> str:
    """How far points are off their planes by round, and how well images fit by pyramid level.

    No costs: those of rounds and levels with other planes, pixels and weights cannot be compared.
    """
    inner = _planes(facts.get("lidar") or {}) + _levels(facts.get("visual") or {})
    return f'<div class="grid">{inner}</div>' if inner else ""


def _planes(lidar: Facts) -> str:
    noise = _of_rounds(lidar, "sigma")
    line = Line(name="points", x=np.arange(1.0, len(noise) + 1), y=1000 * noise, color="--after", dots=True)
    note = "Each round fits planes again, in finer cells from round to round."
    return charts.chart(
        "Distance of points from their plane", [line], "round", "Typical, mm", log=True, note=note
    )


def _of_rounds(lidar: Facts, name: str) -> np.ndarray:
    rows = [row for row in lidar.get("history") or [] if isinstance(row, Mapping)]
    return np.array([row[name] for row in rows if _is_number(row.get(name))], float)


def _levels(visual: Facts) -> str:
    rows = [
        (
            f"1/{1 << level['level']} size" if level["level"] else "full size",
            formats.count(level["local_pairs"] + level["global_pairs"]),
            formats.number(level["rms"], 1),
            f"{len(level.get('iterations') or [])}{'' if level.get('converged') else ', not converged'}",
        )
        for level in visual.get("levels") or []
    ]
    if not rows:
        return ""
    note = (
        "Residual: by how much two views of a patch differ, root mean square, in gray values of 255. Finer images "
        "show more detail and noise, so it may grow from level to level."
    )
    inner = table(("", "Pairs", "Residual", "Steps"), rows)
    return charts.card("Images, coarse to fine", note, inner)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _imu_rows(imu: Facts) -> list[tuple[str, str]]:
    if not imu:
        return []
    if not imu.get("used"):
        return [("IMU", f"not used: {imu.get('problem')}")]
    tilt = f"{imu['tilt_deg']:.2f} ± {imu['tilt_sigma_deg']:.2f}°"
    return [
        ("Motions between scans that the IMU felt", formats.count(imu["motions"])),
        ("Tilt of the world's z axis", tilt),
    ]


def lidar_rows(facts: Facts) -> list[tuple[str, str]]:
    """Figures of the LiDAR bundle adjustment."""
    stage = facts.get("lidar") or {}
    rows = _known(stage, (("planes", "Planes", formats.count), ("iterations", "Iterations", formats.count)))
    noise = _of_rounds(stage, "sigma")
    if len(noise):
        span = f"{formats.length(noise[0])}, {formats.length(noise[-1])}"
        rows.append(("Distance of points from their plane, first and last round", span))
    left = stage.get("motion_left") or {}
    if renamed_facts.value(left, "fraction") is not None:
        rows.append(_motion_row(left))
    rows += _range_error_rows(stage.get("range_errors") or {})
    moving = stage.get("moving_points") or {}
    moves = renamed_facts.value(moving, "fraction") or 0.0
    if moves > _SAID_MOVING:
        rows.append(("Points that move, not in the map", f"{formats.number(100.0 * moves, 1)} %"))
    rows += _imu_rows(stage.get("imu") or {})
    scans = renamed_facts.value(stage, "degenerate_scans") or []
    if scans:
        held = sum(not count for count in scans)
        rows.append(("Scans that planes determine in every direction", f"{held} of {len(scans)}"))
    common = renamed_facts.value(stage, "degenerate_directions")
    if common is not None:
        rows.append((f"Motions of the whole map that planes do not determine{_HELD}", _number_of(common)))
    return rows


_RANGE_ERRORS = (
    ("elevation", "Beams higher than the sensor says", 180.0 / np.pi, 3, "\N{DEGREE SIGN}"),
    ("distortion", "Ranges too long 45\N{DEGREE SIGN} off the sensor's axis", 100.0, 2, " %"),
    ("incidence", "Surfaces measured too far at grazing incidence", 1000.0, 1, " mm"),
    ("offset", "All surfaces measured too far", 1000.0, 1, " mm"),
    ("brightness", "Surfaces twice as bright as usual measured too far", 1000.0, 1, " mm"),
)
"""Key, what it says, factor, digits, unit."""


def _range_error_rows(errors: Facts) -> list[tuple[str, str]]:
    """Errors of the range sensor that were corrected."""
    corrected, values, sigma = (errors.get(name) or {} for name in ("corrected", "values", "sigma"))
    return [
        (
            f"{text}, corrected",
            f"{formats.number(factor * values[name], digits)} \N{PLUS-MINUS SIGN} "
            f"{formats.number(factor * sigma[name], digits)}{unit}",
        )
        for name, text, factor, digits, unit in _RANGE_ERRORS
        if name in corrected
    ]


def _motion_row(left: Facts) -> tuple[str, str]:
    """How much of the motion was left, or how long a depth camera reads its rows, with its standard deviation."""
    clock, sigma = left.get("clock") or {}, left.get("sigma")
    text, factor, unit = "Motion left in scans", 100.0, "%"
    if "down" in clock:
        text, factor, unit = "Readout of the rows of a depth image", 1000.0 * clock["sweep"], "ms"
    error = "" if sigma is None else f" \N{PLUS-MINUS SIGN} {formats.number(factor * sigma, 2)}"
    taken = ", taken out" if left.get("motion") else ""
    if by_rough := left.get("by_rough"):
        return "Deskewed again, by the refined poses" if taken else text, " and ".join(by_rough)
    return text + taken, f"{formats.number(factor * renamed_facts.value(left, 'fraction'), 2)}{error} {unit}"


_SAID_MOVING = 5e-4
"""Part of the points from which it is said that some move: fewer are noise at edges."""
_HELD = " (kept near the odometry)"


def fusion_rows(facts: Facts) -> list[tuple[str, str]]:
    """How far scans moved when they were refined with the cameras."""
    stage = facts.get("fusion") or {}
    moved = [value for value in stage.get("moved_m") or [] if _is_number(value)]
    if not moved:
        return []
    return [
        ("Scans moved by, median", formats.length(float(np.median(moved)))),
        ("Scans moved by, maximum", formats.length(max(moved))),
        ("Scans that contradict the cameras (not moved)", formats.count(stage.get("contradicted"))),
    ]


def visual_rows(facts: Facts) -> list[tuple[str, str]]:
    """Figures of the visual bundle adjustment."""
    stage = facts.get("visual") or {}
    rows = _known(
        stage,
        (("keyframes", "Keyframes", formats.count), ("scene_points", "Scene points", formats.count),
         ("global_points", "of these, across the map", formats.count),
         ("observations", "Pairs of views", formats.count),
         ("local_pairs", "of these, near in time", formats.count),
         ("global_pairs", "of these, across the map", formats.count),
         ("iterations", "Iterations", formats.count)),
    )  # fmt: skip
    rows += _cost(stage) + _extrinsic(stage.get("extrinsic")) + _offset(stage.get("time_offset"))
    rows += _calibration(stage.get("calibration"))
    return rows + _undetermined_images(renamed_facts.value(stage, "degenerate_directions"))


def _cost(stage: Facts) -> list[tuple[str, str]]:
    """How much lower the cost became, at the weights of the finest level, so that both can be compared."""
    before, after = stage.get("cost_initial"), stage.get("cost_final")
    if not (_is_number(before) and _is_number(after)) or not before:
        return []
    return [("Photometric cost at full resolution", f"{formats.number(100 * (after / before - 1), 0)} %")]


def _known(stage: Facts, names: tuple[tuple[str, str, Any], ...]) -> list[tuple[str, str]]:
    return [
        (name, write(stage[key])) for key, name, write in names if isinstance(stage.get(key), int | float)
    ]


def _extrinsic(extrinsic: Any) -> list[tuple[str, str]]:
    """How the LiDAR-camera extrinsic changed; given as change_m and change_deg (numbers or lists of three)."""
    if not isinstance(extrinsic, Mapping):
        return []
    rows = []
    for key, name, write in (
        ("change_m", "Extrinsic moved by", formats.length),
        ("change_deg", "Extrinsic turned by", formats.angle),
    ):
        value = extrinsic.get(key)
        if value is not None:
            rows.append((name, write(float(np.linalg.norm(value)))))
    return rows


def _offset(offset: Any) -> list[tuple[str, str]]:
    """The time offset, a number in seconds or a mapping with `seconds` and `sigma`."""
    if isinstance(offset, Mapping):
        seconds, sigma = offset.get("seconds"), offset.get("sigma")
    else:
        seconds, sigma = offset, None
    if not isinstance(seconds, int | float):
        return []
    spread = f" ± {formats.number(1000 * sigma, 2)}" if isinstance(sigma, int | float) else ""
    return [
        ("Time offset of the camera", formats.number(1000 * seconds, 2) + spread + "\N{NO-BREAK SPACE}ms")
    ]


def _calibration(calibration: Any) -> list[tuple[str, str]]:
    """How intrinsics and readout time differ from the calibration, with standard deviations."""
    if not isinstance(calibration, Mapping) or not isinstance(calibration.get("sigma"), Mapping):
        return []
    rows = []
    for key, index, name, scale, digits, unit in _CALIBRATED:
        values, sigmas = (
            np.atleast_1d(calibration.get(key, [])),
            np.atleast_1d(calibration["sigma"].get(key, [])),
        )
        if len(values) > index and len(sigmas) > index and sigmas[index] > 0:
            value = formats.number(scale * float(values[index]), digits)
            sigma = formats.number(scale * float(sigmas[index]), digits)
            rows.append((name, f"{value} ± {sigma}\N{NO-BREAK SPACE}{unit}".rstrip()))
    return rows


_CALIBRATED = (
    ("focal", 0, "Focal lengths longer than calibrated by", 100.0, 3, "%"),
    ("principal_point", 0, "Principal point to the right by", 1.0, 2, "px"),
    ("principal_point", 1, "Principal point down by", 1.0, 2, "px"),
    ("distortion", 0, "k1 larger by", 1.0, 5, ""),
    ("readout", 0, "Readout time of the image rows", 1000.0, 2, "ms"),
    ("clock_rate", 0, "Clock of the camera slower by", 1000.0, 3, "ms a second"),
)
"""Key in the facts, index, name, scale, digits and unit."""


def _undetermined_images(directions: Any) -> list[tuple[str, str]]:
    """How many images their own scene points do not determine: given by image, or as one number or list."""
    if isinstance(directions, Mapping) and isinstance(directions.get("per_image"), list):
        images = directions["per_image"]
        value = f"{sum(bool(count) for count in images)} of {len(images)}"
    elif directions is not None:
        value = _number_of(directions)
    else:
        return []
    return [("Images that their scene points do not determine (kept near the scans)", value)]


def _number_of(directions: Any) -> str:
    """Degenerate directions, a number or a list with or without descriptions."""
    if isinstance(directions, list):
        named = [text(item) for item in directions[:3] if isinstance(item, str)]
        return "<br>".join([formats.count(len(directions)), *named])
    return formats.count(directions.get("count") if isinstance(directions, Mapping) else directions)
