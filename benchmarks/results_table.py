"""Tables of docs/results.md from the rows in docs/results.json."""

from collections.abc import Callable
from typing import Any

from results_texts import HEAD, NOTES

Row = dict[str, Any]


def number(row: Row | None, *path: str, scale: float = 1.0, digits: int = 2) -> str:
    """The value at a path of keys, or a dash where there is none."""
    value: Any = row
    for key in path:
        value = value.get(key) if isinstance(value, dict) else None
    return "-" if not isinstance(value, (int, float)) else f"{value * scale:.{digits}f}"


def change(row: Row, key: str, digits: int = 2) -> str:
    return f"{number(row, 'rough', key, digits=digits)} -> {number(row, 'refined', key, digits=digits)}"


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *rows]]
    return "\n".join(lines) + "\n"


def _recording(name: str, row: Row) -> list[str]:
    return [
        name,
        change(row, "psnr"),
        change(row, "ssim", 3),
        change(row, "coverage", 3),
        change(row, "psnr_leave_one_out"),
        change(row, "ssim_leave_one_out", 3),
        change(row, "map_entropy", 3),
        *(_pose_change(row, part) for part in ("lidar", "camera")),
        number(row, "seconds", digits=1),
        number(row, "peak_memory_mb", digits=0),
    ]


def _pose_change(row: Row, part: str) -> str:
    reference: Row = row.get("reference") or {}
    if part not in reference:
        return "-"
    return f"{_pose(reference.get('rough') or {}, part)} -> {_pose(reference, part)}"


def _pose(errors: Row, part: str) -> str:
    return number(errors, part, "ate_m", scale=1e3, digits=1) + " / " + number(errors, part, "rotation_deg")


def _foreign(name: str, row: Row) -> list[str]:
    refined: Row = row.get("refined") or {}
    reference: Row = row.get("reference") or {}
    return [
        name,
        number(refined, "psnr_leave_one_out"),
        number(refined, "ssim_leave_one_out", digits=3),
        number(refined, "coverage", digits=3),
        number(refined, "map_entropy", digits=3),
        *(_pose(reference, part) if part in reference else "-" for part in ("lidar", "camera")),
    ]


def _splats(name: str, row: Row) -> list[str]:
    """What splats predict of images that training never saw, by whose poses."""
    sets = ("input", "result", "reference")
    return [
        name,
        *(number(row, poses, "psnr") for poses in sets),
        *(number(row, poses, "ssim", digits=3) for poses in sets),
    ]


def _against_truth(name: str, row: Row) -> list[str]:
    reference: Row = row.get("reference") or {}
    rough: Row = reference.get("rough") or {}

    def pose(part: str) -> list[str]:
        before = (
            number(rough, part, "ate_m", scale=1e3, digits=1) + " / " + number(rough, part, "rotation_deg")
        )
        after = (
            number(reference, part, "ate_m", scale=1e3)
            + " / "
            + number(reference, part, "rotation_deg", digits=4)
        )
        expected = (
            number(reference, part, "predicted_ate_m", scale=1e3) + ", " + number(reference, part, "nees")
        )
        return [f"{before} -> {after}", _quantiles(reference, part), expected]

    return [
        name,
        *pose("lidar"),
        *pose("camera"),
        number(reference, "exposure", "rms_percent"),
        change(row, "psnr_leave_one_out"),
        number(row, "seconds", digits=1),
    ]


def _quantiles(reference: Row, part: str) -> str:
    """Median and 95th percentile of the position errors, mm; rows of older versions have none."""
    if "ate_median_m" not in (reference.get(part) or {}):
        return "-"
    return ", ".join(number(reference, part, f"ate_{of}_m", scale=1e3) for of in ("median", "p95"))


