"""What grey values say of the light, alike in all images of a camera: its vignetting, its response, and what nearer views
of a surface seem brighter by, found together.

All are told by how ratios of brightness differ among the patches of one pair of images, by where these are in the images,
by how bright and by how far away they are: taken one after the other, each would take up some of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Images, Indices
from lvba.camera import Camera
from lvba.kernels import edge_sums
from lvba.visual import nearness, response, vignetting
from lvba.visual.image import DARK, SATURATED
from lvba.visual.nearness import Nearness
from lvba.visual.response import LINEAR, SLOPES, Response
from lvba.visual.vignetting import Vignetting

NUMBERS = vignetting.NUMBERS + 1 + SLOPES
FALLOFF, NEARER, CURVE = (
    slice(0, vignetting.NUMBERS), slice(vignetting.NUMBERS, vignetting.NUMBERS + 1), slice(NUMBERS - SLOPES, NUMBERS)
)  # fmt: skip
"""Which of them are those of the vignetting, of what nearer views seem brighter by, and slopes of the response less 1."""
_IMAGES = np.arange(NUMBERS) != NEARER.start
"""Those that images differ from the light by."""


@dataclass(frozen=True)
class Radiometry:
    """vignetting: of the light in the images' own units, that is, to the power that the response leaves open

    True if images differ from the light by it: what nearer views seem brighter by is in ratios, not in an image.
    """

    vignetting: Vignetting = vignetting.NONE
    response: Response = LINEAR
    nearness: Nearness = nearness.NONE

    def __bool__(self) -> bool:
        return bool(self.vignetting) or bool(self.response)

    @property
    def numbers(self) -> np.ndarray:
        """(NUMBERS,) float64."""
        return np.concatenate([self.vignetting.numbers, [self.nearness.value], self.response.numbers])

    def taken_out_of(self, images: Images, camera: Camera | None, pinhole: Camera) -> np.ndarray:
        """Undistorted images (I, H, W, C) uint8 as if all light had arrived, in proportion to the light; themselves where
        nothing was found.

        camera: of the raw images, None: they have none; pinhole: of these, at any size
        """
        if camera is None or not self:
            return images
        return divided(images, vignetting.light_of_pixels(self.vignetting, camera, pinhole), self.response)


NONE = Radiometry()


def divided(images: Images, light: np.ndarray, curve: Response = LINEAR) -> np.ndarray:
    """The light of images (I, H, W, C) uint8 as if all had arrived, rounded; 255 where that is too much for a byte.

    Clipped pixels become 255, and those without a picture stay as they are.
    light: (H, W) or (H, W, C) float32, part that arrives
    """
    gain = (1 / (light if light.ndim == 3 else light[..., None])).astype(np.float32)
    corrected = np.empty_like(images)
    for index, image in enumerate(images):
        arrived = response.light_of(curve, image) if curve else image
        grey = np.rint(np.minimum(arrived * gain, np.float32(255.0))).astype(np.uint8)
        grey = np.where(image <= DARK, image, grey)
        corrected[index] = np.where(image >= SATURATED, np.uint8(255), grey)
    return corrected


@dataclass(frozen=True)
class RadiometrySums:
    """Normal equations of the numbers of a radiometry, by block of the surface: those of several parts of a recording
    add up.

    information: (B, NUMBERS, NUMBERS) float64; gradient: (B, NUMBERS) float64, so that one over the other is the numbers
    """

    information: np.ndarray
    gradient: np.ndarray

    def __add__(self, other: "RadiometrySums") -> "RadiometrySums":
        return RadiometrySums(self.information + other.information, self.gradient + other.gradient)


def sums(
    edge: Indices, block: Indices, value: np.ndarray, weight: np.ndarray, by_numbers: np.ndarray, blocks: int
) -> RadiometrySums:
    """The normal equations of the numbers, what is common to all values of an edge left open.

    edge, block: (N,) of each value; value, weight: (N,) float64
    by_numbers: (N, NUMBERS) float64, of which the product with the numbers is the value
    """
    edges = int(edge.max(initial=-1)) + 1
    table = edge_sums.normal_sums(edge, block, value, weight, by_numbers, edges, blocks)
    return RadiometrySums(table[:, :, :NUMBERS].copy(), table[:, :, NUMBERS].copy())


def best(known: RadiometrySums) -> Radiometry:
    """The vignetting and the response that fit the sums best, whatever they are, if nearer views seem no brighter.

    Where patches hardly tell of nearness, as those of a camera that turns in a room, it would take up anything.
    """
    return of_numbers(_fitted(known, _IMAGES))


def best_nearness(known: RadiometrySums) -> float:
    """What nearer views seem brighter by that fits best, whatever it is, beside the vignetting and response that do."""
    return float(_fitted(known, np.ones(NUMBERS, bool))[NEARER][0])


def solve(known: RadiometrySums, curve: Response | None = None) -> Radiometry:
    """What the sums tell: no response where that is not significant, the vignetting that goes with the response, and what
    nearer views seem brighter by.

    curve: the response, where it is known
    """
    if not known.information.any():
        return NONE
    if curve is None:
        sigma = np.sqrt(np.diag(_covariance(known, _IMAGES)))[-SLOPES:]
        curve = response.judged(_fitted(known, _IMAGES)[CURVE], sigma)
    known = _given(known, CURVE, curve.numbers)
    falloff = _vignetting(known)
    nearer = _nearness(known, bool(falloff))
    if nearer and falloff:
        falloff = _vignetting(_given(known, NEARER, np.array([nearer.value])))
    return Radiometry(falloff, curve, nearer)


def _vignetting(known: RadiometrySums) -> Vignetting:
    """With the other numbers as they are."""
    return vignetting.solve(
        vignetting.FalloffSums(known.information[:, FALLOFF, FALLOFF], known.gradient[:, FALLOFF])
    )


def _given(known: RadiometrySums, part: slice, numbers: np.ndarray) -> RadiometrySums:
    """The sums of the other numbers where these are known."""
    explained = np.einsum("bkl,l->bk", known.information[:, :, part], numbers)
    return RadiometrySums(known.information, known.gradient - explained)


def _nearness(known: RadiometrySums, vignetted: bool) -> Nearness:
    """With the response as it is, and the vignetting free where there is one.

    What comes nearer moves outward in images that look ahead: beside a vignetting that none has, nothing is told of it.
    """
    free = np.zeros(NUMBERS, bool)
    free[FALLOFF], free[NEARER] = vignetted, True
    if known.information[:, NEARER, NEARER].sum() <= nearness.PRIOR_SIGMA**-2:
        # leaving out patches that tell little changes little
        return Nearness(sigma=nearness.PRIOR_SIGMA)
    variance = np.diag(_spread(known, free))[np.flatnonzero(free) == NEARER.start]
    return nearness.judged(float(_fitted(known, free)[NEARER][0]), float(np.sqrt(variance[0])))


def mean(parts: Sequence[Radiometry]) -> Radiometry:
    """Of several parts of a recording, each number weighed by what each part knows of it; of the first part where none
    knows anything."""
    falloffs, curves = [each.vignetting for each in parts], [each.response for each in parts]
    nearer = [each.nearness for each in parts]
    falloff = _pooled([each.numbers for each in falloffs], [each.loss_sigma for each in falloffs])
    curve = _pooled([each.numbers for each in curves], [each.sigma for each in curves])
    near = _pooled([each.value for each in nearer], [each.sigma for each in nearer])
    return Radiometry(
        falloffs[0] if falloff is None else vignetting.of_numbers(*falloff),
        curves[0] if curve is None else response.of_numbers(*curve),
        nearer[0] if near is None else Nearness(float(near[0]), near[1]),
    )


def _pooled(values: Sequence[np.ndarray | float], sigmas: Sequence[float]) -> tuple[np.ndarray, float] | None:
    """The mean of parts' values, weighed by their standard deviations, and its own; None: nothing is known."""
    weights = np.array(sigmas) ** -2.0
    total = weights.sum()
    if not total > 0:
        return None
    return np.tensordot(weights / total, np.array(values), axes=1), float(total**-0.5)


