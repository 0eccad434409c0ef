"""Exact per-pixel Jacobian against the patch-center Jacobian of the photometric cost: what exactness costs and brings.

`lvba` moves all pixels of a patch as its center moves: then a patch's sums are applied to one Jacobian. Here every pixel
has its own, otherwise the same residuals, weights and solver, in a room of textured planes with known truth. One
thread; the least processor time of several runs, compilation apart; plane offsets, exposures and prior are left out.
"""

import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
from bench_photometric import best_seconds

from lvba import trajectory
from lvba.camera import Camera
from lvba.kernels.compiled import kernel
from lvba.kernels.homography import center_jacobian, patch_warp, plane_in_reference, relative_pose
from lvba.kernels.photometric import ImagePairs, Intensities
from lvba.kernels.scene import Intrinsics, PlanePatches
from lvba.optim import levenberg_marquardt, normal_equations
from lvba.optim.levenberg_marquardt import SolverConfig
from lvba.optim.normal_equations import NormalEquations
from lvba.visual import photometric, visibility
from lvba.visual.image import DARK, SATURATED
from lvba.visual.photometric import PhotometricState, Problem
from lvba.visual.states import CameraStates

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests" / "support"))

import textured_planes

CAMERA = Camera(320, 240, 190.0, 190.0, 159.5, 119.5)
IMAGES = 10


