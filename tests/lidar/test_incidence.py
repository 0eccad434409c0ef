"""Angles of incidence at single points, against those of surfaces that are known."""

import numpy as np
import pytest

from lvba.kernels import flatness as kernels
from lvba.lidar import incidence


def wall(rng, count, distance, size, tilt_deg, noise):
    """Points (count, 3) of a square that beams from the origin meet, tilted against the first axis, and true cosines."""
    turn = np.radians(tilt_deg)
    along, normal = np.array([np.sin(turn), np.cos(turn), 0.0]), np.array([np.cos(turn), -np.sin(turn), 0.0])
    place = rng.uniform(-size / 2, size / 2, (count, 2))
    true = [distance, 0, 0] + place[:, :1] * along + place[:, 1:] * [0, 0, 1]
    rays = true / np.linalg.norm(true, axis=1)[:, None]
    return (true + noise * rng.normal(size=(count, 1)) * rays).astype(np.float32), np.abs(rays @ normal)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
@pytest.mark.parametrize(("distance", "size", "tilt"), [(1.5, 1.5, 0.0), (1.5, 1.5, 50.0), (8.0, 5.0, 70.0)])
def test_noise_does_not_turn_surfaces(distance, size, tilt, noise):
    """Points 2 cm from each other with as much noise: planes through few of them stand anyhow."""
    points, true = wall(np.random.default_rng(1), 5000, distance, size, tilt, noise)
    off = incidence.cosines(points, np.zeros(3)) - true
    assert abs(off.mean()) < 0.01
    assert np.sqrt(np.mean(off**2)) < 0.03


def test_surfaces_that_meet_are_told_apart():
    rng = np.random.default_rng(2)
    across = np.c_[np.full(3000, 4.0), rng.uniform(-2, 2, 3000), rng.uniform(-1, 1, 3000)]
    beside = np.c_[rng.uniform(0.5, 4, 3000), np.full(3000, -2.0), rng.uniform(-1, 1, 3000)]
    true = np.concatenate([across, beside])
    rays = true / np.linalg.norm(true, axis=1)[:, None]
    cosine = np.abs(np.concatenate([rays[:3000, 0], rays[3000:, 1]]))
    points = true + 0.01 * rng.normal(size=(6000, 1)) * rays
    off = np.abs(incidence.cosines(points.astype(np.float32), np.zeros(3)) - cosine)
    assert abs(off.mean()) < 0.03
    assert np.quantile(off, 0.9) < 0.05


def test_the_sensor_need_not_be_where_the_scan_frame_is():
    points, true = wall(np.random.default_rng(3), 2000, 4.0, 3.0, 30.0, 0.005)
    position = np.array([0.5, -0.3, 0.2])
    moved = incidence.cosines((points + position).astype(np.float32), position)
    np.testing.assert_allclose(moved, true, atol=0.05)


def street(rng, width):
    """Points (N, 3) of a sensor that turns, 5 m from the wall of a street with two projections, and true cosines, (N,);
    which points are on faces of projections that look along the street, (N,) bool."""
    azimuth, elevation = np.radians(np.arange(0.0, 60.0, 0.5)), np.radians(np.arange(-20.0, 8.0, 0.5))
    flat, up = np.meshgrid(azimuth + rng.uniform(0, 0.01), elevation + rng.uniform(0, 0.01))
    rays = np.stack([np.cos(up) * np.cos(flat), np.cos(up) * np.sin(flat), np.sin(up)], -1).reshape(-1, 3)
    ahead, beside, down = rays[:, 0], np.maximum(rays[:, 1], 1e-3), np.maximum(-rays[:, 2], 1e-3)
    length, cosine = np.minimum(5 / beside, 2 / down), np.where(5 / beside < 2 / down, beside, down)
    for begins in (20.0, 30.0):
        face, side = begins / ahead, (5 - width) / beside
        on_face = (face * beside > 5 - width) & (face * beside < 5) & (face < length)
        on_side = (side * ahead > begins) & (side * ahead < begins + 1) & (side < length)
        length = np.where(on_face, face, np.where(on_side, side, length))
        cosine = np.where(on_face, ahead, np.where(on_side, beside, cosine))
    near = length < 60
    points = rays * (length + 0.02 * rng.normal(size=len(length)))[:, None]
    return points[near].astype(np.float32), cosine[near], ((cosine > 0.8) & (length > 15))[near]


