"""How poses move by numbers that scans share, against trajectories that are bent by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.lidar.pose_response import PoseResponse, extent_of
from lvba.trajectory import align_for_errors, pose_error


def street(scans, length):
    """Along x, sensors turned at random."""
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, :3, :3] = Rotation.random(scans, random_state=3).as_matrix()
    poses[:, 0, 3] = np.linspace(0, length, scans)
    return poses


def moved(poses, turn, shift):
    """(S, 6, 1), local tangent: of turns (S, 3) and shifts (S, 3) in the world."""
    inverse = poses[:, :3, :3].transpose(0, 2, 1)
    return np.concatenate([inverse @ turn[:, :, None], inverse @ shift[:, :, None]], axis=1)


def bent(poses, curvature):
    """Turns about y and the shifts that go with them."""
    x = poses[:, 0, 3]
    turn, shift = np.zeros((len(x), 3)), np.zeros((len(x), 3))
    turn[:, 1], shift[:, 2] = -curvature * x, 0.5 * curvature * x**2
    return turn, shift


def test_a_common_motion_and_a_common_scale_are_no_response():
    poses = street(30, 20.0)
    turn = np.array([0.1, 0.2, -0.3])
    common = np.array([1.0, -2.0, 3.0]) + 0.01 * poses[:, :3, 3] + np.cross(turn, poses[:, :3, 3])
    response = PoseResponse.of(moved(poses, np.tile(turn, (30, 1)), common), poses)
    assert response.by(np.eye(1), 5.0) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert PoseResponse.of(np.ones((2, 6, 1)), np.tile(np.eye(4), (2, 1, 1))).by(np.eye(1), 9.0) == (0.0, 0.0)


def test_what_bends_a_piece_of_a_street_is_foretold_of_the_whole():
    """By numbers that are as uncertain as the moment says."""
    curvature, whole = 1e-4, street(200, 300.0)
    pieces = [slice(0, 20), slice(100, 120)]
    response = sum(
        (PoseResponse.of(moved(whole[s], *bent(whole[s], 0.5 * curvature)), whole[s]) for s in pieces),
        PoseResponse.nothing(1),
    )
    turn, shift = response.by(4.0 * np.eye(1), extent_of(whole))
    tangent = moved(whole, *bent(whole, curvature))[:, :, 0]
    # turned about its own place, then moved: both in the world
    changed = whole @ np.stack([geometry.exp(np.r_[each[:3], 0, 0, 0]) for each in tangent])
    changed[:, :3, 3] = whole[:, :3, 3] + np.einsum("sij,sj->si", whole[:, :3, :3], tangent[:, 3:])
    aligned = align_for_errors(changed, whole).reference_from_estimate
    error = pose_error(changed, whole, aligned=aligned)
    # aligned by orientations, too, which lets it tilt a little
    assert shift == pytest.approx(error.ate_m, rel=0.06)
    assert np.degrees(turn) == pytest.approx(error.rotation_deg, rel=0.03)
    short = response.by(4.0 * np.eye(1), extent_of(whole[:20]))
    assert short[1] < 0.01 * shift


def test_a_place_that_is_walked_over_and_over_is_no_longer_than_it_is():
    once = street(50, 10.0)
    assert extent_of(np.concatenate([once] * 7)) == pytest.approx(extent_of(once))
    assert extent_of(once) == pytest.approx(10.0 / np.sqrt(12), rel=0.03)


def test_numbers_are_taken_apart():
    poses, rng = street(12, 9.0), np.random.default_rng(4)
    tangent = rng.normal(size=(12, 6, 3))
    whole = PoseResponse.of(tangent, poses)
    only = PoseResponse.of(tangent[:, :, 1:], poses)
    part = whole.of_numbers(slice(1, 3))
    assert part.by(np.eye(2), 7.0) == pytest.approx(only.by(np.eye(2), 7.0))
    assert part.by(np.eye(2), 7.0)[0] < whole.by(np.eye(3), 7.0)[0]


def test_a_turn_of_all_scans_in_their_own_frames_is_one_and_moves_no_scan():
    """As by beams that go higher than the sensor says: along a street as well as round a corner."""
    for heading in (np.zeros(40), np.linspace(0, 1.5, 40)):
        poses = np.tile(np.eye(4), (40, 1, 1))
        poses[:, :3, :3] = Rotation.from_euler("z", heading[:, None]).as_matrix()
        poses[1:, :3, 3] = np.cumsum(poses[:-1, :3, 0], axis=0)
        tangent = np.zeros((40, 6, 1))
        tangent[:, 1] = 2e-3
        turn, shift = PoseResponse.of(tangent, poses).by(np.eye(1), extent_of(poses))
        assert turn == pytest.approx(2e-3, rel=0.02)
        assert shift < 0.01 * turn * extent_of(poses)