def _disturbed(name: str, row: Row) -> list[str]:
    reference: Row = row.get("reference") or {}
    cells = [name]
    for part in ("lidar", "camera"):
        cells.append(
            f"{number(reference, part, 'ate_m', scale=1e3)} / {number(reference, part, 'rotation_deg', digits=4)}"
        )
        cells.append(_quantiles(reference, part))
        cells.append(number(reference, part, "predicted_ate_m", scale=1e3))
        cells.append(number(reference, part, "nees"))
    said = str(row.get("verdict") or "-") + (", perhaps more" if row.get("at_least") else "")
    if confident(row):
        said = f"**{said}**"
    error, expected = _exposures(reference)
    cells += ["-" if value is None else f"{value:.2f}" for value in (error, expected)]
    return [*cells, number(reference, "exposure", "nees_after_power"), said, number(row, "seconds", digits=0)]


def _exposures(reference: Row) -> tuple[float | None, float | None]:
    """Error and expected one, percent, after the power that images leave open, where there is one."""
    exposure = reference.get("exposure") or {}
    expected, power = exposure.get("predicted_percent"), exposure.get("power") or 1.0
    return (
        exposure.get("rms_percent_after_power", exposure.get("rms_percent")),
        None if expected is None else expected / power,
    )


def confident(row: Row) -> bool:
    """Whether an error is far above the expected one, and no word of the report says so."""
    reference: Row = row.get("reference") or {}
    error, expected = _exposures(reference)
    exposures = error is not None and expected is not None and error > _KEPT * expected
    named = any("exposures" in reason for reason in row.get("reasons") or ())
    return (_broken(reference) and not row.get("at_least")) or (exposures and not named)


_KEPT = 3.0


def _broken(reference: Row) -> bool:
    """Whether scans or cameras are off by more than three times what was expected, in the scale of the LiDAR's ranges."""
    parts = [reference.get(part) or {} for part in ("lidar", "camera")]
    return any(
        part.get("predicted_ate_m")
        and part.get("scaled_ate_m", part["ate_m"]) > _KEPT * part["predicted_ate_m"]
        for part in parts
    )


def _degenerate(name: str, row: Row) -> list[str]:
    described = [_describe(row.get(f"{part}_degenerate_directions")) for part in ("lidar", "visual")]
    rough: Row = (row.get("reference") or {}).get("rough") or {}
    moved = [
        number(rough, part, "ate_m", scale=1e3, digits=1)
        + " -> "
        + number(row["reference"], part, "ate_m", scale=1e3, digits=1)
        for part in ("lidar", "camera")
    ]
    return [name, *described, *moved]


def _describe(directions: Any) -> str:
    if isinstance(directions, list):
        return f"{len(directions)} of all scans together"
    if isinstance(directions, dict) and directions.get("per_image"):
        return f"{min(directions['per_image'])} to {max(directions['per_image'])} per image"
    return "-"


def _in_parts(name: str, row: Row) -> list[str]:
    there: Row = row.get("undivided") or {}
    return [
        name,
        f"{number(there, 'scans_max_m', scale=1e3)} / {number(there, 'scans_max_deg', digits=4)}",
        f"{number(there, 'cameras_max_m', scale=1e3)} / {number(there, 'cameras_max_deg', digits=4)}",
        number(there, "exposure_max_percent"),
        *_found(row),
        number(row, "merge", "walls_over_one_side"),
        change(row, "psnr_leave_one_out"),
        number(row, "peak_memory_mb", digits=0),
    ]


def _found(row: Row) -> list[str]:
    """Errors of scans, cameras and exposures against the truth, after the run."""
    reference: Row = row.get("reference") or {}
    poses = [
        f"{number(reference, part, 'ate_m', scale=1e3)} / {number(reference, part, 'rotation_deg', digits=4)}"
        for part in ("lidar", "camera")
    ]
    return [*poses, number(reference, "exposure", "rms_percent")]


def _loops(name: str, row: Row) -> list[str]:
    rough: Row = (row.get("reference") or {}).get("rough") or {}
    return [
        name,
        f"{number(row, 'merge', 'loops_used', digits=0)} / {number(row, 'merge', 'loops_refused', digits=0)}",
        number(rough, "lidar", "ate_m", scale=1e3, digits=1),
        *_found(row),
        change(row, "map_entropy", 3),
        number(row, "merge", "walls_over_one_side"),
    ]


