"""Angles at which the beams of one scan meet surfaces, by the planes about its points.

Few near points are not enough: where points are closer to each other than their noise, a plane through them is turned
towards the beam or away from it at random (surfaces 1 m away seemed to be met at 37 degrees instead of straight on). Many
are too many at edges, and where surfaces are small or far away: of a projection 1 m wide, 30 m down a street, a scan has
ten. So each place takes the flattest of several neighborhoods, each twice
as large as the one before; and each point, the nearest place that is on a plane. How flat one is counts along the beam,
as the noise does: points of one ring of a sensor that turns lie on a plane through the sensor, whatever they are on.
"""

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Vector
from lvba.kernels import flatness as kernels

_NEIGHBORS = 20
_STEPS = (1, 2, 4, 8, 16, 32, 64)
"""A neighborhood has _NEIGHBORS of every n-th point."""
_FEW = (8, 12)
"""Of all points, neighborhoods of so many are tried as well."""
_PLANAR = 0.12
"""The most that points of a plane are off it along the beam, as part of the lesser spread along it, in squares."""
_FEWEST = 80
"""Points of a scan without which no surface is looked for."""
_PLACES = 0.125
"""Planes are looked for at this part of the points, or more: of those that are as far away as half of them, and further
away of more, as there are fewer on each surface."""


def cosines(points: np.ndarray, position: Vector) -> np.ndarray:
    """(N,) float64, 0 to 1: cosines of the angles of incidence; 1 where there is no plane.

    points: (N, 3) float32, m; position: (3,) float64, m, of the sensor, both in the scan frame
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    cosine = np.ones(len(points))
    if len(finite) < _FEWEST:
        return cosine
    here = np.asarray(points, float)[finite]
    # in order, every n-th would be of one ring of a sensor that turns
    drawn = here[np.random.default_rng(0).permutation(len(here))]
    places = _places(drawn, position)
    normal, flatness = _flattest(drawn, places, _beams(places, position))
    planar = flatness < _PLANAR
    if not planar.any():
        return cosine
    nearest = cKDTree(places[planar]).query(here)[1]
    cosine[finite] = np.abs(np.einsum("ni,ni->n", normal[planar][nearest], _beams(here, position)))
    return cosine


def _places(drawn: np.ndarray, position: Vector) -> np.ndarray:
    """(M, 3): those of the points (N, 3) about which planes are looked for."""
    square = np.square(drawn - position).sum(axis=1)
    part = np.clip(_PLACES * square / max(float(np.median(square)), 1e-9), _PLACES, 1.0)
    count = np.cumsum(part)
    return np.asarray(drawn[np.floor(count) > np.floor(count - part)])


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
        for count in (*(_FEW if step == 1 else ()), _NEIGHBORS):
            kernels.flattest(some, np.ascontiguousarray(near[:, :count]), beam, normal, flatness)
    return normal, flatness
