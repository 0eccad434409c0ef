"""How far the solved cameras may be off, and along which directions nothing holds them.

The inverse Hessian alone promises far too much: errors of planes and of interpolation are shared by all pixels of a
patch and by all patches of a plane. Here the pixels' information is replaced by the sandwich `H^-1 M H^-1` of a
composite likelihood (White 1982; Varin et al. 2011), where M sums the outer products of the gradients per cluster,
and a cluster is all that hangs on one piece of wall.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from lvba import geometry
from lvba.kernels import plane_offsets as offset_kernels
from lvba.optim import linear_solver
from lvba.optim.normal_equations import NormalEquations
from lvba.trajectory import Trajectory
from lvba.visual import photometric
from lvba.visual.photometric import Linearization, PhotometricState, Problem
from lvba.visual.scene_points import ScenePoints

_GREATEST_LEVERAGE = 0.96
_CLUSTER_M = 1.0
"""Planes that face the same way within cells of this size share their errors (a bulge, the poses of their scans)."""
_MAP_SCANS = 11
"""So many scans about an image make the part of the map that it is held by."""


@dataclass(frozen=True)
class Shares:
    """What pieces of wall have to do with images.

    wall, image: (S,) int64; of: (O, 2) int64, the share of each observation with its reference, and with its target
    """

    wall: np.ndarray
    image: np.ndarray
    of: np.ndarray


def shares_of(problem: Problem) -> Shares:
    """Which pieces of wall are seen in which images: the same for all states of a problem."""
    points, observations = problem.points, problem.observations
    images = np.stack([points.reference[observations.point], observations.target], axis=1)
    keys = _walls(points)[observations.point][:, None].astype(np.int64) * len(problem.images) + images
    found, where = np.unique(keys, return_inverse=True)
    return Shares(*np.divmod(found, len(problem.images)), where.reshape(keys.shape))


def cluster_gradients(problem: Problem, linearization: Linearization, shares: Shares) -> csr_matrix:
    """Gradients of the photometric cost summed per piece of wall, (clusters, 7 I) sparse."""
    return _by_wall(shares, _summed(shares, linearization), len(problem.images))


def bias_reduced_gradients(
    problem: Problem,
    linearization: Linearization,
    state: PhotometricState,
    shares: Shares,
    known: NormalEquations,
) -> csr_matrix:
    """The same, each as large as it would be had the image not been fitted to it.

    A wall that holds an image in some direction bends it to itself there and leaves little gradient, however wrong it
    is (bias reduced linearization, CR2: Bell and McCaffrey 2002; leaving each wall out altogether, CR3, promises errors
    twice as large as they are where few walls are seen). known: all that is known, the images' blocks first
    """
    gradients = _summed(shares, linearization)
    told = information(problem, linearization, state, shares)
    gradients[:, :6] = bias_reduced(told, gradients[:, :6], shares.image, known)
    return _by_wall(shares, gradients, len(problem.images))


def _summed(shares: Shares, linearization: Linearization) -> np.ndarray:
    """(S, 7): the gradient of each share's cost by its image's unknowns."""
    sums = np.zeros((len(shares.wall), 7, 1))
    for end in range(2):
        own = np.ascontiguousarray(linearization.single[:, 7 * end : 7 * end + 7, None])
        offset_kernels.add_blocks(sums, np.ascontiguousarray(shares.of[:, end]), own)
    return sums[..., 0]


def _by_wall(shares: Shares, gradients: np.ndarray, images: int) -> csr_matrix:
    columns = 7 * shares.image[:, None] + np.arange(7)
    shape = (int(shares.wall.max(initial=-1)) + 1, 7 * images)
    return csr_matrix((gradients.ravel(), (np.repeat(shares.wall, 7), columns.ravel())), shape=shape)


def _walls(points: ScenePoints) -> np.ndarray:
    """(P,) which piece of wall each point lies on: cell and side that the normal faces."""
    axis = np.abs(points.normal_world).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(points.normal_world, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.floor(points.position_world / _CLUSTER_M).astype(np.int64)
    return np.unique(np.column_stack([cell, side]), axis=0, return_inverse=True)[1].reshape(-1)


def information(
    problem: Problem, linearization: Linearization, state: PhotometricState, shares: Shares
) -> np.ndarray:
    """(S, 6, 6): what each share tells of its image's pose, the plane offsets eliminated."""
    found = photometric.shared_information(problem, state, linearization.sums, shares.of, len(shares.wall))
    if problem.offset_sigma is None:
        return found
    point, points = problem.observations.point, len(problem.points)
    as_reference = np.zeros(points, np.int64)
    as_reference[point] = shares.of[:, 0]
    at = np.concatenate([as_reference, shares.of[:, 1]])
    hessian = linearization.offset_hessian[np.concatenate([np.arange(points), point])]
    entry = linearization.entry[:, :6] / np.sqrt(hessian)[:, None]
    offset_kernels.take_squares(found, at, entry)
    return found


def bias_reduced(
    told: np.ndarray, gradients: np.ndarray, image: np.ndarray, known: NormalEquations
) -> np.ndarray:
    """(S, 6): `(1 - I H^-1)^(-1/2) g`, H (6, 6) all that is known of the share's image when the other images stay.

    told: (S, 6, 6), I; gradients: (S, 6), g; image: (S,)
    """
    diagonal = known.rows == known.columns
    blocks = np.zeros((len(known.gradient), 6, 6))
    blocks[known.rows[diagonal]] = known.blocks[diagonal][:, :6, :6]
    # a part more on the diagonal: without a prior, some motion of an image may be free
    blocks *= 1 + 1e-9 * np.eye(6)
    # factored and inverted once for each image, which has hundreds of shares; one without any may be held by nothing
    found, where = np.unique(image, return_inverse=True)
    lower = np.linalg.cholesky(blocks[found])
    whitening, lower = np.linalg.inv(lower)[where], lower[where]
    leverage, axes = np.linalg.eigh(whitening @ told @ np.swapaxes(whitening, -1, -2))
    along = (gradients[:, None] @ np.swapaxes(whitening, -1, -2) @ axes)[:, 0]
    along /= np.sqrt(1 - np.clip(leverage, 0.0, _GREATEST_LEVERAGE))
    return np.asarray((lower @ (axes @ along[..., None]))[..., 0])


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
    columns, ratios = clusters.tocsc(), []
    for image, block in zip(equations.rows[own], equations.blocks[own], strict=True):
        pose = block[:6, :6]
        gradient = columns[:, 7 * image : 7 * image + 6].toarray()
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
    prior_spread: NormalEquations | None,
    free: np.ndarray,
) -> np.ndarray:
    """The sandwich covariance of the free unknowns as (I + 1, 7, 7) diagonal blocks; the last block is the mount.

    total: photometric equations plus prior, over I + 1 blocks; clusters: (clusters, 7 I)
    prior_spread: M of the prior's share (`trajectory_prior.spread`): its Hessian, as its sigmas were estimated; None: no
        prior
    """
    index = np.flatnonzero(free)
    inverse = linear_solver.inverse_columns(total, index, 10**9)(np.arange(index.size))
    scaled = clusters[:, index[index < clusters.shape[1]]]
    spread = inverse[:, : scaled.shape[1]] @ scaled.T
    count = len(total.gradient)
    blocks = np.zeros((count, 7, 7))
    middle = None if prior_spread is None else inverse @ prior_spread.dense()[np.ix_(index, index)] @ inverse
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
