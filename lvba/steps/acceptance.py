"""Each part against the state before it, all else equal; where a part does not gain, its input is kept.

Scans by mean map entropy, unless the images contradict it; cameras and exposures by how well the map colored from other
images predicts an image (leave-one-out PSNR), unless SSIM contradicts it. None of it needs truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lvba.products import lengths
from lvba.products.evaluate import Scores
from lvba.products.map_quality import EntropyChange
from lvba.settings import Group, setting
from lvba.steps.camera_agreement import Apart
from lvba.visual.calibration_prior import NO_CHANGE, ExtrinsicChange

ROUGH, CARRIED, EXPOSED = "rough", "carried", "exposed"
POSED, VISUAL = "posed", "visual"
FUSED_POSED, FUSED = "fused_posed", "fused"
FUSED_CARRIED, FUSED_EXPOSED = "fused_carried", "fused_exposed"
"""States under judgement. ROUGH: the input. All others have the scans that the first gate kept. CARRIED: cameras carried
along with them; POSED: the camera poses found; FUSED_POSED: these, and the scans refined with them; all without
exposures. EXPOSED, VISUAL, FUSED: the same with the exposures found. FUSED_CARRIED, FUSED_EXPOSED: as CARRIED and
EXPOSED, with the scans refined with the cameras found; judged only where they become the result."""

Finding = Literal["better", "worse", "neither", "unknown"]


@dataclass(frozen=True)
class GateConfig(Group):
    """What a stage must gain to be accepted, and what it must lose to be refused."""

    enabled: bool = setting(
        True,
        meaning="Keep a stage's result only where it gains. false: accept every result, whatever it is worth.",
        change_when="You want to see what a refused stage had made of the recording.",
    )
    min_entropy_gain: float = setting(
        0.02,
        meaning="How much lower the map entropy must be with refined scans. Smaller differences mean little.",
        unit="nats",
        low=0,
        high=10,
        change_when="The input is good already and small gains count (smaller).",
        advanced=True,
    )
    confidence: float = setting(
        2.0,
        meaning="Standard errors (over blocks of space, or over images) that a gain must exceed.",
        low=0,
        high=100,
        change_when="A wrong acceptance is worse for you than a missed one (larger).",
        advanced=True,
    )


FUSION_LOSS = 0.05
"""What part of the map entropy that refined scans gained may be given back where cameras move them: the poses before are
those at which the planes are thinnest, which are not the true ones where planes leave scans open."""
FUSION_IMAGE_LOSS = 0.1
"""What part of what images gained by refined cameras may be given back where scans move towards these: the cameras had
been fitted to the map as it was. Scans of a Kinect that came from 14.4 to 12.2 mm and from .66 to .60 degrees off motion
capture lost a twentieth of it."""
CONTRADICTION = 3.0
"""Standard errors that a loss must exceed for a gain in another figure to be given up: more than a gain, for there are
several figures, and any of them may lose by chance."""
MIN_PSNR_LOSS = 0.1
"""Losses of leave-one-out PSNR up to this, dB, contradict nothing: rendering alone makes such differences."""
MIN_SSIM_LOSS = 0.005
"""Losses of leave-one-out SSIM up to this contradict nothing."""
MOST_EXTRINSIC_SIGMAS = 3.0
"""By so many standard deviations of its calibration an extrinsic may move on the images' word, whatever that is worth."""
MOST_APART = 2.0
"""Standard deviations, root mean square, by which refined cameras may differ from those that they confirm. In 40
simulated runs with cameras that were right to 0.3 to 4 mm it was 0.1 to 1.8; in one with refined ones 6 mm off, 2.4."""
LEAST_CERTAINTY = 2.0
"""Times more certain than the calibration images must be of an extrinsic that moved further. Where the calibration of a
simulated recording is 2.6 degrees and 3 cm off, they are so ten times; a Kinect that turned on the spot moved its own by
5 cm, all cameras with it, and was no more certain than the calibration."""
SCAN_IMAGES = 60
"""So many images, spread evenly, are asked whether they contradict refined scans: enough for standard errors."""
FEW_SCAN_IMAGES = 20
"""So many of them are asked first, and the others only where these do not speak for scans that the map speaks for."""


