"""Scores of which tests give the figures of single images."""

from dataclasses import fields

import numpy as np

from lvba.products.evaluate import Scores


def scores_of(per_image, images=None):
    """Scores with these figures (J,) of images and their means; other figures are 0. images: 0 to J - 1 unless given"""
    count = len(next(iter(per_image.values())))
    given = {
        name: float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
        for name, values in per_image.items()
    }
    given |= {
        "images": np.arange(count, dtype=np.int32) if images is None else images,
        "per_image": per_image,
    }
    return Scores(**{field.name: given.get(field.name, 0.0) for field in fields(Scores)})