@pytest.mark.parametrize("width", [0.7, 1.0, 2.0])
def test_small_surfaces_far_down_a_street_are_seen_for_themselves(width):
    """They hold scans along the street. Neighborhoods that reach beyond them see one oblique plane through all of it."""
    off = []
    for seed in range(4):
        points, cosine, face = street(np.random.default_rng(seed), width)
        off.append((incidence.cosines(points, np.zeros(3)) - cosine)[face])
    assert len(np.concatenate(off)) > 300
    assert abs(np.concatenate(off).mean()) < 0.03


def test_points_without_a_surface_take_that_of_the_nearest():
    rng = np.random.default_rng(4)
    points, true = wall(rng, 2000, 5.0, 2.0, 40.0, 0.003)
    stray = (points[:20] * rng.uniform(0.8, 0.9, (20, 1))).astype(np.float32)
    cosine = incidence.cosines(np.concatenate([points, stray]), np.zeros(3))
    np.testing.assert_allclose(cosine[2000:], true[:20], atol=0.05)


def test_few_points_and_no_points():
    points, _ = wall(np.random.default_rng(5), 800, 5.0, 2.0, 0.0, 0.003)
    np.testing.assert_array_equal(incidence.cosines(points[:5], np.zeros(3)), np.ones(5))
    assert len(incidence.cosines(points[:0], np.zeros(3))) == 0
    holed = points.copy()
    holed[7] = np.nan
    cosine = incidence.cosines(holed, np.zeros(3))
    assert cosine[7] == 1.0
    np.testing.assert_allclose(np.delete(cosine, 7), 0.99, atol=0.05)


def test_the_kernel_takes_the_flattest_neighborhoods_as_its_plain_twin_does():
    rng = np.random.default_rng(6)
    points = rng.normal(size=(400, 3)) * [2.0, 1.0, 0.2]
    beam = rng.normal(size=(50, 3))
    beam /= np.linalg.norm(beam, axis=1)[:, None]
    normal, flatness = np.zeros((50, 3)), np.full(50, np.inf)
    best = np.full(50, np.inf)
    for _ in range(3):
        near = rng.integers(0, 400, (50, 12))
        kernels.flattest(points, near, beam, normal, flatness)
        for m in range(50):
            off = points[near[m]] - points[near[m]].mean(axis=0)
            spread, axes = np.linalg.eigh(off.T @ off)
            flat = 12 / 9 * spread[0] / spread[1] / (axes[:, 0] @ beam[m]) ** 2
            if flat < best[m]:
                best[m] = flat
                assert abs(axes[:, 0] @ normal[m]) == pytest.approx(1.0)
    np.testing.assert_allclose(flatness, best)


def test_places_at_one_of_many_points_tell_what_all_points_would(monkeypatch):
    rng = np.random.default_rng(7)
    across = np.c_[np.full(9000, 4.0), rng.uniform(-2, 2, 9000), rng.uniform(-1, 1, 9000)]
    beside = np.c_[rng.uniform(0.5, 4, 9000), np.full(9000, -2.0), rng.uniform(-1, 1, 9000)]
    true = np.concatenate([across, beside])
    rays = true / np.linalg.norm(true, axis=1)[:, None]
    points = (true + 0.01 * rng.normal(size=(18000, 1)) * rays).astype(np.float32)
    cosine = np.abs(np.concatenate([rays[:9000, 0], rays[9000:, 1]]))
    few = incidence.cosines(points, np.zeros(3)) - cosine
    monkeypatch.setattr(incidence, "_PLACES", 1.0)
    every = incidence.cosines(points, np.zeros(3)) - cosine
    assert np.sqrt(np.mean(few**2)) < 1.2 * np.sqrt(np.mean(every**2)) + 0.002
