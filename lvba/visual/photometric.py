"""The photometric cost of plane patches seen in two images, its normal equations and its noise."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import photometric as kernels
from lvba.kernels import photometric_moving as moving_kernels
from lvba.kernels import photometric_shared as shared_kernels
from lvba.kernels import plane_offsets as offset_kernels
from lvba.kernels.photometric import COST, COUNT, SQUARE, WEIGHTS, ImagePairs, Intensities
from lvba.kernels.scene import Intrinsics, PlanePatches
from lvba.optim import normal_equations
from lvba.optim.normal_equations import Border, NormalEquations, Step
from lvba.visual.image import DARK, SATURATED, intrinsics_of
from lvba.visual.patch_shifts import Shifts
from lvba.visual.scene_points import SCENE_POINTS, Observations, ScenePoints
from lvba.visual.states import CameraStates

__all__ = ["COST", "COUNT", "SQUARE", "WEIGHTS"]
"""Columns of the sums of an observation, which others read here."""

HUBER = 2.0
"""Residuals beyond this many standard deviations count linearly: 5 % of good ones do."""
NOISE_GROWTH = 0.0
"""Noise variance grows as 1 + NOISE_GROWTH * intensity: constant, for sigma is estimated patch by patch."""


def residual(
    reference: np.ndarray, target: np.ndarray, exposure_reference: float, exposure_target: float
) -> np.ndarray:
    """`(eps_r I_t - eps_t I_r) / sqrt(eps_r^2 + eps_t^2)`, the shape of the intensities.

    Its square is what remains of both pixels' squared errors when the unknown radiance is eliminated by maximum
    likelihood. Source: Li et al., supplement eq. (10); the weight in the paper's eq. (8) is biased by noise.
    reference, target: float64 of one shape (...), intensities
    """
    norm = np.hypot(exposure_reference, exposure_target)
    return np.asarray((exposure_reference * target - exposure_target * reference) / norm)


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
    pairs: the observations grouped by pair of images
    offset_sigma: (P,) m, how far planes may be off at points; None: they are exact; offset_scale: more than LiDAR says
    sigma: (O,) float64, standard deviation of the residuals of each observation, of 255
    variance_factor: actual over modeled variance of the pixels; the cost is divided by it
    patch: side of a patch, pixels, odd; reference_pixels: see `visual.variant.Variant`
    shifts: of the shared parameters that move patches; None: none does
    """

    images: np.ndarray
    camera: Camera
    points: ScenePoints
    observations: Observations
    patch: int
    starts: np.ndarray
    pairs: ImagePairs
    sigma: np.ndarray
    offset_sigma: np.ndarray | None = None
    offset_scale: float = 1.0
    elimination: Elimination | None = None
    variance_factor: float = 1.0
    reference_pixels: Literal["fixed", "moving"] = "fixed"
    shifts: Shifts | None = None

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the level."""
        return intrinsics_of(self.camera)

    @property
    def information(self) -> np.ndarray:
        """What a squared residual counts, (O,) float64."""
        return np.asarray(1 / (self.sigma**2 * self.variance_factor))

    @property
    def samples(self) -> int:
        """Samples of a whole patch, all channels."""
        return int(self.patch**2 * self.images.shape[3])


def prepare(
    images: np.ndarray,
    camera: Camera,
    points: ScenePoints,
    observations: Observations,
    patch: int = SCENE_POINTS.size,
    *,
    offset_sigma: np.ndarray | None = None,
    sigma: float | np.ndarray = 3.0,
    variance_factor: float = 1.0,
    reference_pixels: Literal["fixed", "moving"] = "fixed",
) -> Problem:
    """The problem of one level; observations must be sorted by (point, target).

    images: (I, H, W, C) uint8; offset_sigma: (P,) float64, m
    """
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
        variance_factor=variance_factor,
        reference_pixels=reference_pixels,
    )


def _group(reference: np.ndarray, target: np.ndarray, images: int) -> ImagePairs:
    key = reference.astype(np.int64) * images + target
    order = np.argsort(key, kind="stable")
    pairs, first = np.unique(key[order], return_index=True)
    starts = np.append(first, len(order)).astype(np.int64)
    return ImagePairs(order, starts, (pairs // images).astype(np.int32), (pairs % images).astype(np.int32))


def _eliminate(
    starts: np.ndarray, points: ScenePoints, observations: Observations, images: int
) -> Elimination:
    first, second, point, key = offset_kernels.contributions(
        starts, points.reference, observations.target, images
    )
    order = np.argsort(key, kind="stable")
    unique, begin = np.unique(key[order], return_index=True)
    return Elimination(
        rows=(unique // images).astype(np.int32),
        columns=(unique % images).astype(np.int32),
        slots=np.append(begin, len(order)).astype(np.int64),
        first=first[order],
        second=second[order],
        point=point[order],
    )


@dataclass(frozen=True)
class PhotometricState:
    """The cameras, and how far each scene point's plane is moved along its normal, (P,) m."""

    cameras: CameraStates
    offset: np.ndarray
    shared: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(k,): the steps of the shared parameters since the `Shifts` of the problem were made; empty: none."""


@dataclass(frozen=True)
class SharedTerms:
    """The photometric cost by shared parameters.

    border: of the normal equations, plane offsets not eliminated
    single: (O, m) gradient of each observation by m of the parameters; entry: (P, m) couplings of the plane offsets
    columns: (m,) int64, which of the parameters these are
    """

    border: Border
    single: np.ndarray
    entry: np.ndarray
    columns: np.ndarray


@dataclass(frozen=True)
class Linearization:
    """The photometric cost about a state.

    equations: over the images' 7 unknowns `[rotation | translation | log exposure]`, plane offsets eliminated
    single: (O, 15) gradient of each observation by its reference's, its target's unknowns and its plane's offset
    offset_hessian, offset_gradient: (P,), of the plane offsets, with their prior; entry: (P + O, 7) their couplings
    shared: what the cost has to do with shared parameters; None: nothing
    """

    equations: NormalEquations
    sums: np.ndarray
    single: np.ndarray
    offset_hessian: np.ndarray
    offset_gradient: np.ndarray
    entry: np.ndarray
    shared: SharedTerms | None = None


def sums(problem: Problem, state: PhotometricState) -> np.ndarray:
    """The sums over the patch of every observation, (O, 13) float64; see `lvba.kernels.photometric`.

    (O, 24) where the reference pixels move: 11 more, see `lvba.kernels.photometric_moving`.
    """
    scene = (
        problem.images,
        np.ascontiguousarray(state.cameras.world_from_camera),
        np.exp(state.cameras.log_exposure),
        problem.intrinsics,
        patches_at(problem, state),
        problem.starts,
        problem.observations.target,
        problem.patch // 2,
        HUBER * problem.sigma,
        Intensities(np.float32(DARK), np.float32(SATURATED), np.float32(NOISE_GROWTH)),
    )
    if problem.reference_pixels == "moving":
        return moving_kernels.evaluate(*scene)
    return kernels.evaluate(*scene, _shift(problem, state))


def _shift(problem: Problem, state: PhotometricState) -> np.ndarray:
    """(O, 2) px that the shared parameters move each patch by; (0, 2): they move none."""
    shifts = problem.shifts
    if shifts is None:
        return np.zeros((0, 2))
    if not np.any(state.shared):
        return shifts.at
    return np.asarray(shifts.at + shifts.by @ state.shared[shifts.columns])


def patches_at(problem: Problem, state: PhotometricState) -> PlanePatches:
    """The scene points where their planes now are."""
    points = problem.points
    position = points.position_world + state.offset[:, None] * points.normal_world
    return PlanePatches(position, points.normal_world, points.reference, points.pixel)


def linearize(
    problem: Problem,
    state: PhotometricState,
    observation_sums: np.ndarray | None = None,
    by_shared: np.ndarray | None = None,
) -> Linearization:
    """The cost about a state: Gauss-Newton with robust weights, each sample divided by sigma^2 and the variance factor.

    The cost is the sum of Huber's function of residual / sigma. A sample that is masked or outside counts as a
    constant (what noise alone costs), so that no step is accepted for losing samples.
    by_shared: (O, 3, k) float64, derivatives of the patch centre's pixel (x, y) in the target and of the log exposure
    difference
        by shared parameters (`optim.shared_parameters`), which the equations are then bordered by; None: by those of
        the problem's `shifts`
    observation_sums: (O, SUMS) float64, of `sums`; None: made here
    """
    s = sums(problem, state) if observation_sums is None else observation_sums
    if by_shared is None and problem.shifts is not None:
        return _spread(linearize(problem, state, s, problem.shifts.jacobian), problem.shifts)
    pairs = problem.pairs
    blocks, gradients, single, coupling = assembled(problem, state, s)
    gradient = np.zeros((len(state.cameras), 7))
    np.add.at(gradient, pairs.reference, gradients[:, :7])
    np.add.at(gradient, pairs.target, gradients[:, 7:])
    rows = np.concatenate([pairs.reference, pairs.target, pairs.reference])
    columns = np.concatenate([pairs.reference, pairs.target, pairs.target])
    parts = np.concatenate([blocks[:, :7, :7], blocks[:, 7:, 7:], blocks[:, :7, 7:]])
    shared = None if by_shared is None else _shared_terms(problem, state, s, by_shared)
    border = None if shared is None else shared.border
    equations = normal_equations.from_blocks(rows, columns, parts, gradient, cost(problem, s), border)
    if problem.elimination is None or problem.offset_sigma is None:
        none = np.zeros(0)
        return Linearization(
            equations=equations, sums=s, single=single, offset_hessian=none, offset_gradient=none, entry=none,
            shared=shared,
        )  # fmt: skip
    precision = 1 / problem.offset_sigma**2
    hessian, own, entry = offset_kernels.gather(single, coupling, problem.starts, precision, state.offset)
    equations = equations + _schur(problem, problem.elimination, hessian, own, entry, precision, state.offset)
    if shared is not None:
        explained = _explained_border(problem, shared, hessian, own, entry)
        equations = replace(equations, border=shared.border + explained)
    return Linearization(
        equations=equations,
        sums=s,
        single=single,
        offset_hessian=hessian,
        offset_gradient=own,
        entry=entry,
        shared=shared,
    )


def _spread(at: Linearization, shifts: Shifts) -> Linearization:
    """The same, bordered by all shared parameters, of which the shifts know some."""
    assert at.shared is not None
    assert at.equations.border is not None
    border, own = (shifts.spread_border(each) for each in (at.equations.border, at.shared.border))
    shared = replace(at.shared, border=own, columns=shifts.columns)
    return replace(at, equations=replace(at.equations, border=border), shared=shared)


def _shared_terms(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray, by_shared: np.ndarray
) -> SharedTerms:
    if problem.reference_pixels == "moving":
        raise ValueError("shared parameters are not known of patches whose reference pixels move")
    coupling, hessian, single, with_offset = shared_kernels.assemble(
        observation_sums,
        problem.information,
        problem.pairs,
        problem.observations.point,
        np.ascontiguousarray(state.cameras.world_from_camera),
        problem.intrinsics,
        patches_at(problem, state),
        np.ascontiguousarray(by_shared),
    )
    by_image = np.zeros((len(state.cameras), 7, by_shared.shape[2]))
    offset_kernels.add_blocks(by_image, problem.pairs.reference, np.ascontiguousarray(coupling[:, :7]))
    offset_kernels.add_blocks(by_image, problem.pairs.target, np.ascontiguousarray(coupling[:, 7:]))
    entry = np.zeros((len(problem.points), by_shared.shape[2], 1))
    offset_kernels.add_blocks(entry, problem.observations.point, with_offset[..., None])
    border = Border(by_image, hessian.sum(axis=0), single.sum(axis=0))
    return SharedTerms(border, single, entry[..., 0], np.arange(single.shape[1]))


def _explained_border(
    problem: Problem, shared: SharedTerms, hessian: np.ndarray, own: np.ndarray, entry: np.ndarray
) -> Border:
    """What the plane offsets can explain of the border, to be added: as `_schur` for the images."""
    points, observations = problem.points, problem.observations
    over = shared.entry / hessian[:, None]
    coupling = np.zeros_like(shared.border.coupling)
    shared_kernels.eliminate(coupling, entry, over, points.reference, observations.target, observations.point)
    # not by BLAS, which sums over points in an order that depends on its threads
    return Border(coupling, -np.einsum("pk,pl->kl", shared.entry, over), -np.einsum("pk,p->k", over, own))


def assembled(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Blocks (pairs, 14, 14) and gradient (pairs, 14) of every image pair, gradient (O, 15), as `Linearization.single`,
    and plane's row of every observation, float64. observation_sums: of `sums`"""
    assemble = moving_kernels.assemble if problem.reference_pixels == "moving" else kernels.assemble
    return assemble(
        observation_sums,
        problem.information,
        problem.pairs,
        problem.observations.point,
        np.ascontiguousarray(state.cameras.world_from_camera),
        problem.intrinsics,
        patches_at(problem, state),
    )


