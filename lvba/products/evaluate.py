"""How well a colored map explains the images: the paper's protocol, leave-one-out, and held-out images.

The authors' tool is not published; this module defines the protocol and docs/evaluation.md explains it.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from lvba.arrays import Indices
from lvba.parallel import in_order
from lvba.products import colorize, map_quality, metrics, render
from lvba.products.cloud import Cloud
from lvba.products.colorize import ColorizeConfig
from lvba.products.render import ALL, OTHERS, ColoredCloud, RenderConfig, Rendering
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.settings import Group, setting

FIRST_IMAGES = 40
"""Images judged first, where the rest is judged only if these leave something open: a gain of many standard errors needs
no more."""
_SUFFIX = {ALL: "", OTHERS: "_leave_one_out"}
_COMMON = ("psnr_common", "ssim_common", "coverage_common")
_COMPARED = ("psnr_compared", "ssim_compared", "coverage_compared")
_FIGURES = (
    *(
        f"{name}{suffix}"
        for name in ("psnr", "ssim", "coverage", "psnr_full", "ssim_full")
        for suffix in _SUFFIX.values()
    ),
    *_COMMON,
    *_COMPARED,
)


@dataclass(frozen=True)
class EvaluateConfig(Group):
    """What is judged, and how."""

    render: RenderConfig = field(default_factory=RenderConfig)
    entropy: map_quality.EntropyConfig = field(default_factory=map_quality.EntropyConfig)
    max_images: int = setting(
        400,
        meaning="Most images judged, spread evenly; 40 where these leave no doubt about any decision. All images "
        "always color the map.",
        unit="images",
        low=1,
        high=1_000_000,
        change_when="Judging takes too long (fewer), or decisions are close and there are more images (more).",
    )


@dataclass(frozen=True)
class State:
    """One set of poses and exposures under judgement: the cloud by its scan poses, the views by its camera poses."""

    cloud: Cloud
    views: Views


@dataclass(frozen=True)
class Scores:
    """How one state scores.

    psnr (dB), ssim, coverage (part of the image): paper protocol, over covered pixels; with _leave_one_out: pixels judged
    only by points of other images; with _full: over the whole image, holes black; with _common: leave-one-out over the
    pixels that every state covers, and with _compared over those that every state covers but the ones apart (see
    `evaluate`), NaN for these; with _held_out: images that colored nothing. Means over the images
    judged; NaN where there is nothing to judge. map_entropy: nats, lower is sharper.
    per_image: the same by image, each (J,) float64; images: (J,) int32, the images judged
    """

    psnr: float
    ssim: float
    coverage: float
    psnr_leave_one_out: float
    ssim_leave_one_out: float
    coverage_leave_one_out: float
    psnr_common: float
    ssim_common: float
    coverage_common: float
    psnr_compared: float
    ssim_compared: float
    coverage_compared: float
    psnr_full: float
    ssim_full: float
    psnr_full_leave_one_out: float
    ssim_full_leave_one_out: float
    psnr_held_out: float
    ssim_held_out: float
    map_entropy: float
    splat_px: int
    images: np.ndarray
    per_image: dict[str, np.ndarray]

    def facts(self) -> dict[str, Any]:
        """Plain numbers for report.json: NaN becomes None, arrays become lists."""
        numbers = {
            name: _plain(value) for name, value in vars(self).items() if isinstance(value, int | float)
        }
        lists = {name: [_plain(float(v)) for v in values] for name, values in self.per_image.items()}
        return {**numbers, "images": [int(i) for i in self.images], "per_image": lists}


def _plain(value: float) -> float | None:
    return value if np.isfinite(value) else None


def judged_images(count: int, held_out: Indices, limit: int) -> np.ndarray:
    """Indices (J,) int32, ascending, of at most `limit` images spread evenly, with all held-out ones among them."""
    spread = np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int32))
    return np.union1d(spread, held_out).astype(np.int32)


def instead_of_blank(asked: Indices, blank: Indices, among: tuple[int, int]) -> np.ndarray:
    """The images to judge (K,) int32, ascending: those asked that are not blank, and for each that is, the nearest image
    that is neither blank nor judged already, while there is one.

    asked: (J,); blank: (b,) images that show nothing; among: half-open range of the images that may be judged
    """
    judged = np.setdiff1d(asked, blank).astype(np.int32)
    others = np.setdiff1d(np.arange(*among, dtype=np.int32), np.union1d(judged, blank))
    for image in np.intersect1d(asked, blank)[: len(others)]:
        nearest = others[np.argmin(np.abs(others - image))]
        judged, others = np.append(judged, nearest), others[others != nearest]
    return np.sort(judged)


def evaluate(
    states: Mapping[str, State],
    config: EvaluateConfig | None = None,
    *,
    held_out: Indices | None = None,
    entropies: Mapping[str, float] | None = None,
    brief: Collection[str] = (),
    apart: Collection[str] = (),
    images: np.ndarray | None = None,
    enough: Callable[[dict[str, Scores]], bool] | None = None,
    few: int = FIRST_IMAGES,
    colors: Literal["paper", "blended"] = "paper",
    colored: Mapping[str, ColoredCloud] | None = None,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of each state, all judged on the same images.

    states: by name, for example rough and refined; their views load the same images, undistorted by the camera of each.
    Give all in one call: the figures
    named _common are over the pixels covered in each, and states with the same poses share their renderings.
    held_out: indices of images that color nothing and are judged apart.
    entropies: mean map entropies by state that are known already.
    brief: states of which only the leave-one-out figures and coverage are wanted; the rest of their figures is NaN.
    apart: states that are not compared with the others pixel by pixel: the less alike states are, the fewer pixels all
        of them cover.
    images: (J,) int32, those to judge, ascending; None: chosen evenly.
    enough: whether the scores over a few of them, spread evenly, will do; None: all are judged.
    colors: paper: a point has the color of one image, eq. (10); blended: of several, as in the map (slow).
    colored: the clouds of all states, where they are colored so already; None: they are colored here.
    """
    config = config or EvaluateConfig()
    out_of_color = np.unique(np.asarray([] if held_out is None else held_out, np.int32))
    geometries = _geometries(states, colors)
    colored = colored or _colored(states, geometries, colors, out_of_color, progress)
    clouds = [colored[names[0]] for names in geometries]
    if images is None:
        count = len(next(iter(states.values())).views)
        images = judged_images(count, out_of_color, config.max_images)

    def judge_image(image: int) -> dict[str, dict[str, float]]:
        entries = [
            render.nearest(cloud, states[names[0]].views, image, config.render)
            for cloud, names in zip(clouds, geometries, strict=True)
        ]
        group = {name: number for number, names in enumerate(geometries) for name in names}
        covers = [render.covered(entry) for entry in entries]

        def rendering(name: str) -> Rendering:
            return render.shade(
                *(entries[group[name]], clouds[group[name]], states[name].views.log_exposure, image),
                only_others=name in brief,
                light=states[name].views.light,
                curve=states[name].views.curve,
            )

        # not by their cameras: two lenses may leave the same pinhole camera
        seen = {id(state.views.load): state.views for state in states.values()}
        raw = {source: metrics.prepare(views.load(image)) for source, views in seen.items()}
        valid = np.logical_and.reduce([views.mask for views in seen.values()])
        by_state = {name: raw[id(state.views.load)] for name, state in states.items()}
        covered = {name: covers[number] for name, number in group.items()}
        return judge(by_state, covered, rendering, valid, brief, apart)

    entropy = _entropies(states, config, entropies or {})
    rows: dict[int, dict[str, dict[str, float]]] = {}
    scores: dict[str, Scores] = {}
    for batch in [images] if enough is None else _first_and_rest(images, few):
        for image, row in zip(batch, in_order(judge_image, [int(i) for i in batch]), strict=True):
            rows[int(image)] = row
            progress("judge images", len(rows), len(images))
        judged = np.array(sorted(rows), np.int32)
        scores = {
            name: _scores(
                *([rows[int(i)][name] for i in judged], judged, out_of_color),
                *(entropy[name], config.render.splat_px),
            )
            for name in states
        }
        if enough is not None and len(judged) < len(images) and enough(scores):
            break
    return scores


