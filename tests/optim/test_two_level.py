"""Normal equations at two levels: what they keep of the whole Hessian, and where steps of them end."""

import numpy as np
import pytest

from lvba import geometry
from lvba.optim import normal_equations, two_level
from lvba.optim.normal_equations import NormalEquations

POSES, SIZE = 22, 4
METRIC = np.array([1e4, 1e4, 1e4, 1e2, 1e2, 1e2])


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    steps = np.column_stack([rng.normal(0, 0.1, (POSES, 3)), rng.uniform(0, 0.5, (POSES, 3))])
    return geometry.exp(np.cumsum(steps, axis=0))


@pytest.fixture(scope="module")
def equations(poses):
    """Every pose sees about 60 walls of 200, and a wall is where the mean of those that see it has it."""
    rng = np.random.default_rng(1)
    jacobians = np.zeros((200, POSES, 6))
    for wall, seen in enumerate(rng.random((200, POSES)) < 0.3):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        for pose in np.flatnonzero(seen):
            rotation = poses[pose, :3, :3]
            lever = rng.uniform(-5, 5, 3)
            jacobians[wall, pose] = np.r_[np.cross(lever, rotation.T @ normal), rotation.T @ normal]
        jacobians[wall, seen] *= 30.0
    hessian = np.zeros((6 * POSES, 6 * POSES))
    for wall in jacobians:
        seen = np.any(wall != 0, axis=1)
        rows = np.zeros((POSES, 6 * POSES))
        for pose in np.flatnonzero(seen):
            rows[pose, 6 * pose : 6 * pose + 6] = wall[pose]
        rows[seen] -= rows[seen].mean(axis=0)
        hessian += rows.T @ rows
    hessian += 1e-3 * np.eye(6 * POSES)
    return normal_equations.from_dense(hessian, rng.normal(size=(POSES, 6)), 1.0)


@pytest.fixture(scope="module")
def free():
    free = np.ones((POSES, 6), bool)
    free[0] = False
    return free


def bodies(groups):
    """(6 B, 6 G): from motions of groups to those of poses, dense."""
    whole = np.zeros((6 * POSES, 6 * groups.count))
    for pose, motion in enumerate(groups.motion):
        group = pose // groups.size
        whole[6 * pose : 6 * pose + 6, 6 * group : 6 * group + 6] = motion
    return whole