@dataclass(frozen=True)
class Figure:
    """One figure of two states that differ in nothing but the part that is judged.

    gain: after against before, positive where it is better; error: its standard error, NaN where that is unknown
    finding: what it says of the part, by the settings of the gate
    calibration: what of the error is that of the cameras' calibration (`steps.other_calibrations`)
    """

    name: str
    before: float
    after: float
    gain: float
    error: float
    finding: Finding
    calibration: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """Whether the result of a part is used, and why.

    decision: in a few words, such as "input poses kept"; cause: of it, empty: none is given
    figures: those that decided
    confirmed: whether what was refined is not used because the input is as good, and agrees with it
    """

    accepted: bool
    decision: str
    cause: str = ""
    figures: tuple[Figure, ...] = ()
    confirmed: bool = False

    @property
    def reason(self) -> str:
        """Decision and cause as one text for the report."""
        return f"{self.decision}: {self.cause}" if self.cause else self.decision


def entropy_figure(change: EntropyChange, config: GateConfig) -> Figure:
    """What the map entropy says of scans that were moved."""
    error = change.error if np.isfinite(change.error) else 0.0
    finding: Finding = "neither"
    if not np.isfinite(change.gain):
        finding = "unknown"
    elif change.gain > max(config.min_entropy_gain, config.confidence * error):
        finding = "better"
    elif -change.gain > config.confidence * error:
        finding = "worse"
    return Figure(
        name=ENTROPY,
        before=change.before,
        after=change.after,
        gain=change.gain,
        error=change.error,
        finding=finding,
    )


def against_drawn(change: EntropyChange, config: GateConfig) -> Figure:
    """What the map entropy says of scans that cameras moved beside poses that are as likely by the planes alone."""
    return replace(entropy_figure(change, config), name=DRAWN)


ENTROPY, DRAWN = "map_entropy", "map_entropy_drawn"
PSNR, SSIM = "psnr_leave_one_out", "ssim_leave_one_out"
LOSSES = {
    PSNR: MIN_PSNR_LOSS,
    "psnr_compared": MIN_PSNR_LOSS,
    SSIM: MIN_SSIM_LOSS,
    "ssim_compared": MIN_SSIM_LOSS,
}


def image_figures(before: Scores, after: Scores, config: GateConfig) -> tuple[Figure, ...]:
    """What the images say: leave-one-out PSNR and SSIM, over the pixels of each state and over those that all cover."""
    return tuple(_image_figure(before, after, name, config) for name in LOSSES)


def _image_figure(before: Scores, after: Scores, name: str, config: GateConfig) -> Figure:
    gain, error = paired_gain(before, after, name)
    return Figure(
        name=name,
        before=getattr(before, name),
        after=getattr(after, name),
        gain=gain,
        error=error,
        finding=_finding(name, gain, error, config),
    )


def _finding(name: str, gain: float, error: float, config: GateConfig) -> Finding:
    """What the gain of an image figure says."""
    if not np.isfinite([gain, error]).all():
        return "unknown"
    if gain > config.confidence * error:
        return "better"
    return "worse" if -gain > max(LOSSES[name], CONTRADICTION * error) else "neither"


def with_calibration(figure: Figure, spread: float, config: GateConfig) -> Figure:
    """An image figure whose gain differs by so much with other calibrations as likely."""
    error = float(np.hypot(figure.error, spread))
    finding = _finding(figure.name, figure.gain, error, config)
    return replace(figure, error=error, finding=finding, calibration=spread)


def contradicted(images: Sequence[Figure]) -> bool:
    """Whether images speak against refined scans, by PSNR."""
    return PSNR in [each.name for each in agreed(images, "worse")]


def paired_gain(before: Scores, after: Scores, name: str) -> tuple[float, float]:
    """Mean over images of the gain in one score, and its standard error; NaN with fewer than three images."""
    gains = after.per_image[name] - before.per_image[name]
    gains = gains[np.isfinite(gains)]
    if len(gains) < 3:
        return float("nan"), float("nan")
    return float(gains.mean()), standard_error(gains)


def standard_error(values: np.ndarray) -> float:
    """Of the mean of N > 1 successive values (N,), of which neighbors may be alike; never less than of independent ones.

    Source: Newey and West 1987, with the lag that they recommend in 1994.
    values: (N,) float64
    """
    count = len(values)
    off = values - values.mean()
    alone = total = float(off @ off)
    lags = min(int(4 * (count / 100) ** (2 / 9)), count - 1)
    for lag in range(1, lags + 1):
        total += 2 * (1 - lag / (lags + 1)) * float(off[lag:] @ off[:-lag])
    return float(np.sqrt(max(total, alone) / count / (count - 1)))


