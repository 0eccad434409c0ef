"""Angles at which the beams of one scan meet surfaces, by the planes about its points.

Few near points are not enough: where points are closer to each other than their noise, a plane through them is turned
towards the beam or away from it at random (surfaces 1 m away seemed to be met at 37 degrees instead of straight on). Many
are too many at edges, and where surfaces are small. So each place takes the flattest of several neighborhoods, each twice
as large as the one before; and each point, the nearest place that is on a plane. How flat one is counts along the beam,
as the noise does: points of one ring of a sensor that turns lie on a plane through the sensor, whatever they are on.
"""

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Vector
from lvba.kernels import flatness as kernels

_NEIGHBORS = 20
_STEPS = (2, 4, 8, 16, 32, 64)
"""A neighborhood has _NEIGHBORS of every n-th point."""
_PLANAR = 0.1
"""The most that points of a plane are off it along the beam, as part of the lesser spread along it, in squares."""
_PLACES, _POINTS_OF_PLACE = 4096, 8
"""Planes are looked for at so many points of a scan, or at one of so many. At all of them, angles differ less from those
than these do from such as other draws of every n-th point give."""


def cosines(points: np.ndarray, position: Vector) -> np.ndarray:
    """(N,) float64, 0 to 1: cosines of the angles of incidence; 1 where there is no plane.

    points: (N, 3) float32, m; position: (3,) float64, m, of the sensor, both in the scan frame
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    cosine = np.ones(len(points))
    if len(finite) < 2 * _STEPS[0] * _NEIGHBORS:
        return cosine
    here = np.asarray(points, float)[finite]
    # in order, every n-th would be of one ring of a sensor that turns
    drawn = here[np.random.default_rng(0).permutation(len(here))]
    places = drawn[: max(_PLACES, len(drawn) // _POINTS_OF_PLACE)]
    normal, flatness = _flattest(drawn, places, _beams(places, position))
    planar = flatness < _PLANAR
    if not planar.any():
        return cosine
    nearest = cKDTree(places[planar]).query(here)[1]
    cosine[finite] = np.abs(np.einsum("ni,ni->n", normal[planar][nearest], _beams(here, position)))
    return cosine


def _beams(points: np.ndarray, position: Vector) -> np.ndarray:
    """(N, 3): unit vectors from the sensor to points (N, 3)."""
    beam = points - position
    return np.asarray(beam / np.maximum(np.linalg.norm(beam, axis=1), 1e-9)[:, None])


def _flattest(drawn: np.ndarray, places: np.ndarray, beam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (M, 3) of the flattest neighborhoods of places (M, 3), and how flat these are, (M,), 0: a plane.

    drawn: (N, 3), points in no order; beam: (M, 3), unit
    """
    normal, flatness = np.zeros((len(places), 3)), np.full(len(places), np.inf)
    for step in _STEPS:
        some = drawn[::step]
        if len(some) < 2 * _NEIGHBORS:
            break
        near = cKDTree(some).query(places, k=_NEIGHBORS)[1]
        kernels.flattest(some, near, beam, normal, flatness)
    return normal, flatness
