"""One visual bundle adjustment over all parts of a recording: their blocks add up, one sparse solve moves all cameras."""

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.blocks.visual_block import CameraBlock
from lvba.optim import levenberg_marquardt, normal_equations
from lvba.optim.normal_equations import NormalEquations
from lvba.visual import exposure_graph, photometric, radiometry, trajectory_prior
from lvba.visual.exposure_graph import Edges, Exposures
from lvba.visual.radiometry import NONE, Radiometry
from lvba.visual.response import TAKEN_OUT
from lvba.visual.states import VisualState
from lvba.visual.trajectory_prior import Prior

_FIRST_DAMPING = 1e-4
_CONVERGED_M = 1e-4
_CONVERGED_DEG = 1e-3


@dataclass(frozen=True)
class JointCameraRound:
    """One round. cost: of images and prior, per observation; moved_m, moved_deg: of the camera that moved furthest."""

    points: int
    observations: int
    cost: float
    moved_m: float
    moved_deg: float
    taken_back: bool


@dataclass(frozen=True)
class JointCameras:
    """All keyframes, and what the next round needs.

    state: poses (K, 4, 4), log exposures (K,) and the calibration; before: the same before the last step
    exposure_sigma: (K,); radiometry: of all parts; converged: nothing moves any more
    """

    state: VisualState
    before: VisualState
    prior: Prior | None
    exposure_sigma: np.ndarray
    radiometry: Radiometry = NONE
    damping: float = _FIRST_DAMPING
    cost: float = float("inf")
    converged: bool = False
    history: tuple[JointCameraRound, ...] = ()


def step(now: JointCameras, blocks: Sequence[CameraBlock]) -> JointCameras:
    """After one round: blocks and prior added up and solved."""
    if now.converged or not blocks:
        return now
    count = len(now.state.cameras)
    equations = total(blocks, count)
    joint = equations
    if now.prior is not None:
        joint = joint + trajectory_prior.linearize(now.prior, now.state)
    cost = joint.cost / max(sum(each.observations for each in blocks), 1)
    if levenberg_marquardt.cost_rises(cost, now.cost) and not now.history[-1].taken_back:
        return replace(
            now,
            state=now.before,
            damping=levenberg_marquardt.raised(now.damping),
            history=(*now.history, _round(blocks, cost, now.before, now.state, taken_back=True)),
        )
    free = _free(equations, now.prior is not None)
    change, damping = levenberg_marquardt.damped_step(joint, now.damping, free)
    if change is None:
        return replace(now, damping=damping)
    state = replace(
        now.state,
        cameras=photometric.moved(now.state.cameras, change.blocks),
        calibration=now.state.calibration.retract(change.shared),
    )
    entry = _round(blocks, cost, now.state, state, taken_back=False)
    return replace(
        now,
        state=state,
        before=now.state,
        damping=levenberg_marquardt.eased(now.damping),
        cost=cost,
        converged=entry.moved_m < _CONVERGED_M and entry.moved_deg < _CONVERGED_DEG,
        history=(*now.history, entry),
    )


def _round(
    blocks: Sequence[CameraBlock], cost: float, before: VisualState, after: VisualState, taken_back: bool
) -> JointCameraRound:
    """The account of one round."""
    moved_m, moved_deg = _moved(before, after)
    return JointCameraRound(
        points=sum(each.points for each in blocks),
        observations=sum(each.observations for each in blocks),
        cost=cost,
        moved_m=moved_m,
        moved_deg=moved_deg,
        taken_back=taken_back,
    )


def total(blocks: Sequence[CameraBlock], count: int) -> NormalEquations:
    """The equations of all blocks, in their order, over `count` keyframes."""
    return normal_equations.scattered([(each.images, each.equations) for each in blocks], count)


def with_exposures(now: JointCameras, edges: Sequence[Edges]) -> JointCameras:
    """The same cameras with exposures from the edges of all blocks, where there are any."""
    exposures = solve_exposures(edges, len(now.state.cameras))
    if exposures is None:
        return now
    cameras = replace(now.state.cameras, log_exposure=exposures.log_exposure)
    return replace(
        now,
        state=replace(now.state, cameras=cameras),
        exposure_sigma=exposures.sigma,
        radiometry=exposures.radiometry,
    )


def solve_exposures(edges: Sequence[Edges], images: int) -> Exposures | None:
    """The exposures of all images from the edges of all blocks, with one radiometry; None: there are none."""
    if not sum(len(each.mean) for each in edges):
        return None
    sums = [each.known for each in edges if each.known is not None]
    known = functools.reduce(operator.add, sums) if sums else None
    curve = edges[0].curve
    light = NONE if known is None else radiometry.solve(known, TAKEN_OUT if curve else None)
    before = np.cumsum([0, *(len(each.mean) for each in edges[:-1])])
    together = Edges(
        first=np.concatenate([each.first for each in edges]),
        second=np.concatenate([each.second for each in edges]),
        mean=np.concatenate([each.supposing(light) for each in edges]),
        sigma=np.concatenate([each.sigma for each in edges]),
        weight_fraction=np.concatenate([each.weight_fraction for each in edges]),
        pull=np.concatenate([each.pull for each in edges]),
        sharing=np.concatenate([each.sharing + start for each, start in zip(edges, before, strict=True)]),
        correlation=np.concatenate([each.correlation for each in edges]),
        pairs=sum(each.pairs for each in edges),
        spread=float(np.median([each.spread for each in edges if len(each.mean)])),
        radiometry=light,
        by_radiometry=np.concatenate([each.by_radiometry for each in edges]),
        known=known,
        curve=curve,
    )
    return exposure_graph.solve_edges(together, images)


def _free(equations: NormalEquations, with_prior: bool) -> np.ndarray:
    """(K, 7) bool: what may move; exposures stay as measured."""
    count = len(equations.gradient)
    free = np.ones((count, 7), bool)
    free[:, 6] = False
    if not with_prior:
        seen = np.zeros(count, bool)
        seen[equations.rows] = seen[equations.columns] = True
        free[:, :6] &= seen[:, None]
    return free


def _moved(before: VisualState, after: VisualState) -> tuple[float, float]:
    """Largest change of a camera, m and degrees."""
    a, b = before.cameras.world_from_camera, after.cameras.world_from_camera
    meters = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    degrees = geometry.rotation_angle_deg(geometry.inverse(a) @ b)
    return float(meters.max(initial=0.0)), float(degrees.max(initial=0.0))
