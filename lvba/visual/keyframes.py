"""Which images take part in the visual bundle adjustment."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry


@dataclass(frozen=True)
class KeyframeConfig:
    """An image becomes a keyframe once enough time has passed, or the camera moved or turned, since the last one."""

    interval_s: float = 0.19
    """Seconds: recordings of up to 5 Hz keep every image, faster ones are thinned to about this; 0 (all) or more."""
    translation_ratio: float = 0.04
    """Motion that makes a keyframe sooner, as a part of the scene's depth (a vehicle at 10 Hz keeps all); above 0."""
    rotation_deg: float = 8.0
    """Turn that makes a keyframe sooner, degrees; above 0."""

    def __post_init__(self) -> None:
        for name in ("interval_s", "translation_ratio", "rotation_deg"):
            value = getattr(self, name)
            if not value >= 0 or (value == 0 and name != "interval_s"):
                raise ValueError(f"{name} = {value}: must be above 0")


def select(
    times: np.ndarray,
    world_from_camera: np.ndarray,
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
