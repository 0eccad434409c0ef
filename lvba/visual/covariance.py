"""How far the solved cameras may be off, and along which directions nothing holds them.

The inverse Hessian alone predicts errors that are far too small: all pixels of a patch and all patches of a plane
share errors of planes and of interpolation. Here the pixels' information is replaced by the sandwich `H^-1 M H^-1` of a
composite likelihood (White 1982; Varin et al. 2011; `optim.linear_solver.sandwich`), where M sums the outer products of
the gradients per cluster, and a cluster is all that hangs on one piece of wall.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags, hstack

from lvba import distinct_rows, geometry
from lvba.arrays import Indices, PoseBlocks, Poses, Times
from lvba.kernels import plane_offsets as offset_kernels
from lvba.optim.normal_equations import NormalEquations
from lvba.trajectory import Trajectory
from lvba.visual import photometric
from lvba.visual.photometric import Linearization, PhotometricState, Problem
from lvba.visual.scene_points import ScenePoints

_FEWEST_VOTES = 10
"""Planes from which on their offsets are judged."""
_GREATEST_LEVERAGE = 0.96
_CLUSTER_M = 1.0
"""Planes that face the same way within cells of this size share their errors (a bulge, the poses of their scans)."""
_MAP_SCANS = 11
"""So many scans about an image make the part of the map that it is held by."""


@dataclass(frozen=True)
class WallClusters:
    """Clusters of observations: one for each piece of wall and each image that sees it.

    wall, image: (S,) int64, of each cluster
    of: (O, 2) int64, the cluster of each observation with its reference, and with its target
    """

    wall: np.ndarray
    image: np.ndarray
    of: np.ndarray


def find_wall_clusters(problem: Problem) -> WallClusters:
    """Which pieces of wall are seen in which images: the same for all states of a problem."""
    points, observations = problem.points, problem.observations
    images = np.stack([points.reference[observations.point], observations.target], axis=1)
    keys = _walls(points)[observations.point][:, None].astype(np.int64) * len(problem.images) + images
    unique, where = np.unique(keys, return_inverse=True)
    return WallClusters(*np.divmod(unique, len(problem.images)), where.reshape(keys.shape))


def cluster_gradients(problem: Problem, linearization: Linearization, walls: WallClusters) -> csr_matrix:
    """Gradients of the photometric cost by the images summed per piece of wall, (clusters, 7 I) sparse."""
    return _by_wall(walls, _summed(walls, linearization), len(problem.images))


@dataclass(frozen=True)
class WallGradients:
    """Gradients of the photometric cost per cluster, as they are and as they would be had no image been fitted to them.

    own, reduced: (S, 7) float64, by the unknowns of the cluster's image; reduced: by its pose bias-reduced
    of_images: (I, 6, 6) float64, all that is known of each image's pose when the other images stay
    by_shared: (walls, c) float64, by the shared parameters that move patches; columns: (c,) int64, which they are
    """

    walls: WallClusters
    own: np.ndarray
    reduced: np.ndarray
    of_images: np.ndarray
    by_shared: np.ndarray
    columns: np.ndarray


def wall_gradients(
    problem: Problem,
    linearization: Linearization,
    state: PhotometricState,
    walls: WallClusters,
    known: NormalEquations,
) -> WallGradients:
    """The gradients at a state.

    A wall that holds an image in some direction bends it to itself there and leaves little gradient, however wrong it
    is (bias reduced linearization, CR2: Bell and McCaffrey 2002; leaving each wall out altogether, CR3, predicts errors
    twice as large as they are where few walls are seen). known: all that is known of the images
    """
    own = _summed(walls, linearization)
    blocks = information(problem, linearization, state, walls)
    reduced = own.copy()
    reduced[:, :6] = bias_reduced(blocks, own[:, :6], walls.image, known)
    by_shared, columns = _by_shared(walls, linearization)
    return WallGradients(
        walls=walls,
        own=own,
        reduced=reduced,
        of_images=_known_of_images(known),
        by_shared=by_shared,
        columns=columns,
    )


def bias_reduced_gradients(gradients: WallGradients, shared: int) -> csr_matrix:
    """Gradients summed per piece of wall, each as large as it would be had the image not been fitted to it;
    (clusters, 7 I + k) sparse.

    The last k columns are the gradients by the shared parameters, as they are. shared: how many these are, k
    """
    return _with_shared(gradients, gradients.reduced, shared)


def balanced_gradients(gradients: WallGradients, shared: int) -> csr_matrix:
    """The same, each wall's gradient as large as bias reduction makes it on average over its images.

    A pair of patches pulls two images against each other: moved together, with what they share, they feel nothing of it.
    Gradients that grow by other parts in each image no longer cancel, and a few walls that all images see predict errors
    of all cameras together that no wall can make: of a Kinect 37 mm and 2.6 degrees, where cameras are 10 mm and 0.6
    degrees off.
    """
    walls = gradients.walls
    # an image without any cluster may be undetermined
    unique, where = np.unique(walls.image, return_inverse=True)
    inverse = np.linalg.inv(gradients.of_images[unique])[where]
    before, after = (
        np.bincount(walls.wall, np.einsum("si,sij,sj->s", each[:, :6], inverse, each[:, :6]))
        for each in (gradients.own, gradients.reduced)
    )
    grown = np.sqrt(np.maximum(after, before) / np.maximum(before, 1e-300))
    return (diags(grown) @ _with_shared(gradients, gradients.own, shared)).tocsr()


def _by_shared(walls: WallClusters, linearization: Linearization) -> tuple[np.ndarray, np.ndarray]:
    """Gradients by the shared parameters that move patches, summed per piece of wall, (walls, c), and which these are."""
    shared = linearization.shared
    if shared is None:
        return np.zeros((_count(walls), 0)), np.zeros(0, np.int64)
    sums = np.zeros((_count(walls), len(shared.columns), 1))
    offset_kernels.add_blocks(
        sums, walls.wall[walls.of[:, 0]], np.ascontiguousarray(shared.single[:, :, None])
    )
    return sums[..., 0], np.asarray(shared.columns)


def _with_shared(gradients: WallGradients, by_image: np.ndarray, shared: int) -> csr_matrix:
    """Gradients by the images, (clusters, 7 I), and those by the shared parameters beside them."""
    images = _by_wall(gradients.walls, by_image, len(gradients.of_images))
    by_shared = np.zeros((images.shape[0], shared))
    by_shared[:, gradients.columns] = gradients.by_shared
    return hstack([images, csr_matrix(by_shared)]).tocsr()


def _count(walls: WallClusters) -> int:
    """How many pieces of wall there are."""
    return int(walls.wall.max(initial=-1)) + 1


def _known_of_images(known: NormalEquations) -> np.ndarray:
    """(I, 6, 6): all that is known of each image's pose when the other images stay."""
    # a part more on the diagonal: without a prior, some motion of an image may be free
    return known.diagonal_blocks()[:, :6, :6] * (1 + 1e-9 * np.eye(6))


