"""Cameras that refined ones confirm: how far both are apart, and what the former are expected to be off."""

import numpy as np
import pytest

from lvba import geometry
from lvba.steps import camera_agreement

SIGMA = np.repeat([1e-4, 2e-3], 3)


@pytest.fixture
def cameras():
    """300 refined cameras, their covariances, and others that are off by so many of their standard deviations."""
    rng = np.random.default_rng(4)
    refined = geometry.exp(rng.normal(size=(300, 6)))
    root = rng.normal(size=(300, 6, 6)) * SIGMA[:, None]

    def apart_by(sigmas):
        return geometry.retract(refined, sigmas * np.einsum("nij,nj->ni", root, rng.normal(size=(300, 6))))

    return refined, root @ np.swapaxes(root, 1, 2), apart_by


@pytest.mark.parametrize("sigmas", [0.5, 1.0, 3.0])
def test_cameras_are_apart_by_standard_deviations_of_what_refined_ones_are_off(cameras, sigmas):
    refined, covariance, apart_by = cameras
    others = apart_by(sigmas)
    apart = camera_agreement.apart(refined, covariance, others)
    assert apart.sigmas == pytest.approx(sigmas, rel=0.05)
    off = np.linalg.norm(refined[:, :3, 3] - others[:, :3, 3], axis=1)
    assert apart.position_m == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-3)
    turn = geometry.log(geometry.inverse(others) @ refined)[:, :3]
    assert apart.rotation_deg == pytest.approx(np.degrees(np.sqrt((turn**2).sum(1).mean())), rel=1e-6)


def test_cameras_of_which_nothing_is_known_are_passed_over(cameras):
    refined, covariance, apart_by = cameras
    others = apart_by(1.0)
    known = camera_agreement.apart(refined[2:], covariance[2:], others[2:])
    covariance[0], covariance[1] = np.nan, 0.0
    assert camera_agreement.apart(refined, covariance, others) == known
    assert camera_agreement.apart(refined[:2], covariance[:2], others[:2]) is None


def test_what_cameras_are_expected_to_be_off_is_what_truths_about_refined_ones_say():
    """Truths drawn about one refined camera: their mean squared differences from another one, by itself."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6)) * SIGMA[:, None]
    refined = geometry.exp(rng.normal(size=(1, 6)))
    other = geometry.retract(refined, np.array([[2e-4, 0.0, -3e-4, 3e-3, -1e-3, 5e-3]]))
    truths = geometry.retract(np.repeat(refined, 40_000, axis=0), rng.normal(size=(40_000, 6)) @ root.T)
    errors = geometry.log(geometry.inverse(other) @ truths)
    [expected] = camera_agreement.expected_squares(refined, (root @ root.T)[None], other)
    drawn = errors.T @ errors / len(errors)
    np.testing.assert_allclose(drawn / np.outer(SIGMA, SIGMA), expected / np.outer(SIGMA, SIGMA), atol=0.3)
    assert np.isnan(camera_agreement.expected_squares(refined, np.full((1, 6, 6), np.nan), other)).all()