@kernel
def exact_pairs(
    images: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    point: np.ndarray,
    pairs: ImagePairs,
    radius: int,
    huber: float,
    usable: Intensities,
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (M, 12, 12) and gradient (M, 12) of every image pair by the poses of both, of equally exposed images.

    huber: threshold, grey values
    """
    hessian, gradient = np.zeros((len(pairs.reference), 12, 12)), np.zeros((len(pairs.reference), 12))
    relative, offset, plane, ray = np.empty((3, 3)), np.empty(3), np.empty(3), np.ones(3)
    warp, jacobian, row = np.empty(8), np.empty((2, 13)), np.empty(12)
    mix = np.sqrt(0.5)
    for m in range(len(pairs.reference)):
        r, t = pairs.reference[m], pairs.target[m]
        relative_pose(poses, r, t, relative, offset)
        for n in range(pairs.starts[m], pairs.starts[m + 1]):
            p = point[pairs.order[n]]
            distance = plane_in_reference(poses[r], patches.position[p], patches.normal[p], plane)
            for j in range(-radius, radius + 1):
                for i in range(-radius, radius + 1):
                    u, v = patches.pixel[p, 0] + i, patches.pixel[p, 1] + j
                    ray[0], ray[1] = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
                    if not patch_warp(relative, offset, plane, ray, intrinsics, warp) > 0.0:
                        continue
                    x, y = warp[2], warp[5]
                    column, line = int(x), int(y)
                    if not (
                        x >= 0 and y >= 0 and column < images.shape[2] - 1 and line < images.shape[1] - 1
                    ):
                        continue
                    a, b = np.float64(images[t, line, column, 0]), np.float64(images[t, line, column + 1, 0])
                    c = np.float64(images[t, line + 1, column, 0])
                    d = np.float64(images[t, line + 1, column + 1, 0])
                    wanted = np.float64(images[r, v, u, 0])
                    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
                    if not (usable.least <= min(low, wanted) and max(high, wanted) <= usable.greatest):
                        continue
                    ax, ay = x - column, y - line
                    top, bottom = a + ax * (b - a), c + ax * (d - c)
                    gx, gy = mix * ((b - a) + ay * ((d - c) - (b - a))), mix * (bottom - top)
                    residual = mix * (top + ay * (bottom - top) - wanted)
                    weight = huber / max(abs(residual), huber)
                    center_jacobian(relative, offset, plane, distance, ray, intrinsics, jacobian)
                    for k in range(12):
                        row[k] = gx * jacobian[0, k] + gy * jacobian[1, k]
                    for k in range(12):
                        gradient[m, k] += weight * residual * row[k]
                        for q in range(k, 12):
                            hessian[m, k, q] += weight * row[k] * row[q]
        for k in range(12):
            for q in range(k):
                hessian[m, k, q] = hessian[m, q, k]
    return hessian, gradient


def linearize_exactly(problem: Problem, state: PhotometricState) -> NormalEquations:
    """As `photometric.linearize`, for equally exposed images and planes that stay; the log exposures do not occur."""
    pairs, pose = problem.pairs, np.ascontiguousarray(state.cameras.world_from_camera)
    hessian, gradients = exact_pairs(
        problem.images,
        pose,
        problem.intrinsics,
        visibility.kernel_patches(problem.points),
        problem.observations.point,
        pairs,
        problem.patch // 2,
        photometric.HUBER * problem.sigma[0],
        Intensities(np.float32(DARK), np.float32(SATURATED), np.float32(0)),
    )
    information = problem.information[0]  # every observation's
    gradient = np.zeros((len(pose), 7))
    np.add.at(gradient[:, :6], pairs.reference, information * gradients[:, :6])
    np.add.at(gradient[:, :6], pairs.target, information * gradients[:, 6:])
    blocks = np.zeros((3, len(pairs.reference), 7, 7))
    parts = (hessian[:, :6, :6], hessian[:, 6:, 6:], hessian[:, :6, 6:])
    blocks[:, :, :6, :6] = information * np.stack(parts)
    rows = np.concatenate([pairs.reference, pairs.target, pairs.reference])
    columns = np.concatenate([pairs.reference, pairs.target, pairs.target])
    value = photometric.cost(problem, photometric.sums(problem, state))
    return normal_equations.from_blocks(rows, columns, blocks.reshape(-1, 7, 7), gradient, value)


def linearize_by_centers(problem: Problem, state: PhotometricState) -> NormalEquations:
    """What `lvba` does."""
    return photometric.linearize(problem, state).equations


def room(patch: int) -> tuple[Problem, PhotometricState, np.ndarray]:
    """The problem, its rough start (5 mm, 0.1 degrees off), and the true poses."""
    world, poses = textured_planes.room(), textured_planes.walk(IMAGES)
    images = textured_planes.render(world, poses, CAMERA, np.ones(IMAGES), noise=2.0)
    points, observations = textured_planes.scene_points(world, poses, CAMERA, step=14, radius=patch // 2)
    problem = photometric.prepare(images, CAMERA, points, observations, patch)
    rough = textured_planes.disturbed(poses, 0.005, 0.1, 0)
    return problem, PhotometricState(CameraStates(rough, np.zeros(IMAGES)), np.zeros(len(points))), poses


def solved(
    problem: Problem, start: PhotometricState, exact: bool
) -> levenberg_marquardt.Solution[PhotometricState]:
    """Where Levenberg-Marquardt ends; exposures stay."""
    free = np.ones((IMAGES, 7), bool)
    free[:, 6] = False
    work = linearize_exactly if exact else linearize_by_centers
    return levenberg_marquardt.levenberg_marquardt(
        start,
        lambda state: work(problem, state),
        lambda state, step: PhotometricState(photometric.moved(state.cameras, step.blocks), state.offset),
        SolverConfig(max_iterations=30, relative_decrease=1e-7),
        free,
    )


def run(patches: tuple[int, ...] = (7, 9, 11)) -> dict[str, Any]:
    """Time of one linearization, steps, final cost and pose error of both, by patch size."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    rows = []
    try:
        for patch in patches:
            problem, start, truth = room(patch)
            for exact in (False, True):
                work = linearize_exactly if exact else linearize_by_centers
                solution = solved(problem, start, exact)
                poses = solution.state.cameras.world_from_camera
                error = trajectory.pose_error(poses, truth, aligned=np.eye(4))
                rows.append(
                    {
                        "patch": patch,
                        "jacobian": "every pixel" if exact else "patch center",
                        "linearize_ms": 1e3
                        * best_seconds(lambda work=work, at=problem, state=start: work(at, state), 5),
                        "steps": len(solution.history),
                        "cost": solution.cost,
                        "position_error_mm": 1e3 * error.ate_m,
                        "rotation_error_deg": error.rotation_deg,
                    }
                )
    finally:
        numba.set_num_threads(threads)
    return {"name": "jacobian", "threads": 1, "images": IMAGES, "rows": rows}


if __name__ == "__main__":
    import json

    print(json.dumps(run(), indent=1))
