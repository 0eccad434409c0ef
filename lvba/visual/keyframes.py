"""Which images take part in the visual bundle adjustment."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Times
from lvba.settings import Group, setting


@dataclass(frozen=True)
class KeyframeConfig(Group):
    """An image becomes a keyframe once enough time has passed, or the camera moved or turned, since the last one."""

    interval_s: float = setting(
        0.19,
        meaning="Recordings of up to 5 Hz keep every image, faster ones are thinned to about one image in this time. "
        "0: every image.",
        unit="s",
        low=0,
        change_when="Runs take too long (longer), or fast motion is followed badly (shorter).",
    )
    translation_ratio: float = setting(
        0.04,
        meaning="Motion that makes a keyframe sooner, as a part of the scene's depth. A vehicle at 10 Hz "
        "keeps all images.",
        low=1e-6,
        change_when="A slow close-up recording keeps too many images (larger).",
        advanced=True,
    )
    rotation_deg: float = setting(
        8.0,
        meaning="Turn that makes a keyframe sooner.",
        unit="degrees",
        low=1e-6,
        change_when="The camera turns fast and neighboring keyframes overlap too little (smaller).",
        advanced=True,
    )


def select(
    times: Times,
    world_from_camera: Poses,
    scene_depth: float,
    config: KeyframeConfig = KeyframeConfig(),
) -> np.ndarray:
    """Ascending indices (K,) int64 of the keyframes among I images; the first and the last always belong.

    times: (I,) s, ascending; world_from_camera: (I, 4, 4)
    scene_depth: m, typical distance of what the cameras see (the median range of the scans will do)
    """
    chosen = [0] if len(times) else []
    for index in range(1, len(times)):
        last = chosen[-1]
        step = geometry.inverse(world_from_camera[last]) @ world_from_camera[index]
        waited = times[index] - times[last] >= config.interval_s
        moved = np.linalg.norm(step[:3, 3]) >= config.translation_ratio * scene_depth
        turned = geometry.rotation_angle_deg(step[None])[0] >= config.rotation_deg
        if waited or moved or turned or index == len(times) - 1:
            chosen.append(index)
    return np.array(chosen, np.int64)