def naive_inverse(hessian, groups, free):
    """By definition: the inverse over rigid motions of groups, and over what is orthogonal to these within each group."""
    motion = bodies(groups)
    inverse = motion @ np.linalg.inv(motion.T @ hessian @ motion) @ motion.T
    for group in range(groups.count):
        mine = [6 * pose + axis for pose in range(POSES) for axis in range(6)
                if pose // groups.size == group and free[pose, axis]]  # fmt: skip
        block, own = hessian[np.ix_(mine, mine)], motion[mine][:, 6 * group : 6 * group + 6]
        within = np.linalg.inv(block) - own @ np.linalg.inv(own.T @ block @ own) @ own.T
        inverse[np.ix_(mine, mine)] += within
    return inverse


def test_a_rigid_motion_of_a_group_moves_its_poses_by_their_lever(poses):
    groups = two_level.groups_of(poses, SIZE)
    step = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.3]) * 1e-3
    first = poses[SIZE]
    moved = first @ geometry.exp(step) @ geometry.inverse(first[None])[0] @ poses[SIZE : 2 * SIZE]
    by_pose = geometry.log(geometry.inverse(poses[SIZE : 2 * SIZE]) @ moved)
    np.testing.assert_allclose(groups.motion[SIZE : 2 * SIZE] @ step, by_pose, atol=1e-12)
    assert not groups.motion[0].any()
    assert groups.number.tolist() == [pose // SIZE for pose in range(POSES)]
    assert groups.count == 6


def test_split_keeps_pairs_within_groups_and_groups_as_bodies(poses, equations):
    groups = two_level.groups_of(poses, SIZE)
    both = two_level.split(equations, groups)
    hessian, motion = equations.dense(), bodies(groups)
    same = np.repeat(np.repeat(groups.number[:, None] == groups.number, 6, 0), 6, 1)
    np.testing.assert_allclose(both.inner.dense(), np.where(same, hessian, 0.0))
    expected = motion.T @ np.where(same, 0.0, hessian) @ motion
    np.testing.assert_allclose(both.bodies.dense(), expected, atol=1e-12 * np.abs(hessian).max())
    assert np.array_equal(both.gradient, equations.gradient)
    assert both.inner.cost == equations.cost


def test_the_sum_of_two_terms_is_the_split_sum(poses, equations):
    groups = two_level.groups_of(poses, SIZE)
    rows = np.arange(POSES - 1, dtype=np.int32)
    chain = NormalEquations(rows, rows + 1, np.full((POSES - 1, 6, 6), 0.1), np.ones((POSES, 6)), 2.0)
    together = two_level.split(equations + chain, groups)
    added = two_level.split(equations, groups) + two_level.split(chain, groups)
    for whole, summed in ((together.inner, added.inner), (together.bodies, added.bodies)):
        np.testing.assert_allclose(summed.dense(), whole.dense(), atol=1e-12)
        np.testing.assert_allclose(summed.gradient, whole.gradient)
        assert summed.cost == whole.cost


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_the_step_is_that_of_bodies_and_that_within_them(poses, equations, free, damping):
    groups = two_level.groups_of(poses, SIZE)
    both = two_level.split(equations, groups)
    step = two_level.solve_step(both, damping, free, METRIC)
    hessian = equations.dense() + damping * np.diag(np.tile(METRIC, POSES))
    # damping is of each pose, so that groups hear of it as bodies
    same = np.repeat(np.repeat(groups.number[:, None] == groups.number, 6, 0), 6, 1)
    expected = (
        -naive_inverse(np.where(same, hessian, equations.dense()), groups, free) @ equations.gradient.ravel()
    )
    np.testing.assert_allclose(step.blocks.ravel(), expected, atol=1e-9 * np.abs(expected).max())
    assert not step.blocks[0].any()


def test_covariances_are_the_blocks_of_what_solves(poses, equations, free):
    groups = two_level.groups_of(poses, SIZE)
    factors = two_level.factorize(two_level.split(equations, groups), 0.0, free)
    whole = factors.solve(np.eye(6 * POSES))
    np.testing.assert_allclose(whole, whole.T, atol=1e-12 * np.abs(whole).max())
    assert np.linalg.eigvalsh(whole)[0] > -1e-12 * np.abs(whole).max()
    here = np.arange(POSES)
    blocks = whole.reshape(POSES, 6, POSES, 6)[here, :, here]
    np.testing.assert_allclose(factors.covariance().blocks, blocks, atol=1e-12 * np.abs(whole).max())


def test_steps_one_after_another_end_where_the_whole_hessian_does(poses, equations, free):
    """Of a quadratic cost, whose gradient is known anywhere."""
    groups = two_level.groups_of(poses, SIZE)
    both = two_level.split(equations, groups)
    hessian, start = equations.dense(), equations.gradient.ravel()
    solved = np.zeros(6 * POSES)
    solved[6:] = -np.linalg.solve(hessian[6:, 6:], start[6:])
    at, left = np.zeros(6 * POSES), []
    for _ in range(30):
        gradient = (start + hessian @ at).reshape(POSES, 6)
        inner = NormalEquations(both.inner.rows, both.inner.columns, both.inner.blocks, gradient, 0.0)
        at = (
            at
            + two_level.solve_step(
                two_level.TwoLevelEquations(groups, inner, both.bodies), 0.0, free
            ).blocks.ravel()
        )
        error = at - solved
        left.append(float(np.sqrt(error @ hessian @ error)))
    whole = float(np.sqrt(solved @ hessian @ solved))
    assert left[0] < 0.5 * whole
    assert left[-1] < 1e-6 * whole


def test_equations_that_are_not_positive_have_no_step(poses, equations, free):
    groups = two_level.groups_of(poses, SIZE)
    both = two_level.split(equations.scaled(-1.0), groups)
    assert two_level.solve_step(both, 0.0, free) is None
