"""What the two adjustments did: planes by round, images by pyramid level, and what was found."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lvba.products.report import charts, words
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
    line = Line("points", np.arange(1.0, len(noise) + 1), 1000 * noise, "--after", dots=True)
    note = "Each round finds planes anew, in finer cells as it goes on."
    return charts.chart(
        "How far points are off their plane", [line], "round", "Typical, mm", log=True, note=note
    )


def _of_rounds(lidar: Facts, name: str) -> np.ndarray:
    rows = [row for row in lidar.get("history") or [] if isinstance(row, Mapping)]
    return np.array([row[name] for row in rows if _is_number(row.get(name))], float)


def _levels(visual: Facts) -> str:
    rows = [
        (
            f"1/{1 << level['level']} size" if level["level"] else "full size",
            words.count(level["local_pairs"] + level["global_pairs"]),
            words.number(level["rms"], 1),
            f"{len(level.get('iterations') or [])}{'' if level.get('converged') else ', not settled'}",
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


def lidar_rows(facts: Facts) -> list[tuple[str, str]]:
    """What the LiDAR bundle adjustment found."""
    stage = facts.get("lidar") or {}
    rows = _known(stage, (("planes", "Planes", words.count), ("iterations", "Iterations", words.count)))
    noise = _of_rounds(stage, "sigma")
    if len(noise):
        span = f"{words.length(noise[0])}, {words.length(noise[-1])}"
        rows.append(("Points off their plane, first and last round", span))
    scans = stage.get("weak_scans") or []
    if scans:
        held = sum(not count for count in scans)
        rows.append(("Scans that planes hold in every direction", f"{held} of {len(scans)}"))
    if stage.get("weak_directions") is not None:
        rows.append(
            (f"Motions of the whole map that planes leave open{_HELD}", _number_of(stage["weak_directions"]))
        )
    return rows


_HELD = ", where it stays near the odometry"


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
         ("iterations", "Iterations", words.count)),
    )  # fmt: skip
    rows += _cost(stage) + _extrinsic(stage.get("extrinsic")) + _offset(stage.get("time_offset"))
    return rows + _open_to_images(stage.get("weak_directions"))


def _cost(stage: Facts) -> list[tuple[str, str]]:
    """How much lower the cost became, at the weights of the finest level, so that both can be compared."""
    before, after = stage.get("cost_initial"), stage.get("cost_final")
    if not (_is_number(before) and _is_number(after)) or not before:
        return []
    return [("Photometric cost at full resolution", f"{words.number(100 * (after / before - 1), 0)} %")]


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


def _open_to_images(weak: Any) -> list[tuple[str, str]]:
    """How many images see too few surfaces to be held by themselves: given by image, or as one number or list."""
    if isinstance(weak, Mapping) and isinstance(weak.get("per_image"), list):
        images = weak["per_image"]
        value = f"{sum(bool(count) for count in images)} of {len(images)}"
    elif weak is not None:
        value = _number_of(weak)
    else:
        return []
    return [("Images that see too few surfaces to hold them, where the scans do", value)]


def _number_of(weak: Any) -> str:
    """Weak directions, a number or a list with or without descriptions."""
    if isinstance(weak, list):
        shown = [text(item) for item in weak[:3] if isinstance(item, str)]
        return "<br>".join([words.count(len(weak)), *shown])
    return words.count(weak.get("count") if isinstance(weak, Mapping) else weak)