def _gate(name: str, row: Row) -> list[str]:
    figures: Row = row.get("figures") or {}
    return [
        *name.rsplit(": ", 1),
        *(
            _gain(figures.get(figure), digits)
            for figure, digits in (("map_entropy", 4), ("psnr_leave_one_out", 3), ("ssim_leave_one_out", 4))
        ),
        "used" if row.get("accepted") else "refused",
        " -> ".join(_error(row, side) for side in ("before", "after")) if row.get("truth") else "-",
        str(row.get("truth_says") or "-"),
        str(row.get("verdict")),
    ]


def _gain(figure: Row | None, digits: int) -> str:
    if figure is None or figure.get("gain") is None:
        return "-"
    return f"{figure['gain']:+.{digits}f} ± {number(figure, 'error', digits=digits)}"


def _error(row: Row, side: str) -> str:
    if "rms_percent" in row["truth"][side]:
        return number(row, "truth", side, "rms_percent")
    position = number(row, "truth", side, "ate_m", scale=1e3)
    return f"{position} / {number(row, 'truth', side, 'rotation_deg', digits=4)}"


def _imu(name: str, row: Row) -> list[str]:
    def both(*path: str, scale: float = 1e3) -> str:
        return f"{number(row['without'], *path, scale=scale)} -> {number(row['with'], *path, scale=scale)}"

    tilt = [number(row["with"], key, digits=3) for key in ("tilt_deg", "tilt_sigma_deg")]
    return [
        name,
        *(both("lidar", key) for key in ("ate_m", "ate_median_m", "ate_max_m")),
        both("lidar", "nees", scale=1.0),
        f"{row['open']}: {both('open_m')}" if row["open"] else "0",
        both("camera", "ate_m"),
        both("camera", "nees", scale=1.0),
        " ± ".join(tilt),
    ]


def _models(name: str, row: Row) -> list[str]:
    sides = [row["without"], row["with"]]
    poses = [
        " -> ".join(
            f"{number(side, 'reference', part, 'ate_m', scale=1e3)} / "
            f"{number(side, 'reference', part, 'rotation_deg', digits=4)}"
            for side in sides
        )
        for part in ("lidar", "camera")
    ]
    exposures = [_exposures(side.get("reference") or {})[0] for side in sides]
    verdicts = [
        str(side.get("verdict")) + (", perhaps more" if side.get("at_least") else "") for side in sides
    ]
    return [
        name,
        ", ".join(row["disturbances"]) or "-",
        *poses,
        " -> ".join("-" if each is None else f"{each:.2f}" for each in exposures),
        " -> ".join(verdicts),
        " -> ".join(number(side, "processor_seconds", digits=1) for side in sides),
    ]


def _colors(name: str, row: Row) -> list[str]:
    def both(key: str, scale: float = 1.0, digits: int = 2) -> str:
        old, new = (number(row, state, key, scale=scale, digits=digits) for state in ("before", "after"))
        return new if old == "-" else f"{old} -> {new}"

    wrong = [both(f"{part}_wrong", 100) for part in ("sides", "strip", "edges", "floor")]
    return [
        name,
        *wrong,
        both("sides_error"),
        both("error"),
        both("error_p95", 1, 1),
        both("uncolored", 100, 1),
    ]


