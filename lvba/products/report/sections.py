"""The sections of the page, each from its part of the facts; a part that is missing gives no section."""

import json
from collections.abc import Mapping
from typing import Any

from lvba.products.pictures import Picture, Pictures
from lvba.products.report import figures, parts, words
from lvba.products.report.html import details, jpeg, section, table, text

Facts = Mapping[str, Any]


def title(facts: Facts) -> str:
    """The page's title."""
    return f"{_name(facts)} - LiDAR-visual bundle adjustment"


def body(facts: Facts, pictures: Pictures | None) -> str:
    """Everything between the page's head and its script."""
    shown = pictures or Pictures((), ())
    shown_in_order = [
        _tiles(facts),
        section("notes", "Worth knowing", _notes(facts)),
        section("look", "Photo and map", _sliders(shown), _LOOK),
        section("crops", "Where it changed most", _crops(shown), _CROPS),
        section("paths", "Path and exposure", figures.paths(facts), _PATHS),
        section("quality", "Quality", figures.per_image(facts) + _scores(facts), _QUALITY),
        section("truth", "Against the reference", _reference(facts), _REFERENCE),
        section("parts", "Parts and seams", parts.section(facts), parts.LEAD),
        section("work", "How it got there", figures.costs(facts) + _stages(facts)),
        section("run", "Time and memory", _times(facts)),
        section("more", "Details", _explanations() + _settings(facts)),
    ]
    return f"{_header(facts)}<main>{''.join(shown_in_order)}</main>{_footer(facts)}"


_LOOK = (
    "Drag the handle, or focus it and use the arrow keys. Each rendering shows only points that <em>other</em> images "
    "colored, so an image cannot vouch for itself. Shown are the image that gained most, a middling one and the one "
    "that gained least. Small gaps between points are closed for the eye, not for the figures."
)
_CROPS = "Photo, map before, map after. Figures compare map and photo over the pixels that both maps cover."
_PATHS = "Seen from above, and how far each pose was moved."
_QUALITY = "How well the colored map explains the photos, image by image and on average."
_REFERENCE = (
    "Root mean squares after one rigid alignment; cameras in the frame of the LiDAR map. Expected is what the "
    "covariances of the result itself promise."
)


def _name(facts: Facts) -> str:
    dataset = facts.get("dataset", {})
    return str(dataset.get("name") or str(dataset.get("path", "")).rstrip("/").rsplit("/", 1)[-1] or "Result")


def _header(facts: Facts) -> str:
    dataset = facts.get("dataset", {})
    items = [
        (words.count(dataset.get("scans")), "scans"),
        (words.count(dataset.get("images")), "images"),
        (words.number(dataset.get("duration_s"), 0, "s"), "long"),
        (words.length(dataset.get("path_length_m")), "of path"),
        (words.number(_total(facts, "seconds"), 1, "s"), "of work"),
    ]
    listed = "".join(f"<li><b>{value}</b> {name}</li>" for value, name in items if value != words.MISSING)
    return (
        '<header class="top"><p class="kicker">LiDAR-visual bundle adjustment</p>'
        f'<h1>{text(_name(facts))}</h1><p class="verdict">{words.verdict(facts)}</p>'
        f'<ul class="facts">{listed}</ul></header>'
    )


def _total(facts: Facts, key: str) -> float | None:
    values = [stage[key] for stage in facts.get("stages", []) if isinstance(stage.get(key), int | float)]
    return sum(values) if values else None


def _tiles(facts: Facts) -> str:
    evaluation = facts.get("evaluation", {})
    rough, refined = evaluation.get("rough") or {}, evaluation.get("refined") or {}
    tiles = [
        _tile(kind.name, words.measure(refined.get(kind.key), kind), words.measure(rough.get(kind.key), kind),
              _gain(rough.get(kind.key), refined.get(kind.key), kind))
        for kind in words.MEASURES[:3]
        if refined.get(kind.key) is not None
    ]  # fmt: skip
    reference = facts.get("reference") or {}
    before = reference.get("rough") or {}
    for key, name in (("lidar", "Scan error"), ("camera", "Camera error")):
        error, old = reference.get(key), before.get(key) or {}
        if error:
            tiles.append(_tile(name, words.length(error["ate_m"]), words.length(old.get("ate_m")), ""))
    return f'<div class="tiles">{"".join(tiles)}</div>' if tiles else ""


