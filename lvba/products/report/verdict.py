"""The verdict at the top of the page: a word, the millimeters to expect, and the reasons."""

from collections.abc import Mapping
from typing import Any

from lvba.products.report import formats
from lvba.products.report.html import details, text

Facts = Mapping[str, Any]

_WORDS = {"good": "Good", "check": "Check", "bad": "Bad"}
_MEANING = {
    "good": "no check contradicts the expected errors",
    "check": "read the reasons before you use it",
    "bad": "do not rely on it",
}
_SHOWN = 3
"""Reasons that are seen without opening anything."""


def section(facts: Facts) -> str:
    """The verdict with its reasons, and the expected errors; nothing where the facts have none."""
    judged = facts.get("verdict")
    if not judged:
        return ""
    level = judged["level"] if judged.get("level") in _WORDS else "check"
    return (
        f'<section id="verdict" class="judged {level}" aria-label="Verdict">'
        f'<p class="level"><strong>{_WORDS[level]}</strong> <span>{_MEANING[level]}</span></p>'
        f'<p class="summary">{text(judged.get("summary", ""))}</p>'
        f"{_reasons(judged.get('reasons') or [])}</section>"
    )


def _reasons(reasons: list[Facts]) -> str:
    items = [
        f"<li>{text(reason.get('text', ''))} <span class=mend>{text(reason.get('mend', ''))}</span></li>"
        for reason in reasons
    ]
    if not items:
        return ""
    more = _list(items[_SHOWN:])
    name = f"{len(items) - _SHOWN} more reason{'s' if len(items) > _SHOWN + 1 else ''}"
    return _list(items[:_SHOWN]) + (details(name, more) if more else "")


def _list(items: list[str]) -> str:
    return f'<ul class="reasons">{"".join(items)}</ul>' if items else ""


def tiles(facts: Facts) -> list[tuple[str, str, str]]:
    """Name, value and note of expected errors of map, scans and cameras, and thickness of planes."""
    expected, planes = facts.get("expected_error") or {}, facts.get("planes") or {}
    more = expected.get("at_least")
    named = [
        (
            f"{name} error, expected",
            formats.length(part.get("position_m")),
            f"95 % of {kind} below {formats.length(part.get('position_p95_m'))}"
            if not more
            else "perhaps more: see the reasons",
        )
        for key, name, kind in (
            ("map", "Map", "points"),
            ("scans", "Scan", "scans"),
            ("cameras", "Camera", "cameras"),
        )
        if (part := expected.get(key))
    ]
    if planes:
        named.append(
            (
                "Thickness of planes",
                formats.length(planes["thickness_after_m"]),
                f"before {formats.length(planes['thickness_before_m'])}",
            )
        )
    return named
