"""Pictures for the report: whole renderings and the crops that changed most, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lvba.parallel import in_order
from lvba.products.evaluate import Scores, State, color_by_paper
from lvba.products.render import OTHERS, ColoredCloud, RenderConfig, fill, nearest, shade

_FILL_PX = 3
_CROP, _LARGE = 1 / 3, 0.6
"""Heights of details, as parts of the image's shorter side."""
_DETAIL = 24
"""Detail is what is smaller than the shorter side over this."""
_BEST = 4
"""Images with the largest gain that details are looked for in."""


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
    """views: whole images; crops: details, those that changed most first; best: a large one, where it shows most."""

    views: tuple[Picture, ...]
    crops: tuple[Picture, ...]
    best: Picture | None = None


@dataclass(frozen=True)
class Choice:
    """Which images are shown. whole: in full, in this order; crops: those that details are looked for in."""

    whole: tuple[int, ...]
    crops: tuple[int, ...]


@dataclass(frozen=True)
class Shown:
    """What some of the chosen images show.

    whole: by image; crops: with the absolute change of the squared error; best: large ones, by how much clearer they are
    """

    whole: dict[int, Picture]
    crops: tuple[tuple[float, Picture], ...]
    best: tuple[tuple[float, Picture], ...] = ()


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
    best side; the crops come from these, the next best, and evenly spread ones."""
    before, after = (scores[name].per_image["psnr_common"] for name in ("rough", "refined"))
    chosen = _telling(after - before, views)
    if not len(chosen):
        return Choice((), ())
    spread = np.unique(np.linspace(0, len(before) - 1, 5).astype(int))
    finite = np.flatnonzero(np.isfinite(after - before))
    best = finite[np.argsort((before - after)[finite], kind="stable")[:_BEST]]
    images = scores["rough"].images
    return Choice(
        tuple(int(images[row]) for row in chosen),
        tuple(int(images[row]) for row in np.unique([*chosen, *spread, *best])),
    )


def show(
    rough: State, refined: State, choice: Choice, config: RenderConfig | None = None, first: int = 0
) -> Shown:
    """The chosen images that the states hold; first: number in the whole of their first image."""
    images = [image for image in choice.crops if first <= image < first + len(rough.views)]
    if not images:
        return Shown({}, ())
    states = [rough, refined]
    clouds = list(zip(states, color_by_paper(states), strict=True))

    def of_image(image: int) -> tuple[Picture | None, _Window | None, _Window | None]:
        own = image - first
        shown = [_shown(cloud, state, own, config) for state, cloud in clouds]
        title, mask = f"image {image}", rough.views.mask & refined.views.mask

        def cut(window: tuple[float, tuple[slice, slice]] | None) -> _Window | None:
            return None if window is None else (window[0], _picture(title, shown, window[1], mask))

        every = (slice(None), slice(None))
        whole = _picture(title, shown, every, mask) if image in choice.whole else None
        return whole, cut(_most_changed(_change(shown, mask))), cut(_where_it_shows(shown, mask))

    made = list(in_order(of_image, images))
    return Shown(
        {image: whole for image, (whole, _, _) in zip(images, made, strict=True) if whole is not None},
        tuple(crop for _, crop, _ in made if crop is not None),
        tuple(large for _, _, large in made if large is not None),
    )


def collect(choice: Choice, candidates: Sequence[Shown]) -> Pictures:
    """The pictures of all chosen images, in order; of the crops those that changed most."""
    whole = {image: picture for each in candidates for image, picture in each.whole.items()}
    crops = sorted((crop for each in candidates for crop in each.crops), key=lambda item: -item[0])
    best = max((large for each in candidates for large in each.best), key=lambda item: item[0], default=None)
    return Pictures(
        tuple(whole[image] for image in choice.whole if image in whole),
        tuple(picture for _, picture in crops[:4]),
        None if best is None else best[1],
    )


def _telling(gain: np.ndarray, count: int) -> np.ndarray:
    """Rows of the images with the largest, the median and the smallest gain (and more in between)."""
    order = np.flatnonzero(np.isfinite(gain))
    order = order[np.argsort(-gain[order], kind="stable")]
    if not len(order):
        return order
    places = np.unique(np.linspace(0, len(order) - 1, count).round().astype(int))
    return np.asarray(order[places])


_Window = tuple[float, Picture]
"""How much a window of an image tells, and its picture."""


@dataclass(frozen=True)
class _Shown:
    """A rendering as it is judged, and with its gaps closed for the eye, (H, W, 3) float32; covered: (H, W) bool.

    photo: (H, W, 3) uint8 RGB, the image as the camera of the state has it: a refined lens leaves another one
    """

    photo: np.ndarray
    color: np.ndarray
    filled: np.ndarray
    covered: np.ndarray


def _shown(cloud: ColoredCloud, state: State, image: int, config: RenderConfig | None) -> _Shown:
    entries = nearest(cloud, state.views, image, config)
    plain, filled = (
        shade(seen, cloud, state.views.log_exposure, image, light=state.views.light, curve=state.views.curve)
        for seen in (entries, fill(entries, _FILL_PX))
    )
    photo = state.views.load(image)
    return _Shown(photo, plain.color[OTHERS], filled.color[OTHERS], plain.covered[OTHERS])


def leave_one_out(cloud: ColoredCloud, state: State, image: int) -> np.ndarray:
    """An image as the points of the other images show it, (H, W, 3) uint8, black where there are none."""
    return np.asarray(np.rint(_shown(cloud, state, image, None).filled).astype(np.uint8))


def _change(shown: list[_Shown], valid: np.ndarray) -> np.ndarray:
    """By how much the squared error of each pixel that both cover became smaller, (H, W)."""
    common = shown[0].covered & shown[1].covered & valid
    before, after = (((one.color - one.photo) ** 2).sum(2) for one in shown)
    return np.where(common, before - after, 0.0)


def _where_it_shows(shown: list[_Shown], valid: np.ndarray) -> tuple[float, tuple[slice, slice]] | None:
    """The large window in which detail comes out clearer, and how much; None: it does nowhere.

    Detail correlated with the photo's, so that being brighter than the photo counts for nothing; times the photo's own
    contrast, so that there is something to see; times the part that both maps cover.
    """
    size = 2 * (min(valid.shape) // 2 // _DETAIL) + 1
    common = shown[0].covered & shown[1].covered & valid

    def detail(picture: np.ndarray) -> np.ndarray:
        gray = picture.astype(np.float32).mean(2)
        return np.where(common, gray - cv2.blur(gray, (size, size)), 0.0)

    window = _window(common.shape, _LARGE)

    def power(detail: np.ndarray) -> np.ndarray:
        # differences of sums over the whole image may be slightly below zero
        return np.asarray(np.maximum(_sums(detail**2, window), 0.0))

    photos, maps = (
        [detail(one) for one in of] for of in zip(*((s.photo, s.filled) for s in shown), strict=True)
    )
    own = power(photos[1])
    before, after = (
        _sums(photo * one, window) / np.sqrt(power(photo) * power(one) + 1e-9)
        for photo, one in zip(photos, maps, strict=True)
    )
    score = (after - before) * np.sqrt(own * _sums(common.astype(float), window)) / np.prod(window)
    return _largest(score, window)


def _most_changed(change: np.ndarray) -> tuple[float, tuple[slice, slice]] | None:
    """The small window with the largest absolute sum of the change, and that; None: nothing changed."""
    window = _window(change.shape, _CROP)
    sums = np.abs(_sums(change, window))
    return _largest(sums, window)


def _largest(sums: np.ndarray, window: tuple[int, int]) -> tuple[float, tuple[slice, slice]] | None:
    """The largest sum over a window, and that window; None: it is zero."""
    row, column = np.unravel_index(sums.argmax(), sums.shape)
    if sums[row, column] == 0:
        return None
    return float(sums[row, column]), _place(int(row), int(column), window)


def _window(shape: tuple[int, ...], part: float) -> tuple[int, int]:
    """Height, a part of the image's shorter side, and width, 4:3 to it or as wide as the image."""
    height = max(int(min(shape) * part), 1)
    return height, min(height * 4 // 3, shape[1])


def _place(row: int, column: int, window: tuple[int, int]) -> tuple[slice, slice]:
    return slice(row, row + window[0]), slice(column, column + window[1])


def _sums(values: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    """Of values (H, W) over each window, by its upper left corner."""
    height, width = window
    table = cv2.integral(values, sdepth=cv2.CV_64F)
    return np.asarray(
        table[height:, width:] - table[:-height, width:] - table[height:, :-width] + table[:-height, :-width]
    )


def _picture(title: str, shown: list[_Shown], place: tuple[slice, slice], valid: np.ndarray) -> Picture:
    mask = (shown[0].covered & shown[1].covered & valid)[place]
    rgb = [np.rint(one.filled[place]).astype(np.uint8) for one in shown]
    psnr = [_psnr(one.color[place], one.photo[place], mask) for one in shown]
    return Picture(
        title=title,
        raw=shown[1].photo[place],
        before=rgb[0],
        after=rgb[1],
        psnr_before=psnr[0],
        psnr_after=psnr[1],
    )


def _psnr(color: np.ndarray, raw: np.ndarray, mask: np.ndarray) -> float:
    if not mask.any():
        return float("nan")
    mean = float(((color - raw) ** 2)[mask].mean(dtype=np.float64))
    return float(10 * np.log10(255.0**2 / max(mean, 1e-5)))