def _first_and_rest(images: np.ndarray, few: int) -> list[np.ndarray]:
    """A few of the images, spread evenly, and the others, where there are any."""
    if len(images) <= few:
        return [images]
    first = spread_evenly(images, few)
    return [first, np.setdiff1d(images, first)]


def spread_evenly(images: Indices, most: int) -> np.ndarray:
    """At most so many of some images (J,), spread evenly."""
    if len(images) <= most:
        return images
    return np.asarray(images[np.linspace(0, len(images) - 1, most).round().astype(int)])


def together(parts: Sequence[Scores], entropy: float) -> Scores:
    """The scores of all parts' images as one; entropy: mean map entropy of the whole."""
    names = parts[0].per_image
    per_image = {name: np.concatenate([part.per_image[name] for part in parts]) for name in names}
    images = np.concatenate([part.images for part in parts])
    rows = [{name: float(values[k]) for name, values in per_image.items()} for k in range(len(images))]
    return _scores(rows, images, np.zeros(0, np.int32), entropy, parts[0].splat_px)


def completed(brief: Scores, full: Scores) -> Scores:
    """A brief state's scores, with those that it lacks taken from others of the same state."""
    lacks = {name for name, values in brief.per_image.items() if not np.isfinite(values).any()}
    return _with(brief, lacks, full)


