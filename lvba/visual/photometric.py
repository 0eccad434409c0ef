"""The photometric cost of plane patches seen in two images, its normal equations and its noise."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import photometric as kernels
from lvba.kernels import photometric_moving as moving_kernels
from lvba.kernels import plane_offsets as offset_kernels
from lvba.optim import normal_equations
from lvba.optim.normal_equations import NormalEquations
from lvba.visual.image import DARK, SATURATED
from lvba.visual.scene_points import SCENE_POINTS, Observations, ScenePoints
from lvba.visual.states import CameraStates

COST, COUNT, SQUARE, WEIGHTS = 9, 10, 11, 12
"""Columns of the sums of an observation."""


HUBER = 2.0
"""Residuals beyond this many standard deviations count linearly: 5 % of good ones do."""
LEAST_INTENSITY, GREATEST_INTENSITY = float(DARK), float(SATURATED)
"""Darker pixels are left out, and brighter ones as saturated."""
NOISE_GROWTH = 0.0
"""Noise variance grows as 1 + NOISE_GROWTH * intensity: constant, for sigma is estimated patch by patch."""


def homography(
    world_from_reference: np.ndarray,
    world_from_target: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    matrix: np.ndarray,
) -> np.ndarray:
    """The (3, 3) homography from reference to target pixels over the plane `normal . (x - position) = 0`.

    matrix: (3, 3) K of both images. Scaled so that the third component is the target's depth over the reference's:
    in front of the camera is > 0. Source: Li et al., eq. (7), divided by n^T (p - t_r).
    """
    rotation_r, rotation_t = world_from_reference[:3, :3], world_from_target[:3, :3]
    offset = world_from_reference[:3, 3] - world_from_target[:3, 3]
    distance = normal @ (position - world_from_reference[:3, 3])
    between = np.eye(3) + np.outer(offset, normal) / distance
    return matrix @ rotation_t.T @ between @ rotation_r @ np.linalg.inv(matrix)


def residual(
    reference: np.ndarray, target: np.ndarray, exposure_reference: float, exposure_target: float
) -> np.ndarray:
    """`(eps_r I_t - eps_t I_r) / sqrt(eps_r^2 + eps_t^2)`, the shape of the intensities.

    Its square is what remains of both pixels' squared errors when the unknown radiance is eliminated by maximum
    likelihood. Source: Li et al., supplement eq. (10); the weight in the paper's eq. (8) is biased by noise.
    """
    norm = np.hypot(exposure_reference, exposure_target)
    return (exposure_reference * target - exposure_target * reference) / norm


@dataclass(frozen=True)
class Pairs:
    """Observations grouped by image pair, fixed for a level: order (O,), starts (M + 1,), reference and target (M,)."""

    order: np.ndarray
    starts: np.ndarray
    reference: np.ndarray
    target: np.ndarray


@dataclass(frozen=True)
class Elimination:
    """Which blocks the elimination of plane offsets touches: rows, columns (B,), and who contributes what."""

    rows: np.ndarray
    columns: np.ndarray
    slots: np.ndarray
    first: np.ndarray
    second: np.ndarray
    point: np.ndarray


@dataclass(frozen=True)
class Problem:
    """One pyramid level, ready to be linearized at any state.

    images: (I, H, W, C) uint8, contiguous
    starts: (P + 1,) int64, point p owns observations starts[p] to starts[p + 1]
    offset_sigma: (P,) m, how far the plane at each point may be off along its normal; None: planes are exact
    sigma: (O,) float64, standard deviation of the residuals of each observation, of 255
    inflation: how many times the pixels' information overstates itself; the cost is divided by it
    patch: side of a patch, pixels, odd; reference_pixels: see `visual.variant.Variant`
    """

    images: np.ndarray
    camera: Camera
    points: ScenePoints
    observations: Observations
    patch: int
    starts: np.ndarray
    pairs: Pairs
    sigma: np.ndarray
    offset_sigma: np.ndarray | None = None
    elimination: Elimination | None = None
    inflation: float = 1.0
    reference_pixels: Literal["fixed", "moving"] = "fixed"

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy of the level, (4,) float64."""
        return np.array([self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy])

    @property
    def information(self) -> np.ndarray:
        """What a squared residual counts, (O,) float64."""
        return np.asarray(1 / (self.sigma**2 * self.inflation))

    @property
    def samples(self) -> int:
        """Samples of a whole patch, all channels."""
        return self.patch**2 * self.images.shape[3]


