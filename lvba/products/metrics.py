"""PSNR and SSIM of a rendering against the raw image, over the whole image and over covered pixels alone."""

from dataclasses import dataclass

import cv2
import numpy as np

from lvba.kernels import metrics as kernels

PSNR_MAX_DB = 100.0
"""What identical images get, so that means stay finite."""
_WINDOW, _SIGMA, BORDER = 11, 1.5, 5


@dataclass(frozen=True)
class RawImage:
    """A raw image with what its comparisons share.

    color: (H, W, 3) uint8; gray: (H, W) float32, luma - 128; mean, square: Gaussian means of gray and gray^2, float32
    """

    color: np.ndarray
    gray: np.ndarray
    mean: np.ndarray
    square: np.ndarray


@dataclass(frozen=True)
class Comparison:
    """How far a rendering is from the raw image, pixel by pixel, (H, W) float32 each.

    squared: squared difference, mean of the channels
    ssim_whole: SSIM of luma over whole windows, holes black
    ssim_alone: SSIM of luma over the covered pixels of each window
    """

    squared: np.ndarray
    ssim_whole: np.ndarray
    ssim_alone: np.ndarray


def prepare(color: np.ndarray) -> RawImage:
    """The raw image (H, W, 3) uint8, ready for comparisons."""
    gray = np.empty(color.shape[:2], np.float32)
    kernels.luma(color, gray)
    return RawImage(color, gray, _blur(gray), _blur(gray * gray))


def _blur(values: np.ndarray) -> np.ndarray:
    """Gaussian means with an 11 x 11 window, sigma 1.5, mirrored at the border."""
    return cv2.GaussianBlur(values, (_WINDOW, _WINDOW), _SIGMA, borderType=cv2.BORDER_REFLECT)


def compare(raw: RawImage, color: np.ndarray, covered: np.ndarray) -> Comparison:
    """Squared error and SSIM at every pixel.

    color: (H, W, 3) float32, 0..255, black where not covered; covered: (H, W) bool.
    SSIM as Wang et al. 2004: luma, Gaussian windows 11 x 11, sigma 1.5, range 255. Where only covered pixels count, the
    means and variances of each window weigh these alone (normalized convolution): a hole neither is an error nor
    hides one.
    """
    fields = np.empty((6, *raw.gray.shape), np.float32)
    squared, whole, alone = (np.empty(raw.gray.shape, np.float32) for _ in range(3))
    kernels.moments(raw.color, raw.gray, color, covered, fields, squared)
    for field in fields:
        cv2.GaussianBlur(field, (_WINDOW, _WINDOW), _SIGMA, dst=field, borderType=cv2.BORDER_REFLECT)
    kernels.ssim(fields, raw.mean, raw.square, whole, alone)
    return Comparison(squared, whole, alone)


def squared_error(raw: RawImage, color: np.ndarray) -> np.ndarray:
    """Squared difference, mean of the channels, (H, W) float32. color: (H, W, 3) float32, 0..255."""
    squared = np.empty(raw.gray.shape, np.float32)
    kernels.squared_error(raw.color, color, squared)
    return squared


def psnr(squared: np.ndarray, mask: np.ndarray) -> float:
    """Peak signal-to-noise ratio, dB, over the pixels of a mask; NaN where the mask is empty."""
    total, count = kernels.masked_sum(squared, mask, 0)
    return min(PSNR_MAX_DB, 10.0 * np.log10(255.0**2 * count / max(total, 1e-12))) if count else float("nan")


def mean_ssim(values: np.ndarray, mask: np.ndarray) -> float:
    """Mean of an SSIM map over a mask, the 5 px border left out where windows do not fit; NaN where empty."""
    total, count = kernels.masked_sum(values, mask, BORDER)
    return total / count if count else float("nan")
