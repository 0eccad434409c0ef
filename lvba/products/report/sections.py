"""The sections of the page, each from its part of the facts; a part that is missing gives no section."""

import json
from collections.abc import Mapping
from typing import Any

from lvba.products import part_verdicts
from lvba.products.pictures import Pictures
from lvba.products.report import figures, formats, looks, parts, verdict, work
from lvba.products.report.html import details, section, table, text

Facts = Mapping[str, Any]


_POWER = 0.02
"""Least difference from 1 of the power of the light that exposures are to, for it to be shown."""


def title(facts: Facts) -> str:
    """The page's title."""
    return f"{_name(facts)} - LiDAR-visual bundle adjustment"


def body(facts: Facts, pictures: Pictures | None) -> str:
    """Everything between the page's head and its script."""
    available = pictures or Pictures((), ())
    sections = [
        verdict.section(facts),
        looks.best(available),
        _tiles(facts),
        section("notes", "Notes", _notes(facts)),
        section("look", "Photograph and map", looks.sliders(available), looks.SLIDERS),
        section("crops", "Largest changes", looks.crops(available), looks.CROPS),
        section("paths", "Path and exposure", figures.paths(facts), _PATHS),
        section(
            "quality", "Quality", figures.per_image(facts) + _scores(facts) + _states(facts), _quality(facts)
        ),
        section("truth", "Against the reference", _reference(facts), _REFERENCE),
        section("parts", "Parts and seams", parts.section(facts), parts.LEAD),
        section("work", "Rounds and stages", work.progress(facts) + _stages(facts)),
        section("run", "Time and memory", _times(facts)),
        section("more", "Details", _explanations() + _settings(facts)),
    ]
    return f"{_header(facts)}<main>{''.join(sections)}</main>{_footer(facts)}"


_PATHS = "Top view, and the distance that each pose moved."
_REFERENCE = (
    "Root mean squares after one rigid alignment, by positions where these determine it; cameras in the frame of "
    "the LiDAR map. Expected: as the covariances of the result predict."
)


def _name(facts: Facts) -> str:
    dataset = facts.get("dataset", {})
    return str(dataset.get("name") or str(dataset.get("path", "")).rstrip("/").rsplit("/", 1)[-1] or "Result")


def _header(facts: Facts) -> str:
    dataset = facts.get("dataset", {})
    items = [
        (formats.count(dataset.get("scans")), "scans"),
        (formats.count(dataset.get("images")), "images"),
        (formats.number(dataset.get("duration_s"), 0, "s"), "long"),
        (formats.length(dataset.get("path_length_m")), "of path"),
        (formats.number(_total(facts, "seconds"), 1, "s"), "of work"),
    ]
    listed = "".join(f"<li><b>{value}</b> {name}</li>" for value, name in items if value != formats.MISSING)
    return (
        '<header class="top"><p class="kicker">LiDAR-visual bundle adjustment</p>'
        f'<h1>{text(_name(facts))}</h1><ul class="facts">{listed}</ul></header>'
    )


def _total(facts: Facts, key: str) -> float | None:
    values = [stage[key] for stage in facts.get("stages", []) if isinstance(stage.get(key), int | float)]
    return sum(values) if values else None


def _tiles(facts: Facts) -> str:
    evaluation = facts.get("evaluation", {})
    rough, refined = evaluation.get("rough") or {}, evaluation.get("refined") or {}
    tiles = [_tile(name, value, note, "") for name, value, note in verdict.tiles(facts)]
    tiles += [
        _tile(kind.name, formats.measure(refined.get(kind.key), kind),
              _before(formats.measure(rough.get(kind.key), kind)),
              _gain(rough.get(kind.key), refined.get(kind.key), kind))
        for kind in formats.MEASURES[:3]
        if refined.get(kind.key) is not None
    ]  # fmt: skip
    reference = facts.get("reference") or {}
    before = reference.get("rough") or {}
    for key, name in (
        ("lidar", "Scans, against the reference"),
        ("camera", "Cameras, against the reference"),
    ):
        error, old = reference.get(key), before.get(key) or {}
        if error:
            tiles.append(
                _tile(name, formats.length(error["ate_m"]), _before(formats.length(old.get("ate_m"))), "")
            )
    return f'<div class="tiles">{"".join(tiles)}</div>' if tiles else ""