def prepare(
    images: np.ndarray,
    camera: Camera,
    points: ScenePoints,
    observations: Observations,
    patch: int = SCENE_POINTS.size,
    *,
    offset_sigma: np.ndarray | None = None,
    sigma: float | np.ndarray = 3.0,
    inflation: float = 1.0,
    reference_pixels: Literal["fixed", "moving"] = "fixed",
) -> Problem:
    """The problem of one level; observations must be sorted by (point, target)."""
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] not in (1, 3):
        raise ValueError(f"images are {images.dtype} {images.shape}, must be uint8 (I, H, W, 1 or 3)")
    starts = np.searchsorted(observations.point, np.arange(len(points) + 1)).astype(np.int64)
    return Problem(
        images=np.ascontiguousarray(images),
        camera=camera,
        points=points,
        observations=observations,
        patch=patch,
        starts=starts,
        pairs=_group(points.reference[observations.point], observations.target, len(images)),
        sigma=np.broadcast_to(np.asarray(sigma, np.float64), len(observations)),
        offset_sigma=offset_sigma,
        elimination=None if offset_sigma is None else _eliminate(starts, points, observations, len(images)),
        inflation=inflation,
        reference_pixels=reference_pixels,
    )


def _group(reference: np.ndarray, target: np.ndarray, images: int) -> Pairs:
    key = reference.astype(np.int64) * images + target
    order = np.argsort(key, kind="stable")
    pairs, first = np.unique(key[order], return_index=True)
    starts = np.append(first, len(order)).astype(np.int64)
    return Pairs(order, starts, (pairs // images).astype(np.int32), (pairs % images).astype(np.int32))


def _eliminate(
    starts: np.ndarray, points: ScenePoints, observations: Observations, images: int
) -> Elimination:
    first, second, point, key = offset_kernels.contributions(
        starts, points.reference, observations.target, images
    )
    order = np.argsort(key, kind="stable")
    unique, begin = np.unique(key[order], return_index=True)
    return Elimination(
        (unique // images).astype(np.int32),
        (unique % images).astype(np.int32),
        np.append(begin, len(order)).astype(np.int64),
        first[order],
        second[order],
        point[order],
    )


@dataclass(frozen=True)
class PhotometricState:
    """The cameras, and how far each scene point's plane is moved along its normal, (P,) m."""

    cameras: CameraStates
    offset: np.ndarray


@dataclass(frozen=True)
class Linearization:
    """The photometric cost about a state.

    equations: over the images' 7 unknowns `[rotation | translation | log exposure]`, plane offsets eliminated
    single: (O, 15) gradient of each observation by its reference's, its target's unknowns and its plane's offset
    offset_hessian, offset_gradient: (P,), of the plane offsets, with their prior; entry: (P + O, 7) their couplings
    """

    equations: NormalEquations
    sums: np.ndarray
    single: np.ndarray
    offset_hessian: np.ndarray
    offset_gradient: np.ndarray
    entry: np.ndarray


def sums(problem: Problem, state: PhotometricState) -> np.ndarray:
    """The sums over the patch of every observation, (O, 13) float64; see `lvba.kernels.photometric`.

    (O, 24) where the reference pixels move: 11 more, see `lvba.kernels.photometric_moving`.
    """
    points = problem.points
    limits = (LEAST_INTENSITY, GREATEST_INTENSITY, NOISE_GROWTH)
    scene = (
        problem.images,
        *_poses(state.cameras),
        np.exp(state.cameras.log_exposure),
        problem.intrinsics,
        _positions(problem, state),
        points.normal_world,
        points.reference,
    )
    huber = HUBER * problem.sigma
    seen = (
        problem.starts,
        problem.observations.target,
        problem.patch // 2,
        huber,
        np.array(limits, np.float32),
    )
    if problem.reference_pixels == "moving":
        return moving_kernels.evaluate(*scene, *seen)
    return kernels.evaluate(*scene, points.pixel, *seen)


def _poses(cameras: CameraStates) -> tuple[np.ndarray, np.ndarray]:
    pose = cameras.world_from_camera
    return np.ascontiguousarray(pose[:, :3, :3]), np.ascontiguousarray(pose[:, :3, 3])


def _positions(problem: Problem, state: PhotometricState) -> np.ndarray:
    return problem.points.position_world + state.offset[:, None] * problem.points.normal_world


def linearize(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray | None = None
) -> Linearization:
    """The cost about a state: Gauss-Newton with robust weights, each sample divided by sigma^2 and the inflation.

    The cost is the sum of Huber's function of residual / sigma. A sample that is masked or outside counts as a
    constant (what noise alone costs), so that no step is accepted for losing samples.
    """
    s = sums(problem, state) if observation_sums is None else observation_sums
    pairs = problem.pairs
    blocks, gradients, single, coupling = _assembled(problem, state, s)
    gradient = np.zeros((len(state.cameras), 7))
    np.add.at(gradient, pairs.reference, gradients[:, :7])
    np.add.at(gradient, pairs.target, gradients[:, 7:])
    rows = np.concatenate([pairs.reference, pairs.target, pairs.reference])
    columns = np.concatenate([pairs.reference, pairs.target, pairs.target])
    parts = np.concatenate([blocks[:, :7, :7], blocks[:, 7:, 7:], blocks[:, :7, 7:]])
    equations = normal_equations.from_blocks(rows, columns, parts, gradient, cost(problem, s))
    if problem.elimination is None or problem.offset_sigma is None:
        none = np.zeros(0)
        return Linearization(equations, s, single, none, none, none)
    precision = 1 / problem.offset_sigma**2
    hessian, own, entry = offset_kernels.gather(single, coupling, problem.starts, precision, state.offset)
    return Linearization(
        equations + _schur(problem, problem.elimination, hessian, own, entry, precision, state.offset),
        s,
        single,
        hessian,
        own,
        entry,
    )


def _assembled(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Blocks and gradient of every image pair, gradient and plane's row of every observation."""
    points, pairs = problem.points, problem.pairs
    arguments = (
        observation_sums,
        problem.information,
        pairs.order,
        pairs.starts,
        pairs.reference,
        pairs.target,
        problem.observations.point,
        *_poses(state.cameras),
        problem.intrinsics,
        _positions(problem, state),
        points.normal_world,
    )
    if problem.reference_pixels == "moving":
        return moving_kernels.assemble(*arguments)
    return kernels.assemble(*arguments, points.pixel)


def shared_information(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray, share: np.ndarray, shares: int
) -> np.ndarray:
    """(shares, 6, 6): what the observations of each share tell of an image's pose, over fixed planes.

    share: (O, 2), which share an observation belongs to with its reference, and which with its target
    """
    points, observations = problem.points, problem.observations
    return kernels.shared_information(
        observation_sums,
        problem.information,
        share,
        shares,
        points.reference[observations.point],
        observations.target,
        observations.point,
        *_poses(state.cameras),
        problem.intrinsics,
        _positions(problem, state),
        points.normal_world,
        points.pixel,
    )


def cost(problem: Problem, observation_sums: np.ndarray) -> float:
    """Half the robust squared residuals over sigma^2 and inflation; a lost sample costs what noise alone does."""
    lost = 0.5 * problem.sigma**2 * (problem.samples - observation_sums[:, COUNT])
    return float(problem.information @ (observation_sums[:, COST] + lost))


def _schur(
    problem: Problem,
    elimination: Elimination,
    hessian: np.ndarray,
    own: np.ndarray,
    entry: np.ndarray,
    precision: np.ndarray,
    offset: np.ndarray,
) -> NormalEquations:
    """What the plane offsets add to the equations of the cameras: their prior's cost, less what they can explain."""
    blocks = offset_kernels.schur_blocks(
        entry, hessian, elimination.first, elimination.second, elimination.point, elimination.slots
    )
    gradient = np.zeros((len(problem.images), 7))
    points, observations = problem.points, problem.observations
    pull = own / hessian
    offset_kernels.scatter(gradient, entry, pull, points.reference, observations.target, observations.point)
    held = 0.5 * float(precision @ offset**2)
    alone = 0.5 * float(own @ pull)
    return NormalEquations(elimination.rows, elimination.columns, blocks, gradient, held, alone)


def retract(
    problem: Problem, state: PhotometricState, at: Linearization, step: np.ndarray
) -> PhotometricState:
    """The state moved by a (I, 7) step: poses on the right, log exposures by addition, plane offsets following."""
    cameras = moved(state.cameras, step)
    if problem.elimination is None:
        return PhotometricState(cameras, state.offset)
    points, observations = problem.points, problem.observations
    count = len(points)
    pull = np.einsum("pk,pk->p", at.entry[:count], step[points.reference])
    far = np.einsum("ok,ok->o", at.entry[count:], step[observations.target])
    pull += np.bincount(observations.point, far, count)
    return PhotometricState(cameras, state.offset - (at.offset_gradient + pull) / at.offset_hessian)


def moved(cameras: CameraStates, step: np.ndarray) -> CameraStates:
    """Cameras moved by a (I, 7) step."""
    return CameraStates(
        geometry.retract(cameras.world_from_camera, step[:, :6]), cameras.log_exposure + step[:, 6]
    )
