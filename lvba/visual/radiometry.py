"""What grey values say of the light, alike in all images of a camera: its vignetting and its response, found together.

Both are told by how ratios of brightness differ among the patches of one pair of images, by where these are in the
images and by how bright they are: taken one after the other, each would take up some of the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Images, Indices
from lvba.camera import Camera
from lvba.kernels import edge_sums
from lvba.visual import response, vignetting
from lvba.visual.image import DARK, SATURATED
from lvba.visual.response import LINEAR, SLOPES, Response
from lvba.visual.vignetting import Vignetting

NUMBERS = vignetting.NUMBERS + SLOPES
"""Those of the vignetting, then slopes of the response less 1."""


@dataclass(frozen=True)
class Radiometry:
    """vignetting: of the light in the images' own units, that is, to the power that the response leaves open"""

    vignetting: Vignetting = vignetting.NONE
    response: Response = LINEAR

    def __bool__(self) -> bool:
        return bool(self.vignetting) or bool(self.response)

    @property
    def numbers(self) -> np.ndarray:
        """(NUMBERS,) float64."""
        return np.concatenate([self.vignetting.numbers, self.response.numbers])

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
    """What fits the sums best, whatever it is."""
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    return of_numbers(_solved(information, gradient, _prior(information)))


def solve(known: RadiometrySums, curve: Response | None = None) -> Radiometry:
    """What the sums tell: no response where that is not significant, and the vignetting that goes with the response.

    curve: the response, where it is known
    """
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    if not information.any():
        return NONE
    if curve is None:
        sigma = np.sqrt(np.diag(_covariance(known))[vignetting.NUMBERS :])
        together = _solved(information, gradient, _prior(information))
        curve = response.judged(together[vignetting.NUMBERS :], sigma)
    own, rest = slice(0, vignetting.NUMBERS), slice(vignetting.NUMBERS, NUMBERS)
    explained = np.einsum("bkl,l->bk", known.information[:, own, rest], curve.numbers)
    return Radiometry(
        vignetting.solve(
            vignetting.FalloffSums(known.information[:, own, own], known.gradient[:, own] - explained)
        ),
        curve,
    )


def mean(parts: Sequence[Radiometry]) -> Radiometry:
    """Of several parts of a recording, each weighed by what it knows; of the first where none knows anything."""
    weights = np.array([each.response.sigma**-2.0 for each in parts])
    falloff = vignetting.mean([each.vignetting for each in parts])
    if not weights.sum() > 0:
        return Radiometry(falloff, parts[0].response)
    numbers = np.einsum(
        "n,nk->k", weights / weights.sum(), np.array([each.response.numbers for each in parts])
    )
    return Radiometry(falloff, response.of_numbers(numbers, float(weights.sum() ** -0.5)))


def of_numbers(numbers: np.ndarray) -> Radiometry:
    """numbers: (NUMBERS,) float64"""
    own, rest = numbers[: vignetting.NUMBERS], numbers[vignetting.NUMBERS :]
    return Radiometry(vignetting.of_numbers(own), response.of_numbers(rest))


def _prior(information: np.ndarray) -> np.ndarray:
    """(NUMBERS, NUMBERS): what is known without patches; information: of the patches, same shape."""
    known = np.diag(np.append(vignetting.PRIOR_SIGMA**-2, np.zeros(SLOPES)))
    known[vignetting.NUMBERS :, vignetting.NUMBERS :] = response.prior(
        information[vignetting.NUMBERS :, vignetting.NUMBERS :]
    )
    return known


def _solved(information: np.ndarray, gradient: np.ndarray, prior: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.solve(information + prior, gradient))


def changes(known: RadiometrySums, used: Radiometry) -> np.ndarray:
    """(B, NUMBERS): of the numbers that are used, when one block of the surface is left out; 0 of those that are not."""
    free = np.zeros(NUMBERS, bool)
    free[: vignetting.NUMBERS] = bool(used.vignetting)
    free[: vignetting.TERMS] &= np.array(used.vignetting.coefficients) != 0
    free[vignetting.NUMBERS :] = bool(used.response)
    change = np.zeros((len(known.information), NUMBERS))
    change[:, free] = _jackknife(known, free)
    return change


def _covariance(known: RadiometrySums) -> np.ndarray:
    """(NUMBERS, NUMBERS): by leaving out one block of the surface in turn: patches on one surface err alike."""
    change = _jackknife(known, np.ones(NUMBERS, bool))
    count, information = len(change), known.information.sum(axis=0)
    spread = (count - 1) / count * np.einsum("bk,bl->kl", change, change)
    return np.asarray(spread + np.linalg.inv(information + _prior(information)))


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
