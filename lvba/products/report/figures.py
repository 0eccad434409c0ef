"""Charts of poses, exposures and scores, from the facts."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lvba.products.report import charts
from lvba.products.report.charts import Line

Facts = Mapping[str, Any]


def paths(facts: Facts) -> str:
    """Paths from above, expected errors, how far poses moved, exposures."""
    trajectory = facts.get("trajectory") or {}
    cards = [
        _track(trajectory),
        _errors(facts),
        _moved(trajectory),
        _exposure(facts.get("exposure") or {}),
    ]
    inner = "".join(cards)
    return f'<div class="grid">{inner}</div>' if inner else ""


def _track(trajectory: Facts) -> str:
    scans = trajectory.get("scans") or trajectory.get("images") or {}
    both = {name: np.asarray(scans[name], float) for name in ("rough", "refined") if scans.get(name)}
    if len(both) < 2 or len(both["refined"]) < 2:
        return ""
    axes = _flattest(both["refined"])
    lines = [
        Line(name=name, x=both[key] @ axes[0], y=both[key] @ axes[1], color=color, dash=dash)
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


def _errors(facts: Facts) -> str:
    """Expected error by frame."""
    expected, trajectory = facts.get("expected_error") or {}, facts.get("trajectory") or {}
    lines = []
    for key, of, name, color in (
        ("scans", "scans", "scans", "--after"),
        ("cameras", "images", "cameras", "--s3"),
    ):
        errors = (expected.get(key) or {}).get("per_frame_m") or []
        times = (trajectory.get(of) or {}).get("times") or []
        if errors and len(errors) == len(times):
            y = np.array([np.nan if value is None else 1000 * value for value in errors], float)
            lines.append(Line(name=name, x=np.asarray(times, float) - _start(trajectory), y=y, color=color))
    more = "Perhaps more: see the reasons above" if expected.get("at_least") else ""
    return charts.chart("Expected error by frame", lines, "time, s", "Position, mm", zero=True, note=more)


def _moved(trajectory: Facts) -> str:
    lines = []
    for key, name, color in (("scans", "scans", "--after"), ("images", "cameras", "--s3")):
        part = trajectory.get(key) or {}
        if part.get("rough") and part.get("refined"):
            times = np.asarray(part["times"], float)
            change = np.linalg.norm(
                np.asarray(part["refined"], float) - np.asarray(part["rough"], float), axis=1
            )
            lines.append(Line(name=name, x=times - _start(trajectory), y=100 * change, color=color))
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
    lines = [Line(name="solved", x=times - times[0], y=relative, color="--after")]
    if exposure.get("reference"):
        truth = np.array([np.nan if value is None else value for value in exposure["reference"]], float)
        known = np.isfinite(truth)
        scale = np.exp(np.mean(np.log(relative[known] / truth[known]))) if known.any() else 1.0
        lines.append(
            Line(name="reference, scaled", x=times - times[0], y=truth * scale, color="--s3", dash=True)
        )
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
                lines.append(
                    Line(
                        name=label, x=np.asarray(scores.get("images", range(len(y))), float), y=y, color=color
                    )
                )
        cards.append(
            charts.chart(name, lines, "image", f"Leave-one-out, {unit}" if unit != "1" else "Leave-one-out")
        )
    inner = "".join(cards)
    return f'<div class="grid">{inner}</div>' if inner else ""
