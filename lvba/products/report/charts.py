"""Charts as SVG text: lines over an axis, and tracks seen from above. Colors are the page's CSS variables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.products.report.html import text

WIDTH, HEIGHT = 480.0, 230.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 10.0, 10.0, 34.0
MAX_POINTS = 600


@dataclass(frozen=True)
class Line:
    """One curve. x, y: (N,); NaN interrupts it. color: a CSS variable's name."""

    name: str
    x: np.ndarray
    y: np.ndarray
    color: str
    dash: bool = False
    dots: bool = False


def legend(lines: Sequence[Line]) -> str:
    """The names of the curves beside their strokes; nothing for one curve alone."""
    if len(lines) < 2:
        return ""
    items = "".join(
        f'<li><i class="{"dash" if line.dash else ""}" style="border-color:var({line.color})"></i>{text(line.name)}</li>'
        for line in lines
    )
    return f'<ul class="legend">{items}</ul>'


def chart(
    title: str,
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    zero: bool = False,
    note: str = "",
) -> str:
    """A card with curves over common axes; nothing where no curve has two points."""
    shown = [line for line in (_thinned(line, log) for line in lines) if np.isfinite(line.y).sum() > 1]
    if not shown:
        return ""
    x_range = _bounds([line.x for line in shown], pad=0.0)
    y_range = _bounds([np.log10(line.y) if log else line.y for line in shown], pad=0.06, zero=zero)
    to_x, to_y = _scale(x_range, _LEFT, WIDTH - _RIGHT), _scale(y_range, HEIGHT - _BOTTOM, _TOP)
    marks = [_axis_y(y_range, to_y, log), _axis_x(x_range, to_x)]
    marks += [_curve(line, to_x(line.x), to_y(np.log10(line.y) if log else line.y)) for line in shown]
    marks.append(f'<text x="{WIDTH - _RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{text(x_label)}</text>')
    body = f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{text(title)}">{"".join(marks)}</svg>'
    return card(title, f"{y_label}. {note}".strip() if note else y_label, legend(shown) + body)


def card(title: str, note: str, body: str, kind: str = "") -> str:
    """A framed figure with its heading and a line below it."""
    below = f"<p>{text(note)}</p>" if note else ""
    return f'<figure class="card {kind}"><h3>{text(title)}</h3>{below}{body}</figure>'


def track(title: str, note: str, lines: Sequence[Line]) -> str:
    """A card with paths on equal axes, start marked by a dot, with a scale bar; nothing where nothing moves."""
    shown = [line for line in (_thinned(line, False) for line in lines) if len(line.x) > 1]
    if not shown:
        return ""
    x_low, x_high = _bounds([line.x for line in shown], pad=0.0)
    y_low, y_high = _bounds([line.y for line in shown], pad=0.0)
    extent = max(x_high - x_low, y_high - y_low, 1e-9)
    scale = min((WIDTH - 24) / (x_high - x_low), 330 / (y_high - y_low)) if extent > 1e-6 else 1.0
    height = max((y_high - y_low) * scale, 40) + 56
    left = (WIDTH - (x_high - x_low) * scale) / 2
    marks = []
    for line in shown:
        x, y = left + (line.x - x_low) * scale, height - 40 - (line.y - y_low) * scale
        marks.append(_curve(line, x, y))
        marks.append(f'<circle cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="3.5" fill="var({line.color})"/>')
    marks.append(_scale_bar(scale, height))
    body = f'<svg viewBox="0 0 {WIDTH:g} {height:.0f}" role="img" aria-label="{text(title)}">{"".join(marks)}</svg>'
    return card(title, note, legend(shown) + body, "tall")


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers (steps of 1, 2, 5 times a power of ten) within a range."""
    span = high - low
    if not span > 0 or not math.isfinite(span):
        return [low]
    step = 10 ** math.floor(math.log10(span / count))
    step = next(step * m for m in (1, 2, 5, 10) if span / (step * m) <= count)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def label(value: float, step: float) -> str:
    """A tick's number with as many digits as its step needs."""
    if value and (abs(value) >= 1e5 or abs(value) < 1e-4):
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    digits = max(0, -math.floor(math.log10(abs(step)) + 1e-9)) if step else 2
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _thinned(line: Line, log: bool) -> Line:
    """The curve with at most MAX_POINTS points; on a log axis, without values that have no logarithm."""
    x, y = np.asarray(line.x, float), np.asarray(line.y, float)
    if log:
        y = np.where(y > 0, y, np.nan)
    if len(x) > MAX_POINTS:
        rows = np.unique(np.linspace(0, len(x) - 1, MAX_POINTS).round().astype(int))
        x, y = x[rows], y[rows]
    return Line(name=line.name, x=x, y=y, color=line.color, dash=line.dash, dots=line.dots)


