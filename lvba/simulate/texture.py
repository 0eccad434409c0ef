"""What surfaces look like: products of noise octaves from 2 m to 2 mm, and flat patches with sharp edges."""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Pose
from lvba.kernels import texture as kernel
from lvba.simulate.world import World

_TILE = 128
_TEXELS_PER_WAVELENGTH = 4
_COARSEST_M = 2.0
_OCTAVES = 11
_AMPLITUDE = 0.34
_DECAY = 0.96
_COMMON = 0.85
"""Part of the contrast that all three colors share."""


@dataclass(frozen=True)
class Texture:
    """The arrays that `lvba.kernels.texture.render` reads; shapes there."""

    frames: np.ndarray
    style: np.ndarray
    phases: np.ndarray
    octaves: np.ndarray
    tile: np.ndarray
    sky: np.ndarray

    def render(
        self, scene_from_camera: Pose, rays: np.ndarray, quads: np.ndarray, width: float
    ) -> np.ndarray:
        """Mean radiances (H, W, 3) float32 of pixels with four rays each.

        rays: (H, W, 4, 3) float64, camera frame, z = 1; quads: (H, W, 4) int32, what they meet
        width: of what a ray stands for, at depth 1
        """
        look = kernel.Look(
            frames=self.frames,
            style=self.style,
            phases=self.phases,
            octaves=self.octaves,
            tile=self.tile,
            sky=self.sky,
        )
        return kernel.render(np.ascontiguousarray(scene_from_camera), rays, quads, width, look)


def build(world: World, rng: np.random.Generator) -> Texture:
    """The texture of a world: its own for every rectangle that is no copy, and for every state of `rng`."""
    unit_u = world.edge_u / np.linalg.norm(world.edge_u, axis=1, keepdims=True)
    unit_v = np.cross(world.normal, unit_u)
    frames = np.ascontiguousarray(np.stack([world.corner, unit_u, unit_v, world.normal], axis=1))
    style = np.column_stack([world.color, world.contrast, world.patches])
    phases = rng.uniform(0, _TILE, (int(world.texture.max()) + 1, _OCTAVES, 2))[world.texture]
    sky = 0.8 * np.array([0.9, 1.0, 1.15]) * rng.uniform(0.9, 1.1)
    return Texture(frames=frames, style=style, phases=phases, octaves=_octaves(rng), tile=_tile(rng), sky=sky)


def _octaves(rng: np.random.Generator) -> np.ndarray:
    """(K, 5): wavelength (m), amplitude, cosine and sine of its turn, texels per meter; coarsest first."""
    wavelength = _COARSEST_M * 0.5 ** np.arange(_OCTAVES)
    amplitude = _AMPLITUDE * _DECAY ** np.arange(_OCTAVES)
    turn = rng.uniform(0, 2 * np.pi, _OCTAVES)
    return np.column_stack(
        [wavelength, amplitude, np.cos(turn), np.sin(turn), _TEXELS_PER_WAVELENGTH / wavelength]
    )


def _tile(rng: np.random.Generator) -> np.ndarray:
    """Periodic noise of about one octave, (128, 128, 4) float32: red, green, blue and a zero.

    Each color has mean 0 and lies within -1 to 1.
    """
    common = _band(rng)
    colors = [_COMMON * common + (1 - _COMMON) * _band(rng) for _ in range(3)]
    return np.stack([*colors, np.zeros_like(common)], axis=-1).astype(np.float32)


def _band(rng: np.random.Generator) -> np.ndarray:
    """(128, 128) float64 noise with wavelengths around 4 texels' worth, mean 0, within -1 to 1."""
    frequency = np.fft.fftfreq(_TILE)
    radius = np.hypot(frequency[:, None], frequency[None, :]) * _TEXELS_PER_WAVELENGTH
    # a band, so that what a faded octave leaves out has no mean over any area larger than a pixel
    gain = np.exp(-0.5 * (np.log2(np.maximum(radius, 1e-9)) / 0.5) ** 2)
    gain[0, 0] = 0.0
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(_TILE, _TILE))) * gain).real
    bounded = np.clip(noise / (2.5 * noise.std()), -0.95, 0.95)
    return np.asarray(bounded - bounded.mean())