def _before(value: str) -> str:
    return f"before {value}" if value != formats.MISSING else ""


def _tile(name: str, value: str, note: str, gain: str) -> str:
    main, _, unit = value.partition("\N{NO-BREAK SPACE}")
    origin = f'<div class="from">{note} {gain}</div>' if note else ""
    figure = f'<div class="value">{main} <small>{unit}</small></div>'
    return f'<div class="tile"><div class="name">{name}</div>{figure}{origin}</div>'


def _gain(before: Any, after: Any, kind: formats.Measure, unit: bool = True) -> str:
    """The change with its sign, colored as good or bad where that is known."""
    if before is None or after is None:
        return ""
    change = after - before
    tone = ""
    if kind.higher_is_better is not None and abs(change) >= 0.5 * 10**-kind.digits:
        tone = "good" if (change > 0) == kind.higher_is_better else "bad"
    sign = "+" if change > 0 else ""
    return f'<span class="gain {tone}">{sign}{formats.measure(change, kind, unit=unit)}</span>'


def _notes(facts: Facts) -> str:
    notes = [] if facts.get("verdict") else _not_used(facts)
    for warning in facts.get("warnings", []):
        if isinstance(warning, Mapping):
            notes.append((str(warning.get("text", "")), str(warning.get("mend", ""))))
        else:
            notes.append((str(warning), ""))
    notes += [(sentence, "") for sentence in (_image_poses(facts),) if sentence]
    items = "".join(
        f"<li>{text(what)}{f'<span class=mend>{text(mend)}</span>' if mend else ''}</li>"
        for what, mend in notes
    )
    return f'<ul class="notes">{items}</ul>' if items else ""


def _image_poses(facts: Facts) -> str:
    """Whether the image poses on file are of the body or of the camera, and the reason."""
    recorded = (facts.get("dataset") or {}).get("image_poses") or {}
    if not recorded.get("reason"):
        return ""
    of, reason = recorded.get("of"), recorded["reason"]
    return f"image_poses.txt holds poses of the {of}, and so does the file of the result: {reason}."


def _not_used(facts: Facts) -> list[tuple[str, str]]:
    """Results of stages that were not used, with the reasons; the verdict lists them where there is one."""
    return [
        (f"{part.name.capitalize()}: {part.reason}", "")
        for part in part_verdicts.of_report(facts)
        if not part.accepted and part.reason and (part.tried or part.name in ("scans", "cameras"))
    ]


def _scores(facts: Facts) -> str:
    evaluation = facts.get("evaluation", {})
    rough, refined = evaluation.get("rough") or {}, evaluation.get("refined") or {}
    rows = [
        (f"{kind.name}, {kind.unit}" if kind.unit else kind.name,
         *(formats.measure(state.get(kind.key), kind, unit=False) for state in (rough, refined)),
         _gain(rough.get(kind.key), refined.get(kind.key), kind, unit=False))
        for kind in formats.MEASURES
        if rough.get(kind.key) is not None or refined.get(kind.key) is not None
    ]  # fmt: skip
    head = ("", "before", "after", "change")
    inner = table(head, rows[:7]) + details("All figures", table(head, rows[7:]))
    return f'<div class="card tail">{inner}</div>' if inner else ""


def _quality(facts: Facts) -> str:
    lead = "How well the colored map predicts the photos, image by image and on average."
    judged = (facts.get("evaluation") or {}).get("image_size") or {}
    camera = (facts.get("dataset") or {}).get("camera") or {}
    if judged and camera and judged["width"] < camera["width"]:
        lead += f" Figures are of photos and renderings of {judged['width']} x {judged['height']} px."
    return f"{lead} {formats.verdict(facts)}"