def judge_cameras(
    before: Scores,
    after: Scores,
    config: GateConfig,
    extrinsic: ExtrinsicChange = NO_CHANGE,
    apart: Apart | None = None,
) -> Verdict:
    """Whether the camera poses found predict the images better. Same scans and same exposures in both.

    extrinsic: that they suppose. All cameras that leave the scans together change little in the images that judge each
    other: there the calibration contradicts, unless images know better.
    apart: how far they are from those before, where these belong to refined scans; None: not known
    """
    verdict = _judge_by_images(before, after, "camera poses", config)
    if apart is not None and _confirmed(verdict, extrinsic, apart):
        same = (
            f"images confirm them: refined ones are {lengths.text(apart.position_m)} and {apart.rotation_deg:.3f} "
            "degrees from these, no more than they may be off, and predict the images no better "
            f"({words(*leading(verdict.figures))})"
        )
        return replace(verdict, cause=same, confirmed=True)
    if not (config.enabled and verdict.accepted and _implausible(extrinsic)):
        return verdict
    cause = (
        f"images are predicted better ({words(*leading(verdict.figures))}), but all cameras have left the scans: the "
        f"extrinsic moved by {extrinsic.sigmas:.1f} standard deviations of its calibration, and the images "
        f"determine it only {extrinsic.certainty:.1f} times as precisely as the calibration"
    )
    return Verdict(False, "input camera poses kept", cause, verdict.figures)


def _confirmed(verdict: Verdict, extrinsic: ExtrinsicChange, apart: Apart) -> bool:
    """Whether images that gain nothing by refined cameras say that those before are right: by images that know more than
    the calibration, both are the same, and nothing is predicted worse by either."""
    if (
        verdict.accepted
        or not verdict.figures
        or {each.finding for each in verdict.figures} & {"worse", "unknown"}
    ):
        return False
    known = extrinsic == NO_CHANGE or extrinsic.certainty >= LEAST_CERTAINTY
    return known and apart.sigmas <= MOST_APART


def _implausible(extrinsic: ExtrinsicChange) -> bool:
    return extrinsic.sigmas > MOST_EXTRINSIC_SIGMAS and extrinsic.certainty < LEAST_CERTAINTY


def judge_exposures(before: Scores, after: Scores, config: GateConfig) -> Verdict:
    """Whether the exposures found predict the images better. Same scans and same camera poses in both."""
    return _judge_by_images(before, after, "relative exposures", config)


def _judge_by_images(before: Scores, after: Scores, what: str, config: GateConfig) -> Verdict:
    figures = image_figures(before, after, config)
    own, same = figures[:2]
    change = words(*leading(figures))
    if not config.enabled:
        return Verdict(True, "accepted unjudged (gate.enabled is false)", f"{change}", figures)
    if "unknown" in (own.finding, same.finding):
        few = "hardly a pixel is seen by two images, so nothing can be judged"
        return Verdict(False, f"input {what} kept", f"{few}", figures)
    if not (_predicts_better(figures) or _clearly_more_alike(figures, config)):
        return Verdict(
            False,
            f"input {what} kept",
            f"the gain of the images is not significant ({change}; "
            f"{same.before:.3f} -> {same.after:.3f} dB over the pixels covered by all)",
            figures,
        )
    if lost := agreed(figures, "worse"):
        return Verdict(
            False,
            f"input {what} kept",
            f"images are predicted better by PSNR, but worse by SSIM ({words(own, *lost)})",
            figures,
        )
    return Verdict(True, "accepted", f"{change}", figures)


_EITHER = 1.0
"""Standard errors that PSNR must gain over one kind of pixels where it gains beyond chance over the other: both are of
the same images, and of few or small ones a right gain is seldom beyond chance over both."""


def _predicts_better(figures: Sequence[Figure]) -> bool:
    """Whether PSNR gains, over all pixels covered and over those that all states cover: none may win by covering less."""
    return "better" in [each.finding for each in figures[:2]] and beyond(figures, _EITHER)


_TOGETHER = ((1.5, 0.0), (1.0, 1.0))
"""Where PSNR gains no more than chance may, SSIM must gain by so many times the standard errors that a gain must exceed,
and PSNR by so many standard errors."""


def _clearly_more_alike(figures: Sequence[Figure], config: GateConfig) -> bool:
    """Whether SSIM gains beyond chance, and PSNR, too: SSIM far beyond, and PSNR by chance or not, or each by less.

    Where noise, exposure control or shine make most of the differences, PSNR hardly tells what edges in place are worth.
    A headset's cameras, their extrinsic 0.3 degrees off: PSNR +0.05 +- 0.10 dB, SSIM +0.027 +- 0.003, orientations by the
    headset's tracking 0.45 degrees off before and 0.25 after. Exposures of 16 images that were 22 % off, right to a tenth
    of a percent after: PSNR +2.0 +- 1.1 dB, for some images gain much more than others, SSIM +0.049 +- 0.024.
    """
    by_ssim = [each for each in figures if each.name in (SSIM, "ssim_compared")]

    def gains(errors: float) -> bool:
        least = errors * config.confidence
        return all(each.gain > max(LOSSES[each.name], least * each.error) for each in by_ssim)

    return any(gains(by_edges) and beyond(figures, by_psnr) for by_edges, by_psnr in _TOGETHER)


