"""A drive around a loop as a pose graph with known truth."""

import numpy as np

from lvba import geometry
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges

SIGMA = np.array([2e-3] * 3 + [2e-2] * 3)


def loop_world(count=40, seed=0, sigma=SIGMA, loops=()):
    """True poses on a circle with sway, a chain of noisy steps, loop edges (first, second, extra error)."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    truth = geometry.exp(np.stack([0 * angle, 0 * angle, angle, *np.zeros((3, count))], -1))
    truth[:, :3, 3] = np.stack([20 * np.cos(angle), 15 * np.sin(angle), 0.3 * np.sin(3 * angle)], -1)
    truth = truth @ geometry.exp(rng.normal(0, 0.05, (count, 6)))
    first = np.concatenate([np.arange(count - 1), [loop[0] for loop in loops]]).astype(int)
    second = np.concatenate([np.arange(1, count), [loop[1] for loop in loops]]).astype(int)
    tight = np.array([5e-4] * 3 + [5e-3] * 3)
    sigmas = np.concatenate([np.tile(sigma, (count - 1, 1)), np.tile(tight, (len(loops), 1))])
    noise = rng.normal(size=(len(first), 6)) * sigmas
    noise[count - 1 :] += np.array([loop[2] for loop in loops]).reshape(-1, 6)
    measured = geometry.inverse(truth[first]) @ truth[second] @ geometry.exp(noise)
    information = np.einsum("ei,ij->eij", sigmas**-2, np.eye(6))
    edges = Edges(first, second, measured, information, np.arange(len(first)) >= count - 1)
    return truth, edges, pose_graph.propagate(count, edges, 0, truth[0])


def position_error(poses, truth):
    return np.sqrt(np.mean(np.sum((poses - truth)[:, :3, 3] ** 2, axis=1)))