def shared_information(
    problem: Problem, state: PhotometricState, observation_sums: np.ndarray, cluster: np.ndarray, count: int
) -> np.ndarray:
    """(count, 6, 6): information of the observations of each cluster about an image's pose, over fixed planes.

    cluster: (O, 2) int64, the cluster of each observation with its reference, and with its target
    observation_sums: (O, SUMS) float64, of `sums`
    """
    return shared_kernels.shared_information(
        observation_sums,
        problem.information,
        cluster,
        count,
        problem.observations.target,
        problem.observations.point,
        np.ascontiguousarray(state.cameras.world_from_camera),
        problem.intrinsics,
        patches_at(problem, state),
    )


def cost(problem: Problem, observation_sums: np.ndarray) -> float:
    """Half the robust squared residuals over sigma^2 and variance factor; a lost sample costs what noise alone does.

    observation_sums: (O, SUMS) float64, of `sums`
    """
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
    return NormalEquations(
        rows=elimination.rows,
        columns=elimination.columns,
        blocks=blocks,
        gradient=gradient,
        cost=held,
        eliminated=alone,
    )


def retract(problem: Problem, state: PhotometricState, at: Linearization, step: Step) -> PhotometricState:
    """The state moved by a step of I blocks of 7: poses on the right, log exposures added to, plane offsets following.

    Shared parameters that move patches are plain numbers: their steps add up.
    """
    cameras, shared = moved(state.cameras, step.blocks), state.shared
    if problem.shifts is not None and len(step.shared):
        shared = shared + step.shared if len(shared) else step.shared
    if problem.elimination is None:
        return PhotometricState(cameras, state.offset, shared)
    points, observations = problem.points, problem.observations
    count = len(points)
    pull = np.einsum("pk,pk->p", at.entry[:count], step.blocks[points.reference])
    far = np.einsum("ok,ok->o", at.entry[count:], step.blocks[observations.target])
    pull += np.bincount(observations.point, far, count)
    if at.shared is not None and len(step.shared):
        pull += at.shared.entry @ step.shared[at.shared.columns]
    offset = state.offset - (at.offset_gradient + pull) / at.offset_hessian
    return PhotometricState(cameras, offset, shared)


def moved(cameras: CameraStates, step: np.ndarray) -> CameraStates:
    """Cameras moved by a (I, 7) step.

    step: (I, 7) float64, `[rotation | translation | log exposure]`
    """
    return CameraStates(
        geometry.retract(cameras.world_from_camera, step[:, :6]), cameras.log_exposure + step[:, 6]
    )
