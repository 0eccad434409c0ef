"""How parameters that all images share move the patches of the photometric cost in their target images."""

from dataclasses import dataclass

import numpy as np

from lvba.optim.normal_equations import Border


@dataclass(frozen=True)
class Shifts:
    """How shared parameters move the patches in their target images, linear about their values at that time.

    at: (O, 2) float64, px of the level, what the values themselves move
    jacobian: (O, 3, m) float64, target pixel, px, and log exposure difference (none), per step of m parameters
    columns: (m,) int64, which of the `size` numbers of a step of all shared parameters these are
    rows: (O, 2) float64, when each patch is read in its reference and in its target, parts of the readout time after the
        middle of the image
    """

    at: np.ndarray
    jacobian: np.ndarray
    columns: np.ndarray
    size: int
    rows: np.ndarray

    @property
    def by(self) -> np.ndarray:
        """(O, 2, m) float64, px per step of m parameters."""
        return self.jacobian[:, :2]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(..., size) float64: values of all parameters, zero where these are not.

        values: (..., m) float64, of these parameters
        """
        every = np.zeros((*values.shape[:-1], self.size))
        every[..., self.columns] = values
        return every

    def spread_border(self, border: Border) -> Border:
        """Of normal equations, by all parameters, zero where these are not. border: by these parameters"""
        hessian = self.spread(self.spread(border.hessian).T)
        return Border(self.spread(border.coupling), hessian, self.spread(border.gradient))