def _summed(walls: WallClusters, linearization: Linearization) -> np.ndarray:
    """(S, 7): the gradient of each cluster's cost by its image's unknowns."""
    sums = np.zeros((len(walls.wall), 7, 1))
    for end in range(2):
        own = np.ascontiguousarray(linearization.single[:, 7 * end : 7 * end + 7, None])
        offset_kernels.add_blocks(sums, np.ascontiguousarray(walls.of[:, end]), own)
    return sums[..., 0]


def _by_wall(walls: WallClusters, gradients: np.ndarray, images: int) -> csr_matrix:
    columns = 7 * walls.image[:, None] + np.arange(7)
    shape = (_count(walls), 7 * images)
    return csr_matrix((gradients.ravel(), (np.repeat(walls.wall, 7), columns.ravel())), shape=shape)


def _walls(points: ScenePoints) -> np.ndarray:
    """(P,) which piece of wall each point lies on: cell and side that the normal faces."""
    axis = np.abs(points.normal_world).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(points.normal_world, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.floor(points.position_world / _CLUSTER_M).astype(np.int64)
    return distinct_rows.number(np.column_stack([cell, side]))


def information(
    problem: Problem, linearization: Linearization, state: PhotometricState, walls: WallClusters
) -> np.ndarray:
    """(S, 6, 6): what each cluster tells of its image's pose, the plane offsets eliminated."""
    blocks = photometric.shared_information(problem, state, linearization.sums, walls.of, len(walls.wall))
    if problem.offset_sigma is None:
        return blocks
    point, points = problem.observations.point, len(problem.points)
    as_reference = np.zeros(points, np.int64)
    as_reference[point] = walls.of[:, 0]
    at = np.concatenate([as_reference, walls.of[:, 1]])
    hessian = linearization.offset_hessian[np.concatenate([np.arange(points), point])]
    entry = linearization.entry[:, :6] / np.sqrt(hessian)[:, None]
    offset_kernels.take_squares(blocks, at, entry)
    return blocks


def bias_reduced(
    information: PoseBlocks, gradients: np.ndarray, image: Indices, known: NormalEquations
) -> np.ndarray:
    """(S, 6): `(1 - I H^-1)^(-1/2) g`, H (6, 6) all that is known of the cluster's image when the other images stay.

    information: (S, 6, 6), I; gradients: (S, 6) float64, g; image: (S,)
    """
    blocks = _known_of_images(known)
    # factored and inverted once for each image, which has hundreds of clusters; one without any may be undetermined
    unique, where = np.unique(image, return_inverse=True)
    lower = np.linalg.cholesky(blocks[unique])
    whitening, lower = np.linalg.inv(lower)[where], lower[where]
    leverage, axes = np.linalg.eigh(whitening @ information @ np.swapaxes(whitening, -1, -2))
    along = (gradients[:, None] @ np.swapaxes(whitening, -1, -2) @ axes)[:, 0]
    along /= np.sqrt(1 - np.clip(leverage, 0.0, _GREATEST_LEVERAGE))
    return np.asarray((lower @ (axes @ along[..., None]))[..., 0])


def offset_scale(problem: Problem, offset: np.ndarray, hessian: np.ndarray) -> float:
    """By what factor planes are off more than expected (variance component, robust), 0.3 to 10.

    A plane has one vote, by what the images of all its points say of its offset: the points of a large plane agree, and
    are no evidence that small ones are as well known.
    offset: (P,) float64 m, solved; hessian: (P,) float64 their information with the prior's
    """
    assert problem.offset_sigma is not None
    _, plane, count = np.unique(problem.points.plane, return_inverse=True, return_counts=True)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(plane, values)

    variance, uneven = problem.offset_sigma**2, problem.points.unevenness**2
    seen = np.maximum(hessian - 1 / variance, 0.0)
    information = np.maximum(total(seen), 1e-30)
    # the prior draws each offset to zero by seen / hessian
    own = total(offset * hessian) / information
    expected = total(variance - uneven) / count**2
    other = 1 / information + total(uneven) / count**2
    voting = expected > other
    if voting.sum() < _FEWEST_VOTES:
        return 1.0
    # the median of a chi-square of one degree of freedom is 0.4549
    normalized = own[voting] ** 2 / (expected + other)[voting]
    return float(np.clip(np.sqrt(np.median(normalized) / 0.4549), 0.3, 10.0))


def variance_factor(equations: NormalEquations, clusters: csr_matrix) -> float:
    """Actual over modeled variance of the gradient (`dispersion`), 0.1 to 100: a factor of what was supposed before."""
    return float(np.clip(dispersion(equations, clusters), 0.1, 100.0))


def dispersion(equations: NormalEquations, clusters: csr_matrix) -> float:
    """The median over images of tr(H_ii^-1 M_ii) / 6; 1 where no image is determined."""
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
    return float(np.median(ratios)) if ratios else 1.0


def of_map(
    world_from_camera: Poses,
    times: Times,
    scans: Trajectory,
    scan_covariance: PoseBlocks,
) -> np.ndarray:
    """(I, 6, 6): how far the map about each camera may be off, in the camera's tangent `[rotation | translation]`.

    No residual shows it: planes and cameras move together with the scans that made the planes. Scans about a camera
    are off together, so it is their mean information that counts, not the sum. A few of them, from outside a group that
    came off, know its place by no means as well as their own: where most are less certain, so is the map.

    scans: refined; scan_covariance: (S, 6, 6) of their poses
    """
    middle = np.searchsorted(scans.times, times)
    count = min(_MAP_SCANS, len(scans))
    first = np.clip(middle - count // 2, 0, len(scans) - count)
    near = first[:, None] + np.arange(count)
    camera_from_scan = geometry.inverse(world_from_camera)[:, None] @ scans.world_from_sensor[near]
    carry = geometry.adjoint(camera_from_scan)
    spread = carry @ scan_covariance[near] @ np.swapaxes(carry, -1, -2)
    root = np.linalg.cholesky(np.linalg.inv(spread).mean(axis=1))
    each = np.swapaxes(root, 1, 2)[:, None] @ spread @ root[:, None]
    axes = np.linalg.eigh(each.mean(axis=1))[1]
    along = np.einsum("iak,inab,ibk->ink", axes, each, axes)
    back = np.swapaxes(np.linalg.inv(root), 1, 2) @ axes
    return np.asarray((back * np.maximum(np.median(along, axis=1), 1.0)[:, None]) @ np.swapaxes(back, -1, -2))