def fused_entropy_allowed(rough_gain: float, entropy: Sequence[Figure], config: GateConfig) -> bool:
    """Whether scans that were moved towards the cameras still make a sharp map.

    It need not be sharper: the poses before are those at which the planes are thinnest, which are not the true ones where
    planes leave scans open. In two of five simulated rooms the map at the true poses has lost 1.3 % of what they gained.
    Where the input was nearly as good, that is nothing. So the map may also be as sharp as at poses drawn from what
    planes say: in four simulations true ones made it .003 less sharp (-.003 to .009), drawn ones .004 (-.003 to .013).
    rough_gain: what the scans before had gained over the input, nats
    entropy: against these, and against drawn ones where they were asked
    """
    before, *drawn = entropy
    if before.finding == "unknown":
        return False
    error = before.error if np.isfinite(before.error) else 0.0
    if -before.gain <= max(config.confidence * error, FUSION_LOSS * rough_gain):
        return True
    small = -before.gain <= config.min_entropy_gain
    return small and any(each.finding in ("better", "neither") for each in drawn)


def judge_fusion(
    rough_gain: float,
    entropy: Sequence[Figure],
    images: Sequence[Figure],
    config: GateConfig,
    cameras: Sequence[Figure] = (),
) -> Verdict:
    """Whether scans that were moved towards the cameras are contradicted, by the map or by the images.

    entropy: as of `fused_entropy_allowed`
    images: with the same cameras and exposures on both sides; none: not asked yet; cameras: what images said of these
    """
    figures = (*entropy, *images)
    change = words(entropy[0], *leading(images))
    if not config.enabled:
        return Verdict(True, "accepted unjudged (gate.enabled is false)", f"{change}", figures)
    if not fused_entropy_allowed(rough_gain, entropy, config):
        return Verdict(False, _STAY, f"the map would be less sharp ({words(entropy[0])})", figures)
    gained = {figure.name: max(figure.gain, 0.0) for figure in cameras}
    lost = agreed(images, "worse")
    if lost := [each for each in lost if -each.gain > FUSION_IMAGE_LOSS * gained.get(each.name, 0.0)]:
        return Verdict(False, _STAY, f"images would be predicted worse ({words(*lost)})", figures)
    return Verdict(True, "accepted", f"{change}", figures)


_STAY = "scans keep the LiDAR result"


def agreed(figures: Sequence[Figure], finding: Finding) -> list[Figure]:
    """Those of PSNR and SSIM for which the pixels of their own and those that all states cover agree on a finding."""
    by_name = {figure.name: figure for figure in figures}
    pairs = ((PSNR, "psnr_compared"), (SSIM, "ssim_compared"))
    return [
        by_name[own]
        for own, same in pairs
        if own in by_name and by_name[own].finding == by_name[same].finding == finding
    ]


def beyond(images: Sequence[Figure], errors: float) -> bool:
    """Whether PSNR gains by more than so many standard errors, over either kind of pixels."""
    return all(each.gain > errors * each.error for each in by_psnr(images))


def by_psnr(images: Sequence[Figure]) -> list[Figure]:
    """PSNR over either kind of pixels."""
    return [each for each in images if each.name in (PSNR, "psnr_compared")]


def leading(figures: Sequence[Figure]) -> list[Figure]:
    """PSNR and SSIM over the pixels of each state."""
    return [figure for figure in figures if figure.name in (PSNR, SSIM)]


_IN_WORDS = {
    "map_entropy": ("mean map entropy", 4, ""),
    PSNR: ("leave-one-out PSNR", 3, " dB"),
    SSIM: ("leave-one-out SSIM", 4, ""),
}


def words(*figures: Figure) -> str:
    """Before and after of each figure that is known."""
    parts = []
    for figure in figures:
        name, digits, unit = _IN_WORDS[figure.name]
        if np.isfinite([figure.before, figure.after]).all():
            chance = f" (gain {figure.gain:.{digits}f} \N{PLUS-MINUS SIGN} {figure.error:.{digits}f})"
            parts.append(
                f"{name} {figure.before:.{digits}f} -> {figure.after:.{digits}f}{unit}"
                + (chance if np.isfinite(figure.error) else "")
            )
    return ", ".join(parts) or "nothing to judge by"
