"""Tables of docs/results.md from the rows in docs/results.json."""

from collections.abc import Callable
from typing import Any

Row = dict[str, Any]

HEAD = """# Results

Made by `benchmarks/results.py` from runs of the installed command with default settings; nothing here is typed by hand.
Lengths in millimeters and angles in degrees are root mean squares over all frames. How the figures are defined:
[evaluation.md](evaluation.md). Seconds are wall time on two cores that had some other work beside (and
the first rows compile, too); for what a run takes by itself see [benchmarks.md](benchmarks.md).
"""

NOTES = {
    "recordings": """## Real recordings

Before -> after. PSNR and SSIM over covered pixels by the paper's protocol (points may be judged by the image that
colored them) and leave-one-out (only points colored from other images judge a pixel). Map entropy: lower is better.
Where a recording has a reference, its poses are judged too, as any method's (`lvba evaluate`): where a result predicts
images better than the reference itself, their distance is no longer a measure of the result.
""",
    "simulated": """## Simulated scenes with known truth, {difficulty} difficulty

Rough -> refined. Scans after alignment; cameras in the frame of the aligned LiDAR map; exposures after one common scale.
"promised" is the error that the reported covariance predicts, NEES the normalized estimation error squared (1 is honest).
""",
    "parts": """## Recordings in parts

One street, undivided and in overlapping parts: against the undivided solution (largest difference of any scan, camera
and exposure, after the scans are aligned), against the truth, and walls across seams relative to those of one side alone.
""",
    "loops": """## Loops

In five parts of 32 scans. Ends that miss each other by 1 m and 2 degrees in the rough poses, beside the same place with
easy drift; and lanes whose facades repeat, where a closing that is tempting would be false.
""",
    "ablations": """## Ablations

One option each on the same simulated scenes, against truth, and leave-one-out.
""",
    "weak directions": """## Weak directions

Scenes that leave motions undetermined: what is reported, and the errors of input and result.
""",
}


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

    def pose(of: Row) -> str:
        return number(of, part, "ate_m", scale=1e3, digits=1) + " / " + number(of, part, "rotation_deg")

    return f"{pose(reference.get('rough') or {})} -> {pose(reference)}"


def _against_truth(name: str, row: Row) -> list[str]:
    reference: Row = row.get("reference") or {}
    rough: Row = reference.get("rough") or {}

    def pose(part: str, *, promised: bool = True) -> list[str]:
        before = (
            number(rough, part, "ate_m", scale=1e3, digits=1) + " / " + number(rough, part, "rotation_deg")
        )
        after = (
            number(reference, part, "ate_m", scale=1e3)
            + " / "
            + number(reference, part, "rotation_deg", digits=4)
        )
        honest = (
            number(reference, part, "predicted_ate_m", scale=1e3) + ", " + number(reference, part, "nees")
        )
        return [f"{before} -> {after}", honest]

    return [
        name,
        *pose("lidar"),
        *pose("camera"),
        number(reference, "exposure", "rms_percent"),
        change(row, "psnr_leave_one_out"),
        number(row, "seconds", digits=1),
    ]


def _weak(name: str, row: Row) -> list[str]:
    described = [_describe(row.get(f"{part}_weak_directions")) for part in ("lidar", "visual")]
    rough: Row = (row.get("reference") or {}).get("rough") or {}
    moved = [
        number(rough, part, "ate_m", scale=1e3, digits=1)
        + " -> "
        + number(row["reference"], part, "ate_m", scale=1e3, digits=1)
        for part in ("lidar", "camera")
    ]
    return [name, *described, *moved]


def _describe(weak: Any) -> str:
    if isinstance(weak, list):
        return f"{len(weak)} of all scans together"
    if isinstance(weak, dict) and weak.get("per_image"):
        return f"{min(weak['per_image'])} to {max(weak['per_image'])} per image"
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


_TRUTH = [
    "scene",
    "scans mm / deg",
    "promised mm, NEES",
    "cameras mm / deg",
    "promised mm, NEES",
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
    "simulated": (_TRUTH, _against_truth),
    "ablations": (_TRUTH, _against_truth),
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
    "weak directions": (
        ["scene", "weak in the LiDAR part", "weak in the visual part", "scans mm", "cameras mm"],
        _weak,
    ),
}


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
    return "\n".join(parts)
