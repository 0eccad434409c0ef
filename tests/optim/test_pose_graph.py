"""Pose graphs against the truth, plain differences, and false loops."""

import numpy as np
import pytest
from pose_graph_world import SIGMA, loop_world, position_error

from lvba import geometry
from lvba.errors import DegenerateProblemError
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges

FAR = [0, 0, 0.3, 4.0, -2.0, 0.5]
NONE = np.zeros(6)


def test_jacobians_are_those_of_differences():
    _, edges, start = loop_world(12, loops=[(0, 11, [0.9, -0.7, 1.1, 4.0, -2.0, 0.5]), (2, 9, NONE)])
    error = pose_graph.residuals(start, edges)
    analytic = pose_graph.jacobians(start, edges, error)
    h = 1e-6
    for ends, given in zip((edges.first, edges.second), analytic, strict=True):
        for axis in range(6):
            off = np.zeros(6)
            off[axis] = h
            change = []
            for sign in (1, -1):
                # one edge at a time: the same node may be the other edges' other end
                moved = []
                for e in range(len(edges)):
                    poses = start.copy()
                    poses[ends[e]] = poses[ends[e]] @ geometry.exp(sign * off)
                    moved.append(pose_graph.residuals(poses, edges)[e])
                change.append(np.array(moved))
            np.testing.assert_allclose(
                given[:, :, axis], (change[0] - change[1]) / (2 * h), rtol=1e-5, atol=1e-5
            )


def test_linearized_cost_is_the_plain_sum():
    _, edges, start = loop_world(10, loops=[(0, 9, FAR)])
    equations = pose_graph.linearize(start, edges)
    hessian, gradient, cost = np.zeros((60, 60)), np.zeros(60), 0.0
    error = pose_graph.residuals(start, edges)
    by_first, by_second = pose_graph.jacobians(start, edges, error)
    for e in range(len(edges)):
        row = np.zeros((6, 60))
        row[:, 6 * edges.first[e] : 6 * edges.first[e] + 6] = by_first[e]
        row[:, 6 * edges.second[e] : 6 * edges.second[e] + 6] = by_second[e]
        hessian += row.T @ edges.information[e] @ row
        gradient += row.T @ edges.information[e] @ error[e]
        cost += 0.5 * error[e] @ edges.information[e] @ error[e]
    np.testing.assert_allclose(equations.dense(), hessian, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(equations.gradient.ravel(), gradient, rtol=1e-9, atol=1e-6)
    assert equations.cost == pytest.approx(cost)


def test_a_true_loop_closes_the_chain():
    truth, edges, start = loop_world(60, seed=1, loops=[(0, 59, NONE)])
    found = pose_graph.solve(start, edges)
    assert found.converged
    assert found.loop_weight[-1] == 1.0
    assert position_error(found.world_from_node, truth) < 0.5 * position_error(start, truth)
    np.testing.assert_array_equal(found.world_from_node[0], start[0])
    assert np.linalg.norm(found.residual_after[-1, 3:]) < 0.1 * np.linalg.norm(found.residual_before[-1, 3:])


def test_a_false_loop_has_no_effect_at_all():
    _, edges, start = loop_world(40, seed=2, loops=[(5, 30, FAR)])
    found = pose_graph.solve(start, edges)
    np.testing.assert_array_equal(found.loop_weight[-1:], 0.0)
    assert "chi square" in found.loop_reason[-1]
    without = pose_graph.solve(start, edges.take(~edges.is_loop))
    np.testing.assert_array_equal(found.world_from_node, without.world_from_node)


@pytest.mark.parametrize("seed", range(4))
def test_true_loops_win_over_a_false_one_that_the_odometry_would_allow(seed):
    # the odometry alone cannot tell: one step's error allows for more than what the false loop is off by
    off = np.array([0, 0, 0.02, 1.5, -1.2, 0.3])
    loops = [(0, 39, NONE), (2, 37, off), (1, 38, NONE), (3, 36, NONE)]
    _, edges, start = loop_world(40, seed=seed, sigma=3 * SIGMA, loops=loops)
    alone = pose_graph.solve(start, edges.take(np.r_[np.arange(39), 40]))
    assert alone.loop_weight[-1] == 1.0
    found = pose_graph.solve(start, edges)
    np.testing.assert_array_equal(found.loop_weight[-4:], [1, 0, 1, 1])


def test_two_loops_that_contradict_each_other_are_both_refused():
    # equally far from what the odometry says, to both sides
    off = np.array([0, 0, 0, 0.3, 0.0, 0.0])
    _, edges, _ = loop_world(40, sigma=SIGMA, loops=[(0, 39, off), (0, 39, -off)])
    chain = edges.take(~edges.is_loop)
    start = pose_graph.propagate(40, chain, 0, np.eye(4))
    between = geometry.inverse(start[0]) @ start[39]
    edges.first_from_second[-2:] = between @ geometry.exp(np.stack([off, -off]))
    for loops, weight in ((edges.take(np.arange(40)), [1]), (edges, [0, 0])):
        found = pose_graph.solve(start, loops)
        np.testing.assert_array_equal(found.loop_weight[39:], weight)
    assert "cannot be told" in found.loop_reason[-1]


def test_a_loop_may_leave_directions_open():
    truth, edges, start = loop_world(40, seed=1, loops=[(0, 39, [0, 0, 0, 5.0, 0, 0])])
    information = edges.information.copy()
    information[-1, 3] = information[-1, :, 3] = 0.0
    open_along = Edges(edges.first, edges.second, edges.first_from_second, information, edges.is_loop)
    found = pose_graph.solve(start, open_along)
    assert found.loop_weight[-1] == 1.0
    assert np.linalg.norm(found.residual_after[-1, [4, 5]]) < 0.01
    assert position_error(found.world_from_node, truth) < position_error(start, truth)


def test_node_fixed_stays_and_others_do_not_matter_in_order():
    _, edges, start = loop_world(30, seed=5, loops=[(0, 29, NONE)])
    found = pose_graph.solve(start, edges, fixed=7)
    np.testing.assert_array_equal(found.world_from_node[7], start[7])
    shuffled = pose_graph.solve(start, edges.take(np.random.default_rng(0).permutation(len(edges))), fixed=7)
    np.testing.assert_allclose(shuffled.world_from_node, found.world_from_node, atol=1e-8)


def test_poses_that_nothing_connects_are_an_error():
    _, edges, start = loop_world(10)
    with pytest.raises(DegenerateProblemError, match="connects pose 0 with pose 5"):
        pose_graph.solve(start, edges.take(np.arange(9) != 4))


def test_twenty_thousand_poses_are_solved():
    count = 20_000
    loops = [(k, k + 4000, NONE) for k in range(0, 15_000, 3000)]
    truth, edges, start = loop_world(count, seed=4, sigma=1e-2 * SIGMA, loops=loops)
    found = pose_graph.solve(start, edges)
    assert found.converged
    np.testing.assert_array_equal(found.loop_weight, 1.0)
    assert position_error(found.world_from_node, truth) < position_error(start, truth)