def of_numbers(numbers: np.ndarray) -> Radiometry:
    """numbers: (NUMBERS,) float64"""
    return Radiometry(
        vignetting.of_numbers(numbers[FALLOFF]),
        response.of_numbers(numbers[CURVE]),
        Nearness(float(numbers[NEARER][0])),
    )


def _prior(information: np.ndarray) -> np.ndarray:
    """(NUMBERS, NUMBERS): what is known without patches; information: of the patches, same shape."""
    known = np.zeros((NUMBERS, NUMBERS))
    known[FALLOFF, FALLOFF] = np.diag(vignetting.PRIOR_SIGMA**-2)
    known[NEARER, NEARER] = nearness.PRIOR_SIGMA**-2
    known[CURVE, CURVE] = response.prior(information[CURVE, CURVE])
    return known


def _fitted(known: RadiometrySums, free: np.ndarray) -> np.ndarray:
    """(NUMBERS,): the numbers in `free` (NUMBERS,) bool that fit best, the others 0."""
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    mine, numbers = np.ix_(free, free), np.zeros(NUMBERS)
    numbers[free] = _solved(information[mine], gradient[free], _prior(information)[mine])
    return numbers


def _solved(information: np.ndarray, gradient: np.ndarray, prior: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.solve(information + prior, gradient))


def changes(known: RadiometrySums, used: Radiometry) -> np.ndarray:
    """(B, NUMBERS): of the numbers that are used, when one block of the surface is left out; 0 of those that are not."""
    free = np.zeros(NUMBERS, bool)
    free[FALLOFF] = bool(used.vignetting)
    free[: vignetting.TERMS] &= np.array(used.vignetting.coefficients) != 0
    free[NEARER] = bool(used.nearness)
    free[CURVE] = bool(used.response)
    change = np.zeros((len(known.information), NUMBERS))
    change[:, free] = _jackknife(known, free)
    return change


def _covariance(known: RadiometrySums, free: np.ndarray) -> np.ndarray:
    """(F, F): of the numbers in `free` (NUMBERS,) bool, the others known, by leaving out one block of the surface in
    turn: patches on one surface err alike."""
    information = known.information.sum(axis=0)
    own = (information + _prior(information))[np.ix_(free, free)]
    return np.asarray(_spread(known, free) + np.linalg.inv(own))


def _spread(known: RadiometrySums, free: np.ndarray) -> np.ndarray:
    """(F, F): of `_covariance`, what patches on different blocks of the surface contradict each other by."""
    change = _jackknife(known, free)
    return np.asarray((len(change) - 1) / len(change) * np.einsum("bk,bl->kl", change, change))


def _jackknife(known: RadiometrySums, free: np.ndarray) -> np.ndarray:
    """(B, F): changes of the numbers in `free` (NUMBERS,) bool, the others 0, without one block of the surface each."""
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    prior, mine = _prior(information)[np.ix_(free, free)], np.ix_(free, free)
    all_of_them = _solved(information[mine], gradient[free], prior)
    change = [
        _solved((information - own)[mine], (gradient - its)[free], prior) - all_of_them
        for own, its in zip(known.information, known.gradient, strict=True)
    ]
    return np.array(change)