_STATES = {
    "rough": "The input",
    "carried": "with refined scan poses; cameras moved with them",
    "posed": "with refined camera poses as well",
    "fused_posed": "with scans refined with the cameras",
    "exposed": "with relative exposures as well",
    "fused_carried": "with scans refined with the cameras",
    "fused_exposed": "with scans refined with the cameras",
    "visual": "with relative exposures as well",
    "fused": "with relative exposures as well",
}
_WAYS = {
    "carried": ("rough", "carried"),
    "posed": ("rough", "carried", "posed"),
    "fused_posed": ("rough", "carried", "posed", "fused_posed"),
    "exposed": ("rough", "carried", "exposed"),
    "fused_carried": ("rough", "carried", "fused_carried"),
    "fused_exposed": ("rough", "carried", "exposed", "fused_exposed"),
    "visual": ("rough", "carried", "posed", "visual"),
    "fused": ("rough", "carried", "posed", "fused_posed", "fused"),
}
"""By the state that is the result, those that it was judged through."""


def _states(facts: Facts) -> str:
    """PSNR from the input over what each stage added to the result: one row of figures that reasons quote from."""
    states = (facts.get("evaluation") or {}).get("states") or {}
    way = _WAYS.get((facts.get("visual") or {}).get("state") or "", ())
    known = [(_STATES[name], (states.get(name) or {}).get("psnr_leave_one_out")) for name in way]
    known = [(name, value) for name, value in known if value is not None]
    if len(known) < 3:
        return ""
    rows = [
        (name, formats.number(value, 2), "" if last is None else formats.number(value - last, 2))
        for (name, value), last in zip(known, [None, *(value for _, value in known)], strict=False)
    ]
    note = (
        "Leave-one-out. Before and after compare the result with the input; a stage is judged by what it adds to the "
        "state before it, so its reason may start from another figure than the input's."
    )
    inner = table(("", "PSNR, dB", "added"), rows)
    return f'<div class="card tail"><h3>What each stage added</h3><p>{note}</p>{inner}</div>'


def _reference(facts: Facts) -> str:
    reference = facts.get("reference") or {}
    before = reference.get("rough") or {}
    names = (
        ("lidar", "Scans"),
        ("camera", "Cameras in the LiDAR map"),
        ("camera_aligned", "Cameras, aligned on their own"),
    )
    rows = []
    for key, name in names:
        if error := reference.get(key):
            old = before.get(key) or {}
            rows += [
                (f"{name}, position", *(formats.length(e.get("ate_m")) for e in (old, error)),
                 formats.length(error.get("predicted_ate_m"))),
                (f"{name}, rotation", *(formats.angle(e.get("rotation_deg")) for e in (old, error)),
                 formats.angle(error.get("predicted_rotation_deg"))),
                (f"{name}, rotation, with orientations aligned alone",
                 *(formats.angle(e.get("rotation_alone_deg")) for e in (old, error)), formats.MISSING),
                (f"{name}, frame to frame", *(formats.length(e.get("rpe_m")) for e in (old, error)), formats.MISSING),
            ]  # fmt: skip
    if error := reference.get("exposure"):
        old = before.get("exposure") or {}
        name = "Exposure, after one scale"
        predicted = error.get("predicted_frames")
        if predicted and predicted < error["frames"]:
            name += f" (expected: of {predicted} of {error['frames']} images)"
        rows.append((name, *(formats.number(e.get("rms_percent"), 2, "%") for e in (old, error)),
                     formats.number(error.get("predicted_percent"), 2, "%")))  # fmt: skip
        if (after := error.get("rms_percent_after_power")) is not None and abs(error["power"] - 1) > _POWER:
            rows.append((f"Exposure, after one scale and the power {error['power']:.2f} of the light, which images "
                         "leave open", formats.MISSING, formats.number(after, 2, "%"),
                         formats.number(error.get("predicted_percent_after_power"), 2, "%")))  # fmt: skip
    inner = table(("", "before", "after", "expected"), rows)
    return f'<div class="card">{inner}</div>' if inner else ""


