"""Angles at which the beams of one scan meet surfaces, by the planes about its points.

Few near points are not enough: where points are closer to each other than their noise, a plane through them is turned
towards the beam or away from it at random (surfaces 1 m away seemed to be met at 37 degrees instead of straight on). Many
are too many at edges, and where surfaces are small. So each point takes the flattest of several neighborhoods, each twice
as large as the one before. How flat one is counts along the beam, as the noise does: points of one ring of a sensor that
turns lie on a plane through the sensor, whatever they are on.
"""

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Vector

_NEIGHBORS = 20
_STEPS = (2, 4, 8, 16, 32, 64)
"""A neighborhood has _NEIGHBORS of every n-th point."""
_PLANAR = 0.1
"""The most that points of a plane are off it along the beam, as part of the lesser spread along it, in squares."""


def cosines(points: np.ndarray, position: Vector) -> np.ndarray:
    """(N,) float64, 0 to 1: cosines of the angles of incidence; 1 where there is no plane.

    Where a point's neighbors are on no plane, it is on that of the nearest ones that are.
    points: (N, 3) float32, m; position: (3,) float64, m, of the sensor, both in the scan frame
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    cosine = np.ones(len(points))
    if len(finite) < 2 * _STEPS[0] * _NEIGHBORS:
        return cosine
    here = np.asarray(points, float)[finite]
    beam = here - position
    beam /= np.maximum(np.linalg.norm(beam, axis=1), 1e-9)[:, None]
    normal, flatness = _flattest(here, beam)
    planar = flatness < _PLANAR
    if not planar.any():
        return cosine
    nearest = cKDTree(here[planar]).query(here)[1]
    cosine[finite] = np.abs(np.einsum("ni,ni->n", normal[planar][nearest], beam))
    return cosine


def _flattest(points: np.ndarray, beam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (N, 3) of the flattest neighborhoods of points (N, 3), and how flat these are, (N,), 0: a plane.

    beam: (N, 3), unit
    """
    count = len(points)
    # in order, every n-th would be of one ring of a sensor that turns
    order = np.random.default_rng(0).permutation(count)
    normal, flatness = np.zeros((count, 3)), np.full(count, np.inf)
    for step in _STEPS:
        some = points[order[::step]]
        if len(some) < 2 * _NEIGHBORS:
            break
        tree = cKDTree(some)
        near = some[tree.query(some, k=_NEIGHBORS)[1]]
        near = near - near.mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
        nearest = tree.query(points)[1]
        own = np.einsum("ni,ni->n", axes[nearest, :, 0], beam)
        flat = (spread[:, 0] / np.maximum(spread[:, 1], 1e-12))[nearest] / np.maximum(own**2, 1e-6)
        better = flat < flatness
        flatness[better], normal[better] = flat[better], axes[nearest[better], :, 0]
    return normal, flatness
