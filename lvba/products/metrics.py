"""PSNR and SSIM of a rendering against the raw image, over the whole image and over covered pixels alone."""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Picture
from lvba.kernels import metrics as kernels

PSNR_MAX_DB = 100.0
"""What identical images get, so that means stay finite."""
BORDER = kernels.WINDOW // 2
_SIGMA = 1.5
_TAPS = np.exp(-0.5 * ((np.arange(kernels.WINDOW) - BORDER) / _SIGMA) ** 2)
_WINDOW = (_TAPS / _TAPS.sum()).astype(np.float32)


@dataclass(frozen=True)
class RawImage:
    """A raw image with what its comparisons share.

    color: (H, W, 3) uint8; gray: (H, W) float32, luma - 128
    """

    color: np.ndarray
    gray: np.ndarray


@dataclass(frozen=True)
class Comparison:
    """How far a rendering is from the raw image, over each region, (R,) float64; NaN where a region is empty.

    psnr: dB
    ssim_whole: mean SSIM of luma over whole windows, holes black; the 5 px border is left out where windows do not fit
    ssim_alone: mean SSIM of luma over the covered pixels of each window, without that border
    """

    psnr: np.ndarray
    ssim_whole: np.ndarray
    ssim_alone: np.ndarray


def regions(covered: np.ndarray, *others: np.ndarray) -> np.ndarray:
    """What `compare` takes, (H, W) uint8: the covered pixels and up to three more masks, (H, W) bool, as bits.

    covered: (H, W) bool
    """
    bits = covered.astype(np.uint8)
    for number, mask in enumerate(others):
        bits |= mask.view(np.uint8) << np.uint8(number + 1)
    return bits


def prepare(color: Picture) -> RawImage:
    """The raw image (H, W, 3) uint8, ready for comparisons."""
    return RawImage(color, kernels.image_luma(color))


def compare(raw: RawImage, color: np.ndarray, bits: np.ndarray) -> Comparison:
    """PSNR and SSIM over each region.

    color: (H, W, 3) float32, 0..255, black where not covered; bits: (H, W) uint8, see `regions`.
    SSIM as Wang et al. 2004: luma, Gaussian windows 11 x 11, sigma 1.5, range 255. Where only covered pixels count, the
    means and variances of each window weigh these alone (normalized convolution): a hole neither is an error nor
    hides one.
    """
    whole, alone = kernels.ssim(raw.gray, color, bits, _WINDOW)
    inside = kernels.count(bits, BORDER)
    with np.errstate(invalid="ignore"):
        return Comparison(psnr(raw, color, bits), whole / inside, alone / inside)


def psnr(raw: RawImage, color: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """Peak signal-to-noise ratio, dB, over each region, (R,) float64; NaN where a region is empty.

    color: (H, W, 3) float32, 0..255; bits: (H, W) uint8, see `regions`
    """
    squared = np.maximum(kernels.squared_error(raw.color, color, bits), 1e-12)
    count = kernels.count(bits, 0)
    with np.errstate(divide="ignore"):
        decibels = np.minimum(PSNR_MAX_DB, 10.0 * np.log10(255.0**2 * count / squared))
    return np.where(count > 0, decibels, np.nan)