def compared_over(scores: Scores, others: Scores) -> Scores:
    """A state's scores with the figures named _common of others of the same state and images, of other pixels."""
    return _with(scores, _COMMON, others)


def _with(scores: Scores, names: Collection[str], others: Scores) -> Scores:
    """The scores with some figures, and what they are by image, of others."""
    per_image = scores.per_image | {name: others.per_image[name] for name in names}
    return replace(scores, per_image=per_image, **{name: getattr(others, name) for name in names})


def _geometries(states: Mapping[str, State], colors: str) -> list[list[str]]:
    """Names of the states, those with the same cloud, images and camera poses together (blended colors need exposures and
    light, too)."""
    groups: dict[tuple[int, int, bytes], list[str]] = {}
    for name, state in states.items():
        exposures = b""
        if colors == "blended":
            light = state.views.light
            exposures = state.views.log_exposure.tobytes() + (b"" if light is None else light.tobytes())
            exposures += states[name].views.curve.numbers.tobytes()
        poses = repr(state.views.camera).encode() + state.views.world_from_camera.tobytes()
        key = id(state.cloud), id(state.views.load), poses + exposures
        groups.setdefault(key, []).append(name)
    return list(groups.values())


def _entropies(
    states: Mapping[str, State], config: EvaluateConfig, known: Mapping[str, float]
) -> dict[str, float]:
    """Mean map entropy of each state; states of one cloud share it."""
    entropies = {id(states[name].cloud): value for name, value in known.items() if name in states}
    for state in states.values():
        if id(state.cloud) not in entropies:
            entropies[id(state.cloud)] = map_quality.entropy_blocks(state.cloud, config.entropy).mean
    return {name: entropies[id(state.cloud)] for name, state in states.items()}


def _with_light(states: Sequence[State]) -> State:
    """The first of some states of one geometry that knows how light falls off, so that its colors serve all."""
    return next((state for state in states if state.views.light is not None), states[0])


def _colored(
    states: Mapping[str, State],
    geometries: Sequence[Sequence[str]],
    colors: str,
    held_out: np.ndarray,
    progress: Progress,
) -> dict[str, ColoredCloud]:
    """The cloud of each geometry, by the name of its first state."""
    lit = [_with_light([states[name] for name in names]) for names in geometries]
    if colors == "paper":
        clouds = color_by_paper(lit, held_out, progress)
    else:
        clouds = [render.blended_cloud(state.cloud, state.views, ColorizeConfig(), held_out) for state in lit]
    return {names[0]: cloud for names, cloud in zip(geometries, clouds, strict=True)}


