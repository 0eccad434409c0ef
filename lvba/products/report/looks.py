"""Pictures of the page: photographs beside the map from rough and from refined poses."""

from lvba.products.pictures import Picture, Pictures
from lvba.products.report import formats
from lvba.products.report.html import jpeg, text

BEST = (
    "Where it shows most, rendered from points that other images colored; the best, a middling and the worst image "
    "are below."
)
SLIDERS = (
    "Drag the handle, or focus it and use the arrow keys. Each rendering shows only points that <em>other</em> images "
    "colored, so an image cannot vouch for itself. Shown are the image that gained most, a middling one and the one "
    "that gained least. Small gaps between points are closed for the eye, not for the figures."
)
CROPS = "Photo, map before, map after. Figures compare map and photo over the pixels that both maps cover."


def best(pictures: Pictures) -> str:
    """Photo, map before and map after side by side, where the difference shows most."""
    if pictures.best is None:
        return ""
    one = pictures.best
    cells = "".join(
        f'<figure class="{kind}"><img alt="{alt}" src="{jpeg(rgb, 640)}"><figcaption>{alt}{value}</figcaption></figure>'
        for kind, alt, rgb, value in (
            ("photo", "Photo", one.raw, f", {text(one.title)}"),
            ("map", "Map before", one.before, f", {formats.number(one.psnr_before, 1, 'dB')}"),
            ("map", "Map after", one.after, f", {formats.number(one.psnr_after, 1, 'dB')}"),
        )
    )
    return (
        '<section id="best" aria-label="Before and after, where it shows most">'
        f'<div class="best">{cells}</div><p class="lead">{BEST}</p></section>'
    )


def sliders(pictures: Pictures) -> str:
    """Whole images under a slider."""
    inner = "".join(_slider(k, picture) for k, picture in enumerate(pictures.views))
    return f'<div class="views">{inner}</div>' if inner else ""


def _slider(number: int, picture: Picture) -> str:
    choices = (
        ("before|after", "before | after"),
        ("raw|after", "photo | after"),
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
    psnr = f"{formats.number(picture.psnr_before, 2)} \N{RIGHTWARDS ARROW} {formats.number(picture.psnr_after, 2, 'dB')}"
    return (
        f'<div class="card compare"><div class="head"><p>{text(picture.title)}, {psnr}</p>'
        f'<fieldset class="pick" aria-label="what to compare">{picks}</fieldset></div><div class="stage">{images}'
        '<input type="range" min="0" max="100" value="50" step="1" '
        f'aria-label="position of the divider, {text(picture.title)}">'
        '<span class="handle"></span><span class="tag left"></span><span class="tag right"></span></div></div>'
    )


def crops(pictures: Pictures) -> str:
    """Details beside each other."""
    rows = []
    for picture in pictures.crops:
        cells = "".join(
            f'<div><img alt="{alt}" src="{jpeg(rgb, 480)}">{alt}{value}</div>'
            for alt, rgb, value in (
                ("photo", picture.raw, f", {text(picture.title)}"),
                ("before", picture.before, f", {formats.number(picture.psnr_before, 1, 'dB')}"),
                ("after", picture.after, f", {formats.number(picture.psnr_after, 1, 'dB')}"),
            )
        )
        rows.append(f'<figure class="crop">{cells}</figure>')
    return f'<div class="crops">{"".join(rows)}</div>' if rows else ""
