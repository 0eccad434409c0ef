"""What a simulated recording truly shows: the surface that each measured point lies on, and its color there."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.arrays import CloudPoints, Vectors
from lvba.errors import InputError
from lvba.io import files
from lvba.simulate import recording, simulation
from lvba.simulate.disturbances import Disturbances
from lvba.simulate.texture import Texture
from lvba.simulate.world import RayCaster, World

_ABOVE_M = 1000.0
"""From where a surface is looked at for its color: so far that all rays are along its normal."""


@dataclass(frozen=True)
class KnownScene:
    """The world of a simulated recording. scene_from_scan: (S, 4, 4), true"""

    world: World
    texture: Texture
    caster: RayCaster
    scene_from_scan: np.ndarray
    sensor_scan: np.ndarray
    """(3,) m, where the LiDAR is in the scan frame."""

    def surface(self, scan: int, points_scan: CloudPoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the beams of a scan met: rectangle (N,) int32 (-1: none), place (N, 3) m, scene frame, and how far from
        it (N,) m the point was measured.

        points_scan: (N, 3), m, scan frame
        """
        pose = self.scene_from_scan[scan]
        center = geometry.transform_points(pose, self.sensor_scan[None])[0]
        along = geometry.transform_points(pose, np.asarray(points_scan, float)) - center
        part, quad = self.caster.cast(center, along)
        part = np.where(quad >= 0, part, 0.0).astype(float)[:, None]
        return quad, center + part * along, np.linalg.norm((1 - part) * along, axis=1)

    def radiance(self, quad: np.ndarray, place: Vectors, width: float) -> np.ndarray:
        """(N, 3) float32: mean radiances of squares of `width` (m) on rectangles (N,) at places (N, 3), scene frame.

        quad: (N,) int32, -1: none
        """
        out = np.zeros((len(quad), 3), np.float32)
        for number in np.unique(quad[quad >= 0]):
            mine = np.flatnonzero(quad == number)
            center = place[mine].mean(0) + _ABOVE_M * self.world.normal[number]
            rays = np.repeat((place[mine] - center)[:, None, None], 4, axis=2)
            same = np.full(rays.shape[:3], number, np.int32)
            towards = geometry.from_rotation_translation(np.eye(3), center)
            out[mine] = self.texture.render(towards, rays, same, width)[:, 0]
        return out


def read(root: str | Path) -> KnownScene:
    """The scene of a recording that `simulate` wrote, made again from what it noted there.

    Raises: InputError if there is no such note.
    """
    path = Path(root) / recording.REFERENCE / "simulation.json"
    facts = json.loads(files.read_text(path))
    try:
        made = simulation.make(
            facts["scene"], facts["seed"], facts["difficulty"], facts["frames"], facts["scans"],
            facts["length_m"], facts.get("closing_m_deg"), Disturbances(**facts.get("disturbances", {})),
        )  # fmt: skip
    except KeyError as error:
        raise InputError(path, f"has no {error}", "take a recording that lvba simulate wrote") from error
    sensor = made.rig.body_from_lidar[:3, 3]
    return KnownScene(made.scene.world, made.texture, made.caster, made.truth.scene_from_body, sensor)
