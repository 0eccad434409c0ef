"""Scores of the images in the core of each part, and of all of them together."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lvba.arrays import Indices
from lvba.blocks.split import Part
from lvba.products import evaluate
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.progress import Progress, silent


def in_core(images: Indices, part: Part) -> np.ndarray:
    """Those of some images (J,), numbered as in the whole recording, that are in the part's core."""
    return images[(images >= part.core_images[0]) & (images < part.core_images[1])]


def as_in_whole(scores: Mapping[str, Scores], part: Part) -> dict[str, Scores]:
    """The scores of a part's images, numbered as in the whole recording."""
    first = np.int32(part.images[0])
    return {name: replace(each, images=each.images + first) for name, each in scores.items()}


def leave_one_out(
    states: Mapping[str, State],
    config: EvaluateConfig,
    images: Indices,
    blank: Indices,
    progress: Progress = silent,
    **options: Any,
) -> dict[str, Scores]:
    """The leave-one-out figures of some states over some images (J,), and no map entropy.

    blank: (b,) images that color nothing; options: others of `evaluate.evaluate`
    """
    return evaluate.evaluate(
        states,
        config,
        entropies=dict.fromkeys(states, float("nan")),
        brief=tuple(states),
        held_out=blank,
        images=images,
        progress=progress,
        **options,
    )


def together(scores: Sequence[Mapping[str, Scores]], entropy: Mapping[str, float]) -> dict[str, Scores]:
    """The scores of all parts as one, each state by the parts that have it; entropy: mean map entropy of the whole by
    state, where known. Empty where no part has any."""
    names = dict.fromkeys(name for each in scores for name in each)
    return {
        name: evaluate.together(
            [each[name] for each in scores if name in each], entropy.get(name, float("nan"))
        )
        for name in names
    }
