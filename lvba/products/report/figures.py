"""Charts and rows of numbers, from the facts."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from lvba.products.report import charts, words
from lvba.products.report.charts import Line
from lvba.products.report.html import text

Facts = Mapping[str, Any]
_COLORS = ("--after", "--before", "--s3", "--s4", "--s5")


def paths(facts: Facts) -> str:
    """Paths from above, how far poses moved, exposures."""
    trajectory = facts.get("trajectory") or {}
    cards = [_track(trajectory), _moved(trajectory), _exposure(facts.get("exposure") or {})]
    inner = "".join(cards)
    return f'<div class="grid">{inner}</div>' if inner else ""


def _track(trajectory: Facts) -> str:
    scans = trajectory.get("scans") or trajectory.get("images") or {}
    both = {name: np.asarray(scans[name], float) for name in ("rough", "refined") if scans.get(name)}
    if len(both) < 2 or len(both["refined"]) < 2:
        return ""
    axes = _flattest(both["refined"])
    lines = [
        Line(name, both[key] @ axes[0], both[key] @ axes[1], color, dash)
        for name, key, color, dash in (
            ("before", "rough", "--before", True),
            ("after", "refined", "--after", False),
        )
    ]
    return charts.track("Path", "", lines)


def _flattest(positions: np.ndarray) -> np.ndarray:
    """Two unit rows to draw on: x and y seen from above; where the path is mostly vertical, its own plane."""
    extent = positions.max(0) - positions.min(0)
    if max(extent[0], extent[1]) >= 0.5 * extent[2]:
        return np.eye(3)[:2]
    first = int(extent[1] > extent[0])
    return np.eye(3)[[first, 2]]


def _moved(trajectory: Facts) -> str:
    lines = []
    for key, name, color in (("scans", "scans", "--after"), ("images", "cameras", "--s3")):
        part = trajectory.get(key) or {}
        if part.get("rough") and part.get("refined"):
            times = np.asarray(part["times"], float)
            change = np.linalg.norm(
                np.asarray(part["refined"], float) - np.asarray(part["rough"], float), axis=1
            )
            lines.append(Line(name, times - _start(trajectory), 100 * change, color))
    return charts.chart("How far poses moved", lines, "time, s", "Change of position, cm", zero=True)


def _start(trajectory: Facts) -> float:
    starts = [
        part["times"][0] for part in trajectory.values() if isinstance(part, Mapping) and part.get("times")
    ]
    return min(starts, default=0.0)


def _exposure(exposure: Facts) -> str:
    if not exposure.get("times"):
        return ""
    times = np.asarray(exposure["times"], float)
    relative = np.asarray(exposure["relative"], float)
    lines = [Line("found", times - times[0], relative, "--after")]
    if exposure.get("reference"):
        truth = np.array([np.nan if value is None else value for value in exposure["reference"]], float)
        known = np.isfinite(truth)
        scale = np.exp(np.mean(np.log(relative[known] / truth[known]))) if known.any() else 1.0
        lines.append(Line("reference, scaled", times - times[0], truth * scale, "--s3", dash=True))
    return charts.chart("Relative exposure", lines, "time, s", "Exposure time, first image = 1")


def per_image(facts: Facts) -> str:
    """Leave-one-out PSNR and SSIM by image, before and after."""
    evaluation = facts.get("evaluation") or {}
    cards = []
    for key, name, unit in (
        ("psnr_leave_one_out", "PSNR by image", "dB"),
        ("ssim_leave_one_out", "SSIM by image", "1"),
    ):
        lines = []
        for state, label, color in (("rough", "before", "--before"), ("refined", "after", "--after")):
            scores = evaluation.get(state) or {}
            values = (scores.get("per_image") or {}).get(key)
            if values:
                y = np.array([np.nan if value is None else value for value in values], float)
                lines.append(Line(label, np.asarray(scores.get("images", range(len(y))), float), y, color))
        cards.append(
            charts.chart(name, lines, "image", f"Leave-one-out, {unit}" if unit != "1" else "Leave-one-out")
        )
    inner = "".join(cards)
    return f'<div class="grid">{inner}</div>' if inner else ""


def costs(facts: Facts) -> str:
    """Cost by iteration, one curve per stage or pyramid level, for both adjustments."""
    cards = [
        _cost("LiDAR cost", (facts.get("lidar") or {}).get("history") or []),
        _cost("Photometric cost", (facts.get("visual") or {}).get("history") or []),
    ]
    inner = "".join(cards)
    return f'<div class="grid">{inner}</div>' if inner else ""


def _cost(name: str, history: list[Any]) -> str:
    """Rows with `cost` per iteration, by level or stage; or with `cost_before`, `cost_after` per round of association."""
    rows = [row for row in history if isinstance(row, Mapping)]
    rounds = [row for row in rows if _is_number(row.get("cost_before")) and _is_number(row.get("cost_after"))]
    if rounds:
        x = np.array([value for k in range(len(rounds)) for value in (k, k + 0.8, np.nan)])
        y = np.array([value for row in rounds for value in (row["cost_before"], row["cost_after"], np.nan)])
        note = "Each round finds planes anew, so that only the change within a round counts."
        return charts.chart(
            name, [Line("cost", x, y, "--after", dots=True)], "round", "Cost", log=True, note=note
        )
    groups: dict[str, list[tuple[float, float]]] = {}
    for k, row in enumerate(row for row in rows if _is_number(row.get("cost"))):
        group = next(
            (f"{word} {row[word]}" for word in ("level", "stage", "round") if row.get(word) is not None), ""
        )
        groups.setdefault(group, []).append((float(k), float(row["cost"])))
    lines = [
        Line(group, np.array([x for x, _ in points]), np.array([y for _, y in points]), color, dots=True)
        for (group, points), color in zip(groups.items(), itertools.cycle(_COLORS), strict=False)
    ]
    return charts.chart(name, lines, "iteration", "Cost", log=True)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def lidar_rows(facts: Facts) -> list[tuple[str, str]]:
    """What the LiDAR bundle adjustment found."""
    stage = facts.get("lidar") or {}
    rows = _known(
        stage,
        (("planes", "Planes", words.count), ("iterations", "Iterations", words.count),
         ("cost_initial", "Cost before", _cost_words), ("cost_final", "Cost after", _cost_words)),
    )  # fmt: skip
    noise = [
        row["sigma"]
        for row in stage.get("history") or []
        if isinstance(row, Mapping) and _is_number(row.get("sigma"))
    ]
    if noise:
        # costs of rounds with other planes cannot be compared, their noise can
        rows = [row for row in rows if not row[0].startswith("Cost")]
        rows.append(
            ("Noise of a point, first and last round", f"{words.length(noise[0])}, {words.length(noise[-1])}")
        )
    return rows + _weak(stage)


def fusion_rows(facts: Facts) -> list[tuple[str, str]]:
    """What the cameras changed about the scans."""
    stage = facts.get("fusion") or {}
    moved = [value for value in stage.get("moved_m") or [] if _is_number(value)]
    if not moved:
        return []
    return [
        ("Scans moved by, half of them less than", words.length(float(np.median(moved)))),
        ("Scans moved by at most", words.length(max(moved))),
        ("Scans that contradict the cameras, and stay", words.count(stage.get("contradicted"))),
    ]


def visual_rows(facts: Facts) -> list[tuple[str, str]]:
    """What the visual bundle adjustment found."""
    stage = facts.get("visual") or {}
    rows = _known(
        stage,
        (("keyframes", "Keyframes", words.count), ("scene_points", "Scene points", words.count),
         ("global_points", "of them found across the map", words.count), ("observations", "Pairs of views", words.count),
         ("local_pairs", "of them near in time", words.count), ("global_pairs", "of them across the map", words.count),
         ("iterations", "Iterations", words.count), ("cost_initial", "Cost before", _cost_words),
         ("cost_final", "Cost after", _cost_words)),
    )  # fmt: skip
    return rows + _extrinsic(stage.get("extrinsic")) + _offset(stage.get("time_offset")) + _weak(stage)


def _known(stage: Facts, names: tuple[tuple[str, str, Any], ...]) -> list[tuple[str, str]]:
    return [
        (name, write(stage[key])) for key, name, write in names if isinstance(stage.get(key), int | float)
    ]


def _cost_words(value: float) -> str:
    return words.number(value, 1 if abs(value) >= 100 else 4)


def _extrinsic(extrinsic: Any) -> list[tuple[str, str]]:
    """How the LiDAR-camera extrinsic changed; given as change_m and change_deg (numbers or lists of three)."""
    if not isinstance(extrinsic, Mapping):
        return []
    rows = []
    for key, name, write in (
        ("change_m", "Extrinsic moved by", words.length),
        ("change_deg", "Extrinsic turned by", words.angle),
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
    spread = f" ± {words.number(1000 * sigma, 2)}" if isinstance(sigma, int | float) else ""
    return [("Time offset of the camera", words.number(1000 * seconds, 2) + spread + "\N{NO-BREAK SPACE}ms")]


def _weak(stage: Facts) -> list[tuple[str, str]]:
    """Weakly determined directions: a number, or a list of descriptions."""
    weak = stage.get("weak_directions")
    if weak is None:
        return []
    if isinstance(weak, int | float):
        return [("Weak directions", words.count(weak))]
    if isinstance(weak, list):
        shown = [text(item) for item in weak[:3] if isinstance(item, str)]
        return [("Weak directions", "<br>".join([words.count(len(weak)), *shown]))]
    return [("Weak directions", words.count(weak.get("count")))] if isinstance(weak, Mapping) else []
