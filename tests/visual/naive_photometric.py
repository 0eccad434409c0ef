"""Plain twins of the photometric kernels: one pixel at a time, float64, no shortcuts."""

import numpy as np

from lvba import geometry
from lvba.visual import photometric


def bilinear(image: np.ndarray, u: float, v: float) -> tuple[float, float, float, float, float]:
    """Value, its derivatives by u and v, least and greatest of the four pixels, of an (H, W) image."""
    i, j = int(np.floor(u)), int(np.floor(v))
    a, b = u - i, v - j
    p = image[j : j + 2, i : i + 2].astype(float)
    value = (1 - b) * ((1 - a) * p[0, 0] + a * p[0, 1]) + b * ((1 - a) * p[1, 0] + a * p[1, 1])
    du = (1 - b) * (p[0, 1] - p[0, 0]) + b * (p[1, 1] - p[1, 0])
    dv = (1 - a) * (p[1, 0] - p[0, 0]) + a * (p[1, 1] - p[0, 1])
    return value, du, dv, p.min(), p.max()


def warp(problem, states, point: int, target: int, pixel: np.ndarray, offset: float = 0.0) -> np.ndarray:
    """The target pixel of a reference pixel, by the ray's intersection with the plane; (3,) with the depth last."""
    points, camera = problem.points, problem.camera
    reference = states.world_from_camera[points.reference[point]]
    ray = reference[:3, :3] @ [(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0]
    normal = points.normal_world[point]
    position = points.position_world[point] + offset * normal
    depth = normal @ (position - reference[:3, 3]) / (normal @ ray)
    x = geometry.inverse(states.world_from_camera[target]) @ np.append(reference[:3, 3] + depth * ray, 1.0)
    return np.array([camera.fx * x[0] / x[2] + camera.cx, camera.fy * x[1] / x[2] + camera.cy, x[2]])


def huber(r: float, limit: float) -> tuple[float, float]:
    """Cost and weight."""
    size = abs(r)
    return (0.5 * r * r, 1.0) if size <= limit else (limit * (size - 0.5 * limit), limit / size)


def observation_sums(problem, states, o: int, offset: float = 0.0) -> np.ndarray:
    """The 13 sums of one observation."""
    points, observations = problem.points, problem.observations
    point, target = observations.point[o], observations.target[o]
    r = points.reference[point]
    eps_r, eps_t = np.exp(states.log_exposure[[r, target]])
    norm = np.hypot(eps_r, eps_t)
    low, high, limit = (
        photometric.DARK,
        photometric.SATURATED,
        photometric.HUBER * problem.sigma[o],
    )
    total = np.zeros(13)
    height, width = problem.images.shape[1:3]
    for j in range(-(problem.patch // 2), problem.patch // 2 + 1):
        for i in range(-(problem.patch // 2), problem.patch // 2 + 1):
            pixel = points.pixel[point] + [i, j]
            u, v, depth = warp(problem, states, point, target, pixel, offset)
            if not (depth > 0 and 0 <= u < width - 4 and 0 <= v < height - 2):
                return np.zeros(13)
            for channel in range(problem.images.shape[3]):
                wanted = float(problem.images[r, pixel[1], pixel[0], channel])
                seen, du, dv, least, most = bilinear(problem.images[target, :, :, channel], u, v)
                if not (low <= wanted <= high and least >= low and most <= high):
                    continue
                growth = 1 + photometric.NOISE_GROWTH * (eps_r**2 * seen + eps_t**2 * wanted) / norm**2
                noise = 1 / np.sqrt(growth)
                residual = noise * (eps_r * seen - eps_t * wanted) / norm
                x, y = noise * eps_r / norm * du, noise * eps_r / norm * dv
                # d/d(log eps_t) of (eps_r I_t - eps_t I_r) / sqrt(eps_r^2 + eps_t^2), weight included
                q = noise * (-eps_t * wanted / norm - eps_t**2 * (eps_r * seen - eps_t * wanted) / norm**3)
                cost, w = huber(residual, limit)
                s = np.array([x, y, q, residual])
                p = w * np.outer(s, s)
                total += [
                    p[0, 0], p[0, 1], p[1, 1], p[0, 2], p[1, 2], p[2, 2], p[0, 3], p[1, 3], p[2, 3],
                    cost, 1.0, residual**2, w,
                ]  # fmt: skip
    return total


def center_jacobian(
    problem, states, point: int, target: int, offset: float = 0.0, step: float = 1e-6
) -> np.ndarray:
    """(2, 15): central differences of the warped patch centre by the unknowns of reference, target and plane."""
    jacobian = np.zeros((2, 15))
    pixel = problem.points.pixel[point]
    for k, image in ((0, problem.points.reference[point]), (7, target)):
        for n in range(6):
            move = np.zeros((len(states), 7))
            move[image, n] = step
            ahead = warp(problem, photometric.moved(states, move), point, target, pixel, offset)
            behind = warp(problem, photometric.moved(states, -move), point, target, pixel, offset)
            jacobian[:, k + n] = (ahead - behind)[:2] / (2 * step)
    ahead = warp(problem, states, point, target, pixel, offset + step)
    behind = warp(problem, states, point, target, pixel, offset - step)
    jacobian[:, 14] = (ahead - behind)[:2] / (2 * step)
    return jacobian


def normal_equations(problem, states, offsets=None) -> tuple[np.ndarray, np.ndarray, float]:
    """Dense Hessian, gradient and cost over 7 unknowns per image, then one offset per point if offsets are given."""
    cameras, count = 7 * len(states), len(problem.points)
    hessian, gradient, cost = np.zeros((cameras + count, cameras + count)), np.zeros(cameras + count), 0.0
    every = problem.patch**2 * problem.images.shape[3]
    for o in range(len(problem.observations)):
        point, target = problem.observations.point[o], problem.observations.target[o]
        offset = 0.0 if offsets is None else offsets[point]
        information = 1 / (problem.sigma[o] ** 2 * problem.variance_factor)
        s = observation_sums(problem, states, o, offset)
        cost += information * (s[9] + 0.5 * problem.sigma[o] ** 2 * (every - s[10]))
        s *= information
        if s[10] == 0:
            continue
        jacobian = np.zeros((3, 15))
        jacobian[:2] = center_jacobian(problem, states, point, target, offset)
        jacobian[2, 6], jacobian[2, 13] = -1, 1
        inner = np.array([[s[0], s[1], s[3]], [s[1], s[2], s[4]], [s[3], s[4], s[5]]])
        reference = 7 * problem.points.reference[point] + np.arange(7)
        index = np.concatenate([reference, 7 * target + np.arange(7), [cameras + point]])
        hessian[np.ix_(index, index)] += jacobian.T @ inner @ jacobian
        gradient[index] += jacobian.T @ s[6:9]
    used = slice(None) if offsets is not None else slice(cameras)
    return hessian[used, used], gradient[used], cost
