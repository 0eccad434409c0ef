"""Whether refined scans are used: map and images together speak for them, or the input's are too far from them.

None of it needs truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.products import lengths
from lvba.steps.acceptance import (
    CONTRADICTION,
    LOSSES,
    PSNR,
    SSIM,
    Figure,
    GateConfig,
    Verdict,
    agreed,
    beyond,
    by_psnr,
    leading,
    words,
)

OFF_BY_INPUT = 3.0
"""Times their expected error that refined scans must be from the input's to be used where the map is as sharp: of 441
simulated recordings, disturbed or not, the refined scans of eight were further off the truth than that, by a scale of all
ranges."""


@dataclass(frozen=True)
class Shift:
    """How far refined scans are from the input's after one rigid alignment, and how far they are expected to be off the
    truth: m, root mean squares."""

    shift_m: float
    expected_m: float

    @property
    def of_input(self) -> bool:
        """Whether most of it must be the input's error: were that one as good, they would differ by little more than
        what refined scans are expected to be off."""
        return self.shift_m > OFF_BY_INPUT * self.expected_m


def may_be_better(entropy: Figure) -> bool:
    """Whether images are to be asked about refined scans: the map gains, or loses no more than its standard error.

    A map of points with a noise of 2 cm shows little of scans that are a few millimeters off: images may show more.
    """
    return entropy.finding == "better" or (entropy.finding == "neither" and not _lost(entropy))


def _lost(entropy: Figure) -> bool:
    """Whether the map is less sharp by more than its standard error."""
    return bool(-entropy.gain > np.nan_to_num(entropy.error))


def _as_sharp(entropy: Figure, shift: Shift | None) -> bool:
    """Whether refined scans, from which the input's are further than expected errors are, cost the map nothing."""
    return entropy.finding == "neither" and not _lost(entropy) and shift is not None and shift.of_input


def judge_scans(
    entropy: Figure,
    images: Sequence[Figure],
    config: GateConfig,
    open_motions: int = 0,
    shift: Shift | None = None,
) -> Verdict:
    """Whether map and images together speak for refined scan poses: one gains beyond chance, the other does not deny it.

    images: from cameras carried along with the scans, with the same exposures on both sides, or none; no figures where
        there are no images
    Scan poses may make the map sharper and still be wrong, by sliding where planes leave it open: images see that, by
    PSNR. SSIM alone contradicts nothing here: the cameras are not refined yet, and where they are centimeters off, SSIM
    punishes a sharp map for structure in the wrong place, and a blurred one less. In a simulated courtyard, scans that
    come from 56 to 0.4 mm change PSNR by +0.05 +- 0.11 dB and SSIM by -0.019 +- 0.004. In small rooms few blocks make the
    error of the entropy large; there PSNR may decide: where SSIM denies it, by as many standard errors as deny anything.
    open_motions: from scan to scan, of those that were registered first, which surfaces leave open. A map is as sharp
    whatever these are, so that only images can tell: there the poses must not be the less likely ones by PSNR.
    shift: where planes determine the scans; None: not known. It decides where the map does not tell.
    """
    figures = (entropy, *images)
    change = words(entropy)
    if not config.enabled:
        return Verdict(True, "accepted unjudged (gate.enabled is false)", f"{change}", figures)
    if entropy.finding == "unknown":
        return Verdict(False, "input poses kept", "the map is too thin to be judged by its entropy", figures)
    asked = images if may_be_better(entropy) else ()
    lost, gained = ([each.name for each in agreed(asked, way)] for way in ("worse", "better"))
    if PSNR in lost and SSIM not in gained:
        return Verdict(
            False,
            "input poses kept",
            f"the refined map is {_as(entropy)} ({change}), "
            f"but images are predicted worse ({words(*leading(images))})",
            figures,
        )
    if open_motions and SSIM not in gained and _fall(asked):
        return Verdict(
            False,
            "input poses kept",
            f"the refined map is {_as(entropy)} ({change}), but {open_motions} motions from scan to scan are not "
            f"determined by surfaces, and the images are predicted worse ({words(*leading(images))})",
            figures,
        )
    seen = PSNR in gained and (SSIM not in lost or beyond(asked, CONTRADICTION))
    # rendering alone makes small differences, and nothing else speaks for poses whose map gains too little
    seen = seen and (entropy.gain > config.min_entropy_gain or _clearly(asked))
    if shift is not None and not seen and _as_sharp(entropy, shift):
        further = (
            f"the map is as sharp ({words(entropy, *leading(images))}), and the input's poses are "
            f"{lengths.text(shift.shift_m)} from these, which are expected to be {lengths.text(shift.expected_m)} off"
        )
        return Verdict(True, "accepted", further, figures)
    if entropy.finding != "better" and not seen:
        chance = entropy.gain <= config.confidence * entropy.error
        why = (
            "by more than chance"
            if chance
            else f"by {config.min_entropy_gain:g} nats (gate.min_entropy_gain)"
        )
        why = "not sharper" if entropy.gain <= 0 else f"not sharper {why}"
        return Verdict(
            False,
            "input poses kept",
            f"the refined map is {why} ({words(entropy, *leading(images))})",
            figures,
        )
    return Verdict(True, "accepted", f"{words(entropy, *leading(images))}", figures)


def images_agree(entropy: Figure, images: Sequence[Figure]) -> bool:
    """Whether scans that make the map sharper beyond chance make PSNR better by more than its standard error: of more
    images none then speak against them beyond chance."""
    return entropy.finding == "better" and beyond(images, 1.0)


def _clearly(images: Sequence[Figure]) -> bool:
    """Whether PSNR gains more than a loss may be that contradicts nothing, over either kind of pixels."""
    return all(each.gain > LOSSES[PSNR] for each in by_psnr(images))


def _fall(images: Sequence[Figure]) -> bool:
    """Whether PSNR falls over either kind of pixels, by chance or not."""
    return bool(images) and all(each.gain < 0 for each in by_psnr(images))


def _as(entropy: Figure) -> str:
    return "sharper" if entropy.finding == "better" else "as sharp"
