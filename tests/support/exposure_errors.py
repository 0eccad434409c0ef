"""How far exposures are off."""

import numpy as np


def error(found, truth):
    """(I,), of logarithms, after one common scale."""
    off = found.log_exposure - np.log(truth)
    return off - off.mean()