def _tile(name: str, value: str, before: str, gain: str) -> str:
    main, _, unit = value.partition("\N{NO-BREAK SPACE}")
    origin = f'<div class="from">before {before} {gain}</div>' if before != words.MISSING else ""
    figure = f'<div class="value">{main} <small>{unit}</small></div>'
    return f'<div class="tile"><div class="name">{name}</div>{figure}{origin}</div>'


def _gain(before: Any, after: Any, kind: words.Measure, unit: bool = True) -> str:
    """The change with its sign, colored as good or bad where that is known."""
    if before is None or after is None:
        return ""
    change = after - before
    tone = ""
    if kind.higher_is_better is not None and abs(change) >= 0.5 * 10**-kind.digits:
        tone = "good" if (change > 0) == kind.higher_is_better else "bad"
    sign = "+" if change > 0 else ""
    return f'<span class="gain {tone}">{sign}{words.measure(change, kind, unit=unit)}</span>'


def _notes(facts: Facts) -> str:
    notes = [
        (f"{name}: {stage['reason']}", "")
        for name, stage in (("Scans", facts.get("lidar") or {}), ("Cameras", facts.get("visual") or {}))
        if stage.get("accepted") is False and stage.get("reason")
    ]
    fusion = facts.get("fusion") or {}
    if fusion.get("accepted") is False and fusion.get("moved_m"):
        notes.append((f"Scans with what the cameras know: {fusion.get('reason')}", ""))
    for warning in facts.get("warnings", []):
        if isinstance(warning, Mapping):
            notes.append((str(warning.get("text", "")), str(warning.get("mend", ""))))
        else:
            notes.append((str(warning), ""))
    items = "".join(
        f"<li>{text(what)}{f'<span class=mend>{text(mend)}</span>' if mend else ''}</li>"
        for what, mend in notes
    )
    return f'<ul class="notes">{items}</ul>' if items else ""


def _sliders(pictures: Pictures) -> str:
    inner = "".join(_slider(k, picture) for k, picture in enumerate(pictures.views))
    return f'<div class="views">{inner}</div>' if inner else ""


def _slider(number: int, picture: Picture) -> str:
    choices = (
        ("raw|after", "photo | after"),
        ("before|after", "before | after"),
        ("raw|before", "photo | before"),
    )
    picks = "".join(
        f'<label><input type="radio" name="pair{number}" value="{value}"{" checked" if not k else ""}>'
        f"<span>{name}</span></label>"
        for k, (value, name) in enumerate(choices)
    )
    images = "".join(
        f'<img data-name="{name}" alt="{alt}" src="{jpeg(rgb)}" class="{kind}">'
        for name, alt, rgb, kind in (
            ("raw", "photo", picture.raw, ""),
            ("before", "map before", picture.before, ""),
            ("after", "map after", picture.after, "top"),
        )
    )
    psnr = f"{words.number(picture.psnr_before, 2)} \N{RIGHTWARDS ARROW} {words.number(picture.psnr_after, 2, 'dB')}"
    return (
        f'<div class="card compare"><div class="head"><p>{text(picture.title)}, {psnr}</p>'
        f'<fieldset class="pick" aria-label="what to compare">{picks}</fieldset></div><div class="stage">{images}'
        '<input type="range" min="0" max="100" value="50" step="1" '
        f'aria-label="position of the divider, {text(picture.title)}">'
        '<span class="handle"></span><span class="tag left"></span><span class="tag right"></span></div></div>'
    )


def _crops(pictures: Pictures) -> str:
    rows = []
    for picture in pictures.crops:
        cells = "".join(
            f'<div><img alt="{alt}" src="{jpeg(rgb, 480)}">{alt}{value}</div>'
            for alt, rgb, value in (
                ("photo", picture.raw, f", {text(picture.title)}"),
                ("before", picture.before, f", {words.number(picture.psnr_before, 1, 'dB')}"),
                ("after", picture.after, f", {words.number(picture.psnr_after, 1, 'dB')}"),
            )
        )
        rows.append(f'<figure class="crop">{cells}</figure>')
    return f'<div class="crops">{"".join(rows)}</div>' if rows else ""


