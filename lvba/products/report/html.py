"""The frame of the page: head, style, script; and small pieces of HTML."""

import base64
import html
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from lvba.arrays import Picture
from lvba.products.report.script import SCRIPT
from lvba.products.report.style import STYLE

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def document(title: str, body: str) -> str:
    """One self-contained page; its content policy forbids every outside request."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{text(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """The value, safe as text or as an attribute."""
    return html.escape(str(value), quote=True)


def section(name: str, heading: str, content: str, lead: str = "") -> str:
    """A section of the page; nothing where it has no content."""
    if not content:
        return ""
    intro = f'<p class="lead">{lead}</p>' if lead else ""
    return f'<section id="{name}"><h2>{text(heading)}</h2>{intro}{content}</section>'


_WIDE = 4
"""Columns that a phone shows side by side."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table whose cells are HTML; first column is the row's name."""
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{first}</th>{cells}</tr>')
    if not lines:
        return ""
    top = "".join(f'<th scope="col">{cell}</th>' if cell else "<td></td>" for cell in head)
    named = f"<thead><tr>{top}</tr></thead>" if any(head) else ""
    # what may be scrolled must be reached by the keyboard
    reach = ' tabindex="0" role="group" aria-label="Wide table"' if len(head) >= _WIDE else ""
    inner = f"{named}<tbody>{''.join(lines)}</tbody>"
    return f'<div class="scroll"{reach}><table class="{kind}">{inner}</table></div>'


def details(summary: str, content: str) -> str:
    """A part that opens on demand."""
    return f"<details><summary>{text(summary)}</summary>{content}</details>" if content else ""


def jpeg(rgb: Picture, max_width: int = 960, quality: int = 82) -> str:
    """A picture (H, W, 3) uint8 as a JPEG data URI."""
    if rgb.shape[1] > max_width:
        size = (max_width, round(rgb.shape[0] * max_width / rgb.shape[1]))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
