"""Plain twin of the photometric kernels whose reference patches move: one pixel at a time, derivatives by differences."""

import naive_photometric as naive
import numpy as np

from lvba import geometry
from lvba.visual import photometric


def center(problem, states, point: int, offset: float = 0.0) -> np.ndarray:
    """Where the reference camera sees the scene point, moved along its normal by the offset; (2,) pixels."""
    points, camera = problem.points, problem.camera
    position = points.position_world[point] + offset * points.normal_world[point]
    x = geometry.inverse(states.world_from_camera[points.reference[point]]) @ np.append(position, 1.0)
    return np.array([camera.fx * x[0] / x[2] + camera.cx, camera.fy * x[1] / x[2] + camera.cy])


def samples(problem, states, o: int, offset: float = 0.0) -> np.ndarray:
    """Every usable pixel pair of an observation, (n, 6): derivatives by target x, y, log exposure, reference u, v;
    residual."""
    points, observations = problem.points, problem.observations
    point, target = observations.point[o], observations.target[o]
    r = points.reference[point]
    eps_r, eps_t = np.exp(states.log_exposure[[r, target]])
    norm = np.hypot(eps_r, eps_t)
    low, high = photometric.DARK, photometric.SATURATED
    height, width = problem.images.shape[1:3]
    middle, found = center(problem, states, point, offset), []
    for j in range(-(problem.patch // 2), problem.patch // 2 + 1):
        for i in range(-(problem.patch // 2), problem.patch // 2 + 1):
            pixel = middle + np.array([i, j])
            x, y, depth = naive.warp(problem, states, point, target, pixel, offset)
            if not (depth > 0 and 0 <= x < width - 4 and 0 <= y < height - 2):
                return np.zeros((0, 6))
            if not (0 <= pixel[0] < width - 1 and 0 <= pixel[1] < height - 1):
                return np.zeros((0, 6))
            for channel in range(problem.images.shape[3]):
                wanted, wu, wv, *around = naive.bilinear(problem.images[r, :, :, channel], *pixel)
                seen, sx, sy, *about = naive.bilinear(problem.images[target, :, :, channel], x, y)
                if min(around + about) < low or max(around + about) > high:
                    continue
                growth = 1 + photometric.NOISE_GROWTH * (eps_r**2 * seen + eps_t**2 * wanted) / norm**2
                one = (eps_r * seen - eps_t * wanted) / norm
                q = -eps_t * wanted / norm - eps_t**2 / norm**2 * one
                row = [eps_r / norm * sx, eps_r / norm * sy, q, -eps_t / norm * wu, -eps_t / norm * wv, one]
                found.append(np.array(row) / np.sqrt(growth))
    return np.array(found).reshape(-1, 6)


def jacobian(problem, states, o: int, offset: float = 0.0, step: float = 1e-6) -> np.ndarray:
    """(5, 15): central differences of target centre, log exposure difference and reference centre by the unknowns."""
    point, target = problem.observations.point[o], problem.observations.target[o]

    def at(moved, distance: float) -> np.ndarray:
        pixel = center(problem, moved, point, distance)
        return np.append(naive.warp(problem, moved, point, target, pixel, distance)[:2], pixel)

    result = np.zeros((5, 15))
    for k, image in ((0, problem.points.reference[point]), (7, target)):
        for n in range(6):
            move = np.zeros((len(states), 7))
            move[image, n] = step
            ahead, behind = (at(photometric.moved(states, m), offset) for m in (move, -move))
            result[[0, 1, 3, 4], k + n] = (ahead - behind) / (2 * step)
    result[[0, 1, 3, 4], 14] = (at(states, offset + step) - at(states, offset - step)) / (2 * step)
    result[2, 6], result[2, 13] = -1, 1
    return result


def normal_equations(problem, states, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Dense Hessian, gradient and cost over 7 unknowns per image, then one offset per point."""
    cameras = 7 * len(states)
    size = cameras + len(problem.points)
    hessian, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
    for o in range(len(problem.observations)):
        point, target = problem.observations.point[o], problem.observations.target[o]
        rows = samples(problem, states, o, offsets[point])
        information = 1 / (problem.sigma[o] ** 2 * problem.variance_factor)
        limit = photometric.HUBER * problem.sigma[o]
        weighed = information * np.array([naive.huber(r, limit) for r in rows[:, 5]]).reshape(-1, 2)
        cost += weighed[:, 0].sum() + 0.5 * (problem.samples - len(rows)) / problem.variance_factor
        by = rows[:, :5] @ jacobian(problem, states, o, offsets[point])
        reference = 7 * problem.points.reference[point] + np.arange(7)
        index = np.concatenate([reference, 7 * target + np.arange(7), [cameras + point]])
        hessian[np.ix_(index, index)] += by.T @ (weighed[:, 1:] * by)
        gradient[index] += by.T @ (weighed[:, 1] * rows[:, 5])
    return hessian, gradient, cost
