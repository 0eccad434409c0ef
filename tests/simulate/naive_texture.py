"""Slow plain twins of lvba.kernels.texture."""

import numpy as np

from lvba.simulate.texture import Texture


def octaves_product(texture: Texture, quad: int, u: float, v: float, foot: float) -> np.ndarray:
    """(3,): the product of all octaves at one place."""
    product = np.ones(3)
    size = len(texture.tile)
    for (wavelength, amplitude, cosine, sine, texels), phase in zip(texture.octaves, texture.phases[quad]):
        fade = np.clip(wavelength / (1.5 * foot) - 1, 0, 1)
        x = (cosine * u - sine * v) * texels + phase[0]
        y = (sine * u + cosine * v) * texels + phase[1]
        i, j = int(np.floor(x)), int(np.floor(y))
        a, b = x - i, y - j
        corners = [[texture.tile[(j + dj) % size, (i + di) % size, :3] for di in (0, 1)] for dj in (0, 1)]
        noise = (corners[0][0] * (1 - a) + corners[0][1] * a) * (1 - b)
        noise = noise + (corners[1][0] * (1 - a) + corners[1][1] * a) * b
        product = product * (1 + texture.style[quad, 3] * amplitude * fade * noise)
    return product


def render(
    texture: Texture, scene_from_camera: np.ndarray, rays: np.ndarray, quads: np.ndarray, width: float
) -> np.ndarray:
    """(H, W, 3): the image of a world without flat patches; every octave at every tap of every ray."""
    image = np.zeros((*quads.shape[:2], 3))
    for row, column, sample in np.ndindex(quads.shape):
        quad = quads[row, column, sample]
        ray = scene_from_camera[:3, :3] @ rays[row, column, sample]
        image[row, column] += 0.25 * _seen(texture, scene_from_camera[:3, 3], ray, quad, width)
    return image


def _seen(texture: Texture, center: np.ndarray, ray: np.ndarray, quad: int, width: float) -> np.ndarray:
    if quad < 0:
        return texture.sky
    origin, along_u, along_v, normal = texture.frames[quad]
    depth = ((origin - center) @ normal) / (ray @ normal)
    met = center + depth * ray - origin
    stretch = np.linalg.norm(ray) / abs(ray @ normal)
    taps = min(4, int(np.ceil(stretch / 1.6)))
    step = depth * width * stretch / taps
    slant = ray - (ray @ normal) * normal
    slant = slant / np.linalg.norm(slant)
    total = np.zeros(3)
    for tap in range(taps):
        at = met + (tap - (taps - 1) / 2) * step * slant
        foot = max(depth * width, step)
        total += octaves_product(texture, quad, at @ along_u, at @ along_v, foot) / taps
    return texture.style[quad, :3] * total
