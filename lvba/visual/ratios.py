"""Log ratios of brightness of the same pieces of surface in pairs of images."""

from dataclasses import dataclass

import numpy as np

from lvba.kernels.light_ratios import LightRatios
from lvba.visual import response
from lvba.visual.radiometry import Radiometry
from lvba.visual.response import LINEAR, Response
from lvba.visual.vignetting import PairPlaces


@dataclass(frozen=True)
class Ratios:
    """Log ratios of brightness, one per comparison of a patch: log(mean in `second` / mean in `first`).

    first, second: (N,) int32, images; value, sigma: (N,) float64
    block: (N,) int64, 0 to BLOCKS - 1: which part of the surface the patch lies on
    stretch: (N,) int64, the same in pieces of STRETCH_M
    level: (N,) float64, mean of the logs of both mean grey values
    patch: (N,) int64, which patch is compared: all comparisons of one share the error of its own view
    curve: that was taken out of the images before; LINEAR: none
    places: of the patches in both images, where vignetting and response are asked for; None: they are not
    nearer: (N,) float64, log of how many times nearer patches are in `second`; None: all alike
    """

    first: np.ndarray
    second: np.ndarray
    value: np.ndarray
    sigma: np.ndarray
    block: np.ndarray
    stretch: np.ndarray
    level: np.ndarray
    patch: np.ndarray
    places: PairPlaces | None = None
    nearer: np.ndarray | None = None
    curve: Response = LINEAR

    def of_images(self, kept: np.ndarray) -> "Ratios":
        """Those of patches that were laid out in some images. kept: (I,) bool, of all images"""
        return self.take(kept[self.first])

    def take(self, mine: np.ndarray) -> "Ratios":
        """Some of them. mine: (M,) integers, or (N,) bool"""
        places = self.places
        return Ratios(
            first=self.first[mine],
            second=self.second[mine],
            value=self.value[mine],
            sigma=self.sigma[mine],
            block=self.block[mine],
            stretch=self.stretch[mine],
            level=self.level[mine],
            patch=self.patch[mine],
            places=None if places is None else PairPlaces(places.reference[mine], places.target[mine]),
            nearer=None if self.nearer is None else self.nearer[mine],
            curve=self.curve,
        )

    def by_numbers(self, present: Radiometry, light: np.ndarray) -> np.ndarray:
        """(N, NUMBERS) float64: derivative of the log ratios by the numbers of a radiometry.

        light: (N,) float64, expected log ratio of the light of each
        """
        assert self.places is not None
        falloff = self.places.by_numbers(present.vignetting)
        slopes = response.by_slopes(present.response, self.level, light)
        return np.concatenate([falloff, self._nearer[:, None], slopes], axis=1)

    def of_surfaces(self, present: Radiometry) -> np.ndarray:
        """(N,) float64: log ratios of light as if all of it had arrived."""
        light = present.response.log_ratio(self.level, self.value)
        return np.asarray(light - self.of_views(present))

    def of_views(self, present: Radiometry) -> np.ndarray:
        """(N,) float64: log ratios of the light by where a patch is in both images, and by how near it is."""
        assert self.places is not None
        return np.asarray(self.places.log_ratio(present.vignetting) + present.nearness.value * self._nearer)

    def arrays(self, sign: np.ndarray) -> LightRatios:
        """For kernels. sign: (N,) float64, 1 or -1, of each in its pair of images"""
        assert self.places is not None
        return LightRatios(
            value=self.value,
            level=self.level,
            sign=sign,
            nearer=self._nearer,
            reference=np.ascontiguousarray(self.places.reference),
            target=np.ascontiguousarray(self.places.target),
        )

    @property
    def _nearer(self) -> np.ndarray:
        return np.zeros(len(self.value)) if self.nearer is None else self.nearer
