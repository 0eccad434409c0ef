"""Which corrections of the camera's calibration the images call for; the others stay as calibrated.

A principal point that is off looks much like a camera that is turned, a focal length like one that sits further ahead.
Where the images cannot tell the two apart, an estimate would be noise that the poses have to follow. A group of numbers
is refined only if its correction cannot be chance: backward elimination by Wald tests (Wald 1943), the least significant
group first, the estimates of the others as they are without it.

Such a test takes for granted that what is fixed is right, and that patches are not all off alike. Interpolated images
are, by about a hundredth of a pixel, which thousands of patches make a matter of many standard deviations; the last group
that is left takes all of it, and where geometry is weak even one that is told from all others is nothing else. So a
correction must be larger than that bias, and if it is not twice as large it must be told from all others as well.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from lvba.optim.shared_parameters import SharedPrior
from lvba.visual.states import Calibration

INTRINSICS = ("focal", "principal_point", "distortion")
"""Parameters of `states.Calibration` that belong to the camera itself."""
CORRECTIONS = (*INTRINSICS, "readout")
"""Those that may be fixed at their calibrated values."""
CHANCE = 2e-9
"""How often a right value may be taken for a wrong one: six standard deviations, for errors can be twice the predicted
ones."""
APART = 6e-7
"""The same where all other corrections are free: five standard deviations."""
LIKELY = 0.0455
"""The same for what belongs to a camera of which another number is refuted: two standard deviations. Whoever calibrated
it was wrong once, and is so more likely than chance. Streets whose focal length and lens were off, and the principal
point by 3 px, saw that by 4.2 and 2.6 standard deviations, and cameras that were held there ended 10 mm off."""
BIAS_PX = 0.01
"""px, by which images are off that are interpolated: a correction that moves patches by less, once the poses have
followed, may be that, however many standard deviations it is. In a clean street a ratio of focal lengths 0.12 % off, told
from all others by six standard deviations, moved patches by 0.007 px, and cost cameras 1.5 -> 2.5 mm."""
AMBIGUOUS_PX = 0.02
"""px, below which a correction must also be told from all others. In a clean street of 320 px a lens of 0.012 px was told
by nine standard deviations, and cost cameras 2.5 -> 5.8 mm."""
_FIXED = 1e8
"""How many times over the claimed information a value counts that is fixed."""


@dataclass(frozen=True)
class Precision:
    """What images tell of corrections.

    covariance: (k, k) float64, of the deviations of all parameters, as patches contradict each other
    plain: (k, k) float64, the same as their information has it; per_pixel: that of all patches about one shift, 1/px^2
    """

    covariance: np.ndarray
    plain: np.ndarray
    per_pixel: float


def insignificant(deviation: np.ndarray, known: Precision) -> tuple[str, ...]:
    """The parameters among CORRECTIONS whose deviations may be chance, or what interpolation does.

    deviation: (k,) float64, of all parameters from their calibrated values, in the units of their steps
    """
    fixed = _eliminated(deviation, known, {})
    if set(INTRINSICS) <= set(fixed):
        return fixed
    return _eliminated(deviation, known, dict.fromkeys(INTRINSICS, LIKELY))


def _eliminated(deviation: np.ndarray, known: Precision, likely: Mapping[str, float]) -> tuple[str, ...]:
    """The parameters that backward elimination fixes. likely: by parameter, chances taken instead of the usual ones"""
    layout = Calibration.layout()
    every = {name: np.arange(layout.size)[layout[name]] for name in CORRECTIONS}
    off, spread = deviation, known.covariance
    plain_off, plain = deviation, known.plain
    apart = {name: _chance(off, spread, index) for name, index in every.items()}
    fixed: list[str] = []
    while len(fixed) < len(CORRECTIONS):
        chance = {name: _chance(off, spread, index) for name, index in every.items() if name not in fixed}
        candidates = {name: each for name, each in chance.items() if each > likely.get(name, CHANCE)}
        if not candidates:
            moves = {name: _squared(plain_off, plain, every[name]) / known.per_pixel for name in chance}
            candidates = {
                name: each
                for name, each in chance.items()
                if moves[name] < BIAS_PX**2
                or (apart[name] > likely.get(name, APART) and moves[name] < AMBIGUOUS_PX**2)
            }
        if not candidates:
            break
        least = max(candidates, key=lambda name: candidates[name])
        fixed.append(least)
        off, spread = _without(off, spread, every[least])
        plain_off, plain = _without(plain_off, plain, every[least])
    return tuple(name for name in CORRECTIONS if name in fixed)


def indices(names: Collection[str] = CORRECTIONS) -> np.ndarray:
    """(n,) int64: which of all parameters these are."""
    layout = Calibration.layout()
    return np.concatenate([np.arange(layout.size)[layout[name]] for name in names])


def significant_fraction(off: np.ndarray, known: Precision, names: Collection[str]) -> float:
    """The fraction of its square that is an error of parameters that are held: 0 where it may be chance, nearly 1 where
    it is many standard deviations. Whether calibration or images are right, nothing tells then. What interpolation does
    counts for a camera of which another number is refuted, for it may as well be off.

    off: (k,) float64, by which images want all parameters to be elsewhere, in the units of their steps
    """
    index = indices(names)
    trusted = set(INTRINSICS) <= set(names)
    if trusted and _squared(off, known.plain, index) <= BIAS_PX**2 * known.per_pixel:
        return 0.0
    return max(1.0 - len(index) / _squared(off, known.covariance, index), 0.0)


def beyond_chance(deviation: float, sigma: float) -> bool:
    """Whether one number deviates by more than CHANCE, in units of its standard deviation."""
    return float(chdtrc(1, (deviation / sigma) ** 2)) < CHANCE


def with_fixed(prior: SharedPrior[Calibration], names: Collection[str]) -> SharedPrior[Calibration]:
    """The prior with these parameters fixed at its reference."""
    layout, counted = Calibration.layout(), prior.information.copy()
    for name in names:
        mine = np.arange(layout.size)[layout[name]]
        counted[mine, :] = counted[:, mine] = 0.0
        counted[mine, mine] = _FIXED * np.diagonal(prior.claimed)[mine]
    return replace(prior, counted=counted)


def restored(values: Calibration, reference: Calibration, names: Collection[str]) -> Calibration:
    """The values with these parameters exactly as in the reference: a solve leaves them there but for rounding."""
    return replace(values, **{name: getattr(reference, name) for name in names})


def _chance(off: np.ndarray, spread: np.ndarray, index: np.ndarray) -> float:
    """How often numbers that are right deviate as much."""
    return float(chdtrc(len(index), _squared(off, spread, index)))


def _squared(off: np.ndarray, spread: np.ndarray, index: np.ndarray) -> float:
    """Of the deviations of some numbers, in their standard deviations."""
    return float(off[index] @ np.linalg.solve(spread[np.ix_(index, index)], off[index]))


def _without(off: np.ndarray, spread: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations and covariance given that the numbers at `index` do not deviate; those keep rows of zeros but for a one
    on the diagonal."""
    gain = np.linalg.solve(spread[np.ix_(index, index)], spread[index]).T
    off, spread = off - gain @ off[index], spread - gain @ spread[index]
    off[index] = 0.0
    spread[index, :] = spread[:, index] = 0.0
    spread[index, index] = 1.0
    return off, spread