def _bounds(values: Sequence[np.ndarray], pad: float, zero: bool = False) -> tuple[float, float]:
    joined = np.concatenate(values)
    joined = joined[np.isfinite(joined)]
    low, high = float(joined.min()), float(joined.max())
    low = min(low, 0.0) if zero else low
    margin = pad * (high - low) or (0.0 if high > low else max(abs(high) * 0.05, 1e-6))
    return (low if zero and low == 0 else low - margin), high + margin


def _scale(bounds: tuple[float, float], start: float, end: float):  # type: ignore[no-untyped-def]
    low, high = bounds
    factor = (end - start) / (high - low)
    return lambda values: start + (values - low) * factor


def _axis_y(bounds: tuple[float, float], to_y, log: bool) -> str:  # type: ignore[no-untyped-def]
    places = log_ticks(*bounds) if log else ticks(*bounds, count=4)
    step = places[1] - places[0] if len(places) > 1 else 1.0
    out = []
    for place in places:
        y = float(to_y(np.log10(place) if log else place))
        tick = _plain(place) if log else label(place, step)
        out.append(f'<line class="rule" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{tick}</text>')
    return "".join(out)


def log_ticks(low: float, high: float) -> list[float]:
    """Values 1, 2, 5 times a power of ten within a range of base-10 logarithms; only powers where it is wide."""
    factors = (1, 2, 5) if high - low < 2.5 else (1,)
    every = max(1, round((high - low) / 5))
    powers = range(math.floor(low), math.ceil(high) + 1)
    places = [m * 10.0**k for k in powers if k % every == 0 for m in factors]
    inside = [place for place in places if low <= math.log10(place) <= high]
    return inside if len(inside) > 1 else [10**exponent for exponent in ticks(low, high, count=3)]


def _plain(value: float) -> str:
    """A number in few digits: 0.02, 500, 20k, 3M."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}" if value >= 1e-3 else f"{value:.0e}".replace("e-0", "e-")


def _axis_x(bounds: tuple[float, float], to_x) -> str:  # type: ignore[no-untyped-def]
    places = ticks(*bounds, count=6)
    step = places[1] - places[0] if len(places) > 1 else 1.0
    base = HEIGHT - _BOTTOM
    out = [f'<line class="axis" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{base}" y2="{base}"/>']
    for place in places:
        x = float(to_x(place))
        if x < WIDTH - 62:
            out.append(f'<text x="{x:.1f}" y="{base + 16}" text-anchor="middle">{label(place, step)}</text>')
    return "".join(out)


def _curve(line: Line, x: np.ndarray, y: np.ndarray) -> str:
    """The path, broken where a value is missing; with dots where asked."""
    path, pen_up = [], True
    for u, v in zip(x, y, strict=True):
        if not (math.isfinite(u) and math.isfinite(v)):
            pen_up = True
            continue
        path.append(f"{'M' if pen_up else 'L'}{u:.1f} {v:.1f}")
        pen_up = False
    dash = ' stroke-dasharray="5 4"' if line.dash else ""
    dots = ""
    if line.dots:
        dots = "".join(
            f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.6" fill="var({line.color})"/>'
            for u, v in zip(x, y, strict=True)
            if math.isfinite(u) and math.isfinite(v)
        )
    stroke = f'<path class="mark" stroke="var({line.color})"{dash} d="{"".join(path)}"/>'
    return f"<g><title>{text(line.name)}</title>{stroke}{dots}</g>"


def _scale_bar(scale: float, height: float) -> str:
    """A bar of a round length, about a quarter of the width."""
    exact = WIDTH / 4 / scale
    power = 10 ** math.floor(math.log10(exact))
    length = next(power * m for m in (5, 2, 1) if power * m <= exact * 1.0001)
    pixels = length * scale
    caption = f"{length:g} m" if length >= 0.1 else f"{100 * length:g} cm"
    return (
        f'<line class="axis" x1="12" x2="{12 + pixels:.1f}" y1="{height - 12:.0f}" y2="{height - 12:.0f}"/>'
        f'<text x="{18 + pixels:.1f}" y="{height - 8:.0f}">{caption}</text>'
    )