def _stages(facts: Facts) -> str:
    """Counts, extrinsic, time offset and degenerate directions of the two adjustments."""
    cards = "".join(
        f'<div class="card"><h3>{name} {_pills(facts, parts_of)}</h3>{table(("", ""), rows)}</div>'
        for name, parts_of, rows in (
            ("LiDAR bundle adjustment", ("scans",), work.lidar_rows(facts)),
            ("Visual bundle adjustment", ("cameras", "exposures"), work.visual_rows(facts)),
            ("Scans refined with the cameras", ("scans refined with the cameras",), work.fusion_rows(facts)),
        )
        if rows
    )
    return f'<div class="grid tail">{cards}</div>' if cards else ""


def _pills(facts: Facts, names: tuple[str, ...]) -> str:
    """Whether each of some parts of the result is refined; the part is named where there are several."""
    return " ".join(
        f'<span class="pill {"good" if part.accepted else "bad"}">{f"{part.name}: " if len(names) > 1 else ""}'
        f"{'used' if part.accepted else 'input kept'}</span>"
        for part in part_verdicts.of_report(facts)
        if part.name in names
    )


def _times(facts: Facts) -> str:
    stages = facts.get("stages") or []
    longest = max((stage.get("seconds") or 0 for stage in stages), default=0) or 1
    rows = [
        (
            text(stage.get("name", "")) + (" (reused)" if stage.get("reused") else ""),
            f'<span class="bar" style="width:{100 * (stage.get("seconds") or 0) / longest:.1f}%"></span>',
            formats.number(stage.get("seconds"), 2, "s"),
            formats.number(stage.get("peak_memory_mb"), 0, "MB"),
        )
        for stage in stages
    ]
    inner = table(("stage", "", "time", "peak memory"), rows).replace(
        '<td><span class="bar"', '<td class="wide" style="text-align:left"><span class="bar"'
    )
    return f'<div class="card">{inner}</div>' if inner else ""


def _explanations() -> str:
    terms = (
        ("Leave-one-out",
         "An image is compared with the map colored from all other images. Acceptance uses it."),
        ("Paper protocol",
         "A point has the color of the image nearest in time, without an occlusion test; that may be the image itself."),
        ("PSNR, SSIM",
         "Similarity of rendering and photograph; higher is better. Over covered pixels, or with holes in black."),
        ("Same pixels",
         "Over the pixels that the maps before and after both cover, so that covering less gains nothing."),
        ("Mean map entropy",
         "How thick surfaces are within 0.3 m of each point; lower is sharper. Differences below 0.02 mean little."),
        ("Coverage", "Part of the image that the colored points fill."),
        ("Degenerate direction",
         "A motion that the data do not determine, as along a corridor; there the result stays near the input."),
    )  # fmt: skip
    listed = "".join(f"<dt>{name}</dt><dd>{what}</dd>" for name, what in terms)
    return details("What the figures mean", f"<dl>{listed}</dl>")


def _settings(facts: Facts) -> str:
    config, versions = facts.get("config"), facts.get("versions")
    out = details("Settings", f"<pre>{text(json.dumps(config, indent=2))}</pre>") if config else ""
    return out + (
        details("Versions", f"<pre>{text(json.dumps(versions, indent=2))}</pre>") if versions else ""
    )


def _footer(facts: Facts) -> str:
    versions = facts.get("versions") or {}
    made = f"Made by lvba {text(versions['lvba'])}. " if "lvba" in versions else ""
    return f"<footer>{made}report.json has the same facts for programs.</footer>"