_TRUTH = [
    "scene",
    "scans mm / deg",
    "median, 95 %",
    "expected mm, NEES",
    "cameras mm / deg",
    "median, 95 %",
    "expected mm, NEES",
    "exposure %",
    "leave-one-out dB",
    "s",
]
COLUMNS: dict[str, tuple[list[str], Callable[[str, Row], list[str]]]] = {
    "recordings": (
        [
            "recording",
            "PSNR dB",
            "SSIM",
            "coverage",
            "leave-one-out dB",
            "leave-one-out SSIM",
            "map entropy",
            "scans mm / deg",
            "cameras mm / deg",
            "s",
            "MB",
        ],
        _recording,
    ),
    "foreign": (
        [
            "poses",
            "leave-one-out dB",
            "leave-one-out SSIM",
            "coverage",
            "map entropy",
            "scans mm / deg",
            "cameras mm / deg",
        ],
        _foreign,
    ),
    "splats": (
        [
            "recording, camera",
            "PSNR dB: input",
            "result",
            "reference",
            "SSIM: input",
            "result",
            "reference",
        ],
        _splats,
    ),
    "simulated": (_TRUTH, _against_truth),
    "ablations": (_TRUTH, _against_truth),
    "disturbed": (
        [
            "scene",
            "scans mm / deg",
            "median, 95 %",
            "expected mm",
            "NEES",
            "cameras mm / deg",
            "median, 95 %",
            "expected mm",
            "NEES",
            "exposure %",
            "expected %",
            "NEES",
            "verdict",
            "s",
        ],
        _disturbed,
    ),
    "parts": (
        [
            "street",
            "scans off mm / deg",
            "cameras off mm / deg",
            "exposures off %",
            "scans mm / deg",
            "cameras mm / deg",
            "exposures %",
            "walls",
            "leave-one-out dB",
            "MB",
        ],
        _in_parts,
    ),
    "loops": (
        [
            "recording",
            "loops used / refused",
            "rough scans mm",
            "scans mm / deg",
            "cameras mm / deg",
            "exposures %",
            "map entropy",
            "walls",
        ],
        _loops,
    ),
    "gates": (
        [
            "recording",
            "part",
            "map entropy gain, nats",
            "PSNR gain, dB",
            "SSIM gain",
            "verdict",
            "truth, before -> after",
            "truth says",
            "gate was",
        ],
        _gate,
    ),
    "models": (
        [
            "model",
            "disturbed by",
            "scans mm / deg",
            "cameras mm / deg",
            "exposures %",
            "verdict",
            "processor s",
        ],
        _models,
    ),
    "colors": (
        [
            "scene",
            "sides wrong %",
            "strip %",
            "edges %",
            "floor %",
            "error on sides",
            "error",
            "95th percentile",
            "uncolored %",
        ],
        _colors,
    ),
    "imu": (
        [
            "scene",
            "scans mm",
            "median",
            "largest",
            "NEES",
            "open scans mm",
            "cameras mm",
            "NEES",
            "tilt deg",
        ],
        _imu,
    ),
    "degenerate directions": (
        ["scene", "degenerate in the LiDAR part", "degenerate in the visual part", "scans mm", "cameras mm"],
        _degenerate,
    ),
}


def gates_in_words(rows: dict[str, Row]) -> str:
    """How many decisions of the gates were right, and which were not."""
    wrong = [name for name, row in rows.items() if row["verdict"] == "WRONG"]
    refused = [name for name, row in rows.items() if row["verdict"] == "gain refused"]
    right = sum(row["verdict"] == "right" for row in rows.values())
    named = "".join(
        f" {what}: {', '.join(which)}."
        for what, which in (("Wrong", wrong), ("Gains refused", refused))
        if which
    )
    counts = f"{right} were right, {len(wrong)} wrong, {len(refused)} refused a gain"
    return f"Of {len(rows)} decisions {counts}; the others are open.{named}\n"


def markdown(results: dict[str, dict[str, Row]]) -> str:
    """docs/results.md as text."""
    parts = [HEAD]
    for name in sorted(results, key=lambda n: list(NOTES).index(n.split(",")[0])):
        kind = name.split(",")[0]
        head, cells = COLUMNS[kind]
        parts.append(NOTES[kind].replace("{difficulty}", name.split(", ")[-1]))
        good = {k: v for k, v in results[name].items() if "failed" not in v}
        parts.append(table(head, [cells(k, v) for k, v in good.items()]))
        parts += [f"* {k}: failed: {v['failed']}\n" for k, v in results[name].items() if "failed" in v]
        if kind == "gates":
            parts.append(gates_in_words(good))
    return "\n".join(parts)
