"""How far the solved cameras may be off, and along which directions nothing holds them.

The inverse Hessian alone promises far too much: errors of planes and of interpolation are shared by all pixels of a
patch and by all patches of a plane. Here the pixels' information is replaced by the sandwich `H^-1 M H^-1` of a
composite likelihood (White 1982; Varin et al. 2011), where M sums the outer products of the gradients per cluster,
and a cluster is all that hangs on one piece of wall.
"""

import numpy as np
from scipy.sparse import csr_matrix

from lvba import geometry, solver
from lvba.solver import NormalEquations
from lvba.trajectory import Trajectory
from lvba.visual.photometric import Linearization, Problem
from lvba.visual.scene_points import ScenePoints

_GREATEST_LEVERAGE = 0.8
_CLUSTER_M = 1.0
"""Planes that face the same way within cells of this size share their errors (a bulge, the poses of their scans)."""
_MAP_SCANS = 11
"""So many scans about an image make the part of the map that it is held by."""


def cluster_gradients(
    problem: Problem, linearization: Linearization, *, jackknife: bool = False
) -> csr_matrix:
    """Gradients of the photometric cost summed per piece of wall, (clusters, 7 I) sparse.

    jackknife: each divided by 1 - leverage, the wall's share of what its image knows. A wall that alone holds an
        image bends it to itself and leaves no gradient, however wrong it is (MacKinnon and White 1985, HC3).
    """
    points, observations = problem.points, problem.observations
    cluster = _walls(points)[observations.point]
    images = np.stack([points.reference[observations.point], observations.target], axis=1)
    gradients = linearization.single[:, :14]
    if jackknife:
        gradients = gradients * np.repeat(_jackknife(problem, linearization, cluster, images), 7, axis=1)
    columns = (7 * images[:, :, None] + np.arange(7)).reshape(len(gradients), 14)
    shape = (int(cluster.max(initial=-1)) + 1, 7 * len(problem.images))
    rows = np.repeat(cluster, 14)
    return csr_matrix((gradients.ravel(), (rows, columns.ravel())), shape=shape)


def _walls(points: ScenePoints) -> np.ndarray:
    """(P,) which piece of wall each point lies on: cell and side that the normal faces."""
    axis = np.abs(points.normal_world).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(points.normal_world, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.floor(points.position_world / _CLUSTER_M).astype(np.int64)
    return np.unique(np.column_stack([cell, side]), axis=0, return_inverse=True)[1].reshape(-1)


def _jackknife(
    problem: Problem, linearization: Linearization, cluster: np.ndarray, images: np.ndarray
) -> np.ndarray:
    """(O, 2): 1 / (1 - leverage) of each observation's plane in its reference and in its target."""
    known = linearization.sums[:, 0] + linearization.sums[:, 2]
    if problem.offset_sigma is not None:
        # what an uncertain plane tells is bounded, however much texture is on it
        points = problem.observations.point
        known = known / (linearization.offset_hessian * problem.offset_sigma**2)[points]
    count = len(problem.images)
    keys = cluster[:, None] * np.int64(count) + images
    share, where = np.unique(keys, return_inverse=True)
    of_plane = np.bincount(where.ravel(), np.repeat(known, 2), len(share))
    of_image = np.bincount((share % count).astype(np.int64), of_plane, count)
    leverage = of_plane / np.maximum(of_image[share % count], 1e-300)
    return np.asarray(1 / (1 - np.minimum(leverage, _GREATEST_LEVERAGE)))[where].reshape(images.shape)


def offset_scale(problem: Problem, offset: np.ndarray, hessian: np.ndarray) -> float:
    """By what factor the plane offsets scatter more than expected (variance component, robust), 0.3 to 10.

    offset: (P,) m, solved; hessian: (P,) their information with the prior's. Points whose offset only the prior
    decides have no vote.
    """
    assert problem.offset_sigma is not None
    precision = 1 / problem.offset_sigma**2
    redundancy = np.clip(1 - precision / hessian, 0, 1)
    normalized = np.square(offset) * precision / np.maximum(redundancy, 1e-6)
    voting = redundancy > 0.3
    if voting.sum() < 30:
        return 1.0
    # the median of a chi-square of one degree of freedom is 0.4549
    return float(np.clip(np.sqrt(np.median(normalized[voting]) / 0.4549), 0.3, 10.0))


def inflation(equations: NormalEquations, clusters: csr_matrix) -> float:
    """How many times the Hessian overstates the information: the median over images of tr(H_ii^-1 M_ii) / 6."""
    own = equations.rows == equations.columns
    ratios = []
    for image, block in zip(equations.rows[own], equations.blocks[own], strict=True):
        pose = block[:6, :6]
        gradient = clusters[:, 7 * image : 7 * image + 6].toarray() if clusters.shape[0] else np.zeros((0, 6))
        scale = np.sqrt(np.maximum(np.diag(pose), 1e-30))
        pose, gradient = pose / np.outer(scale, scale), gradient / scale
        values, vectors = np.linalg.eigh(pose)
        good = values > 1e-6
        if good.sum() < 6:
            continue
        rotated = gradient @ vectors
        ratios.append(float((np.square(rotated).sum(axis=0) / values).mean()))
    return float(np.clip(np.median(ratios), 0.1, 100.0)) if ratios else 1.0


def camera_covariance(
    total: NormalEquations,
    clusters: csr_matrix,
    prior_hessian: NormalEquations | None,
    free: np.ndarray,
) -> np.ndarray:
    """The sandwich covariance of the free unknowns as (I + 1, 7, 7) diagonal blocks; the last block is the mount.

    total: photometric equations plus prior, over I + 1 blocks; clusters: (clusters, 7 I)
    prior_hessian: the prior's share, which is its own M (its sigmas were estimated); None: no prior
    """
    index = np.flatnonzero(free)
    inverse = solver.inverse_columns(total, index, 10**9)(np.arange(index.size))
    scaled = clusters[:, index[index < clusters.shape[1]]]
    spread = inverse[:, : scaled.shape[1]] @ scaled.T
    count = len(total.gradient)
    blocks = np.zeros((count, 7, 7))
    middle = (
        None if prior_hessian is None else inverse @ prior_hessian.dense()[np.ix_(index, index)] @ inverse
    )
    starts = np.searchsorted(index, np.arange(count + 1) * 7)
    for block in range(count):
        mine = slice(starts[block], starts[block + 1])
        local = index[mine] - 7 * block
        value = spread[mine] @ spread[mine].T
        blocks[block][np.ix_(local, local)] = value if middle is None else value + middle[mine, mine]
    return blocks


def of_map(
    world_from_camera: np.ndarray,
    times: np.ndarray,
    scans: Trajectory,
    scan_covariance: np.ndarray,
) -> np.ndarray:
    """(I, 6, 6): how far the map about each camera may be off, in the camera's tangent `[rotation | translation]`.

    No residual shows it: planes and cameras move together with the scans that made the planes. Scans about a camera
    are off together, so it is their mean information that counts, not the sum.

    scans: refined; scan_covariance: (S, 6, 6) of their poses
    """
    middle = np.searchsorted(scans.times, times)
    count = min(_MAP_SCANS, len(scans))
    first = np.clip(middle - count // 2, 0, len(scans) - count)
    near = first[:, None] + np.arange(count)
    camera_from_scan = geometry.inverse(world_from_camera)[:, None] @ scans.world_from_sensor[near]
    carry = geometry.adjoint(camera_from_scan)
    spread = carry @ scan_covariance[near] @ np.swapaxes(carry, -1, -2)
    return np.asarray(np.linalg.inv(np.linalg.inv(spread).mean(axis=1)))