def color_by_paper(
    states: Sequence[State], held_out: Indices | None = None, progress: Progress = silent
) -> list[ColoredCloud]:
    """The clouds of some states of one recording colored by eq. (10), ready to be rendered."""
    colors = colorize.paper_each([(state.cloud, state.views) for state in states], held_out, progress)
    # taken out one by one: those of all clouds and all sorted clouds are not in memory together
    return [render.colored_cloud(state.cloud.points_world, colors.pop(0)) for state in states]


def judge(
    raw: Mapping[str, metrics.RawImage],
    covered: Mapping[str, np.ndarray],
    rendering: Callable[[str], Rendering],
    valid: np.ndarray,
    brief: Collection[str] = (),
    apart: Collection[str] = (),
) -> dict[str, dict[str, float]]:
    """The figures of one image for each state's rendering of it.

    raw: the image, by state: each as its camera has it without distortion
    covered: by state, (2, H, W) bool, ALL and OTHERS; rendering: of a state by its name, one at a time: of large images,
        those of all states together are gigabytes
    valid: (H, W) bool, pixels that hold a picture; brief: states judged by their leave-one-out figures alone
    apart: states that are not compared with the others
    """
    common = np.logical_and.reduce([valid, *(each[OTHERS] for each in covered.values())])
    beside = [each[OTHERS] for name, each in covered.items() if name not in apart]
    compared = np.logical_and.reduce([valid, *beside]) if beside else common
    pixels = max(int(np.count_nonzero(valid)), 1)
    shared = {
        "coverage_common": int(np.count_nonzero(common)) / pixels,
        "coverage_compared": int(np.count_nonzero(compared)) / pixels,
    }
    rows = {}
    for name in covered:
        shaded = rendering(name)
        row = dict.fromkeys(_FIGURES, float("nan")) | shared
        for variant in _SUFFIX:
            held = covered[name][variant] & valid
            row[f"coverage{_SUFFIX[variant]}"] = int(np.count_nonzero(held)) / pixels
            bits = metrics.regions(held, valid, common, compared)
            if variant == OTHERS or name not in brief:
                row |= _figures(metrics.compare(raw[name], shaded.color[variant], bits), variant)
        if name in apart:
            row |= dict.fromkeys(_COMPARED, float("nan"))
        rows[name] = row
    return rows


def _figures(comparison: metrics.Comparison, variant: int) -> dict[str, float]:
    """The figures of one variant of a rendering; regions: covered, valid, common, compared."""
    suffix = _SUFFIX[variant]
    row = {
        f"psnr{suffix}": comparison.psnr[0],
        f"psnr_full{suffix}": comparison.psnr[1],
        f"ssim{suffix}": comparison.ssim_alone[0],
        f"ssim_full{suffix}": comparison.ssim_whole[1],
    }
    if variant == OTHERS:
        for region, pixels in ((2, "common"), (3, "compared")):
            row |= {
                f"psnr_{pixels}": comparison.psnr[region],
                f"ssim_{pixels}": comparison.ssim_alone[region],
            }
    return {name: float(value) for name, value in row.items()}


def _scores(
    rows: list[dict[str, float]], images: np.ndarray, held_out: np.ndarray, entropy: float, splat_px: int
) -> Scores:
    """Means over the images that are not held out, and apart over those that are."""
    per_image = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    apart = np.isin(images, held_out)
    means = {name: _mean(values[~apart]) for name, values in per_image.items()}
    return Scores(
        **means,
        psnr_held_out=_mean(per_image["psnr_leave_one_out"][apart]),
        ssim_held_out=_mean(per_image["ssim_leave_one_out"][apart]),
        map_entropy=entropy,
        splat_px=splat_px,
        images=images,
        per_image=per_image,
    )


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")
