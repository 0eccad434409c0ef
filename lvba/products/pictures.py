"""Pictures for the report: whole renderings and the crops that changed most, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.products.evaluate import Scores, State, color_by_paper
from lvba.products.render import OTHERS, ColoredCloud, RenderConfig, fill, nearest, shade

_FILL_PX = 3


@dataclass(frozen=True)
class Picture:
    """One view as photographed and as rendered from the map before and after, each (H, W, 3) uint8."""

    title: str
    raw: np.ndarray
    before: np.ndarray
    after: np.ndarray
    psnr_before: float
    psnr_after: float


@dataclass(frozen=True)
class Pictures:
    """views: whole images; crops: details, those that changed most first."""

    views: tuple[Picture, ...]
    crops: tuple[Picture, ...]


@dataclass(frozen=True)
class Choice:
    """Which images are shown. whole: in full, in this order; crops: those that details are looked for in."""

    whole: tuple[int, ...]
    crops: tuple[int, ...]


@dataclass(frozen=True)
class Shown:
    """What some of the chosen images show. whole: by image; crops: with the absolute change of the squared error."""

    whole: dict[int, Picture]
    crops: tuple[tuple[float, Picture], ...]


def make(
    rough: State,
    refined: State,
    scores: dict[str, Scores],
    config: RenderConfig | None = None,
    views: int = 3,
) -> Pictures:
    """Pictures of the images that tell most, rendered from the points of other images (leave-one-out).

    scores: of `rough` and `refined`, as evaluate.evaluate gives them.
    """
    choice = choose(scores, views)
    return collect(choice, [show(rough, refined, choice, config)])


def choose(scores: dict[str, Scores], views: int = 3) -> Choice:
    """The image that gained most, the median one and the one that gained least, so that the report does not only show its
    best side; the crops come from these and from evenly spread ones."""
    before, after = (scores[name].per_image["psnr_common"] for name in ("rough", "refined"))
    chosen = _telling(after - before, views)
    if not len(chosen):
        return Choice((), ())
    spread = np.unique(np.linspace(0, len(before) - 1, 5).astype(int))
    images = scores["rough"].images
    return Choice(
        tuple(int(images[row]) for row in chosen),
        tuple(int(images[row]) for row in np.unique([*chosen, *spread])),
    )


def show(
    rough: State, refined: State, choice: Choice, config: RenderConfig | None = None, first: int = 0
) -> Shown:
    """The chosen images that the states hold; first: number in the whole of their first image."""
    images = [image for image in choice.crops if first <= image < first + len(rough.views)]
    if not images:
        return Shown({}, ())
    clouds = [(state, color_by_paper(state)) for state in (rough, refined)]
    whole: dict[int, Picture] = {}
    crops: list[tuple[float, Picture]] = []
    for image in images:
        own = image - first
        shown = [_shown(cloud, state, own, config) for state, cloud in clouds]
        raw, title, mask = rough.views.load(own), f"image {image}", rough.views.mask
        if image in choice.whole:
            whole[image] = _picture(title, raw, shown, (slice(None), slice(None)), mask)
        crop = _most_changed(raw, shown, mask)
        if crop is not None:
            crops.append((crop[0], _picture(title, raw, shown, crop[1], mask)))
    return Shown(whole, tuple(crops))


def collect(choice: Choice, found: Sequence[Shown]) -> Pictures:
    """The pictures of all chosen images, in order; of the crops those that changed most."""
    whole = {image: picture for each in found for image, picture in each.whole.items()}
    crops = sorted((crop for each in found for crop in each.crops), key=lambda item: -item[0])
    return Pictures(
        tuple(whole[image] for image in choice.whole if image in whole),
        tuple(picture for _, picture in crops[:4]),
    )


def _telling(gain: np.ndarray, count: int) -> np.ndarray:
    """Rows of the images with the largest, the median and the smallest gain (and more in between)."""
    order = np.flatnonzero(np.isfinite(gain))
    order = order[np.argsort(-gain[order], kind="stable")]
    if not len(order):
        return order
    places = np.unique(np.linspace(0, len(order) - 1, count).round().astype(int))
    return order[places]


@dataclass(frozen=True)
class _Shown:
    """A rendering as it is judged, and with its gaps closed for the eye, (H, W, 3) float32; covered: (H, W) bool."""

    color: np.ndarray
    filled: np.ndarray
    covered: np.ndarray


def _shown(cloud: ColoredCloud, state: State, image: int, config: RenderConfig | None) -> _Shown:
    entries = nearest(cloud, state.views, image, config)
    plain, filled = (
        shade(seen, cloud, state.views.log_exposure, image) for seen in (entries, fill(entries, _FILL_PX))
    )
    return _Shown(plain.color[OTHERS], filled.color[OTHERS], plain.covered[OTHERS])


def leave_one_out(cloud: ColoredCloud, state: State, image: int) -> np.ndarray:
    """An image as the points of the other images show it, (H, W, 3) uint8, black where there are none."""
    return np.rint(_shown(cloud, state, image, None).filled).astype(np.uint8)


def _most_changed(
    raw: np.ndarray, shown: list[_Shown], valid: np.ndarray
) -> tuple[float, tuple[slice, slice]] | None:
    """The window that the two renderings fit most differently, with the absolute change of its squared error."""
    common = shown[0].covered & shown[1].covered & valid
    change = ((shown[0].color - raw) ** 2).sum(2) - ((shown[1].color - raw) ** 2).sum(2)
    change = np.where(common, change, 0.0)
    height = min(raw.shape[0], raw.shape[1]) // 3
    width = height * 4 // 3
    table = np.zeros((raw.shape[0] + 1, raw.shape[1] + 1))
    table[1:, 1:] = change.cumsum(0).cumsum(1)
    window = (
        table[height:, width:] - table[:-height, width:] - table[height:, :-width] + table[:-height, :-width]
    )
    row, column = np.unravel_index(np.abs(window).argmax(), window.shape)
    if window[row, column] == 0:
        return None
    place = (slice(int(row), int(row) + height), slice(int(column), int(column) + width))
    return float(abs(window[row, column])), place


def _picture(
    title: str, raw: np.ndarray, shown: list[_Shown], place: tuple[slice, slice], valid: np.ndarray
) -> Picture:
    mask = (shown[0].covered & shown[1].covered & valid)[place]
    rgb = [np.rint(one.filled[place]).astype(np.uint8) for one in shown]
    psnr = [_psnr(one.color[place], raw[place], mask) for one in shown]
    return Picture(title, raw[place], rgb[0], rgb[1], psnr[0], psnr[1])


def _psnr(color: np.ndarray, raw: np.ndarray, mask: np.ndarray) -> float:
    if not mask.any():
        return float("nan")
    mean = float(((color - raw) ** 2)[mask].mean(dtype=np.float64))
    return float(10 * np.log10(255.0**2 / max(mean, 1e-5)))