def _scores(facts: Facts) -> str:
    evaluation = facts.get("evaluation", {})
    rough, refined = evaluation.get("rough") or {}, evaluation.get("refined") or {}
    rows = [
        (f"{kind.name}, {kind.unit}" if kind.unit else kind.name,
         *(words.measure(state.get(kind.key), kind, unit=False) for state in (rough, refined)),
         _gain(rough.get(kind.key), refined.get(kind.key), kind, unit=False))
        for kind in words.MEASURES
        if rough.get(kind.key) is not None or refined.get(kind.key) is not None
    ]  # fmt: skip
    head = ("", "before", "after", "change")
    inner = table(head, rows[:7]) + details("All figures", table(head, rows[7:]))
    return f'<div class="card tail">{inner}</div>' if inner else ""


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
                (f"{name}, position", *(words.length(e.get("ate_m")) for e in (old, error)),
                 words.length(error.get("predicted_ate_m"))),
                (f"{name}, rotation", *(words.angle(e.get("rotation_deg")) for e in (old, error)),
                 words.angle(error.get("predicted_rotation_deg"))),
                (f"{name}, frame to frame", *(words.length(e.get("rpe_m")) for e in (old, error)), words.MISSING),
            ]  # fmt: skip
    if error := reference.get("exposure"):
        old = before.get("exposure") or {}
        rows.append(("Exposure, after one scale", *(words.number(e.get("rms_percent"), 2, "%") for e in (old, error)),
                     words.number(error.get("predicted_percent"), 2, "%")))  # fmt: skip
    inner = table(("", "before", "after", "expected"), rows)
    return f'<div class="card">{inner}</div>' if inner else ""


def _stages(facts: Facts) -> str:
    """Counts, extrinsic, time offset, weak directions: what the two adjustments found."""
    cards = "".join(
        f'<div class="card"><h3>{name} {_pill(stage)}</h3>{table(("", ""), rows)}</div>'
        for name, stage, rows in (
            ("LiDAR bundle adjustment", facts.get("lidar") or {}, figures.lidar_rows(facts)),
            ("Visual bundle adjustment", facts.get("visual") or {}, figures.visual_rows(facts)),
            ("Scans with what the cameras know", facts.get("fusion") or {}, figures.fusion_rows(facts)),
        )
        if rows
    )
    return f'<div class="grid tail">{cards}</div>' if cards else ""


def _pill(stage: Facts) -> str:
    if stage.get("accepted") is None:
        return ""
    return (
        '<span class="pill good">used</span>'
        if stage["accepted"]
        else '<span class="pill bad">input kept</span>'
    )


def _times(facts: Facts) -> str:
    stages = facts.get("stages") or []
    longest = max((stage.get("seconds") or 0 for stage in stages), default=0) or 1
    rows = [
        (
            text(stage.get("name", "")) + (" (reused)" if stage.get("reused") else ""),
            f'<span class="bar" style="width:{100 * (stage.get("seconds") or 0) / longest:.1f}%"></span>',
            words.number(stage.get("seconds"), 2, "s"),
            words.number(stage.get("peak_memory_mb"), 0, "MB"),
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
         "An image is rendered only from points that other images colored. This decides whether a result is better."),
        ("Paper protocol",
         "Each point has the color of the one image nearest in time, without an occlusion test, and may judge itself."),
        ("PSNR, SSIM",
         "Likeness of rendering and photo; higher is better. Over covered pixels unless holes are said to be black."),
        ("Same pixels",
         "Over the pixels that the maps before and after both cover, so that covering less gains nothing."),
        ("Mean map entropy",
         "How thick surfaces are within 0.3 m of each point; lower is crisper. Below 0.02, differences mean little."),
        ("Coverage", "Part of the image that the colored points fill."),
        ("Weak direction",
         "A motion that the data hardly determine, as along a corridor; there the result stays near the input."),
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
    return f"<footer>{made}The same facts for programs are in report.json.</footer>"
