import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import density
from lvba.lidar.config import STAGES
from lvba.lidar.scan import gather


def _wall(spacing: float, seed: int = 0) -> np.ndarray:
    side = np.arange(0, 3, spacing)
    y, z = np.meshgrid(side, side)
    x = 2 + 0.01 * np.random.default_rng(seed).normal(size=y.size)
    return np.stack([x, y.ravel(), z.ravel()], axis=1).astype(np.float32)


def test_points_per_cell_counts_the_cell_of_a_typical_point():
    spacing, size = 0.05, 0.5
    found = density.points_per_cell(gather([_wall(spacing)] * 3), size)
    # the wall at x = 2 is on a face of cells: noise shares its points between two of them
    assert 0.4 * (size / spacing) ** 2 < found <= (size / spacing) ** 2


def test_dense_scans_get_finer_cells_and_sparse_ones_do_not():
    dense = density.adapted(STAGES, gather([_wall(0.005)] * 3), 64)
    sparse = density.adapted(STAGES, gather([_wall(0.1)] * 3), 64)
    assert sparse == STAGES
    for before, after in zip(STAGES, dense, strict=True):
        assert after.sizes[-len(before.sizes) :] == before.sizes
        assert after.sizes[0] < before.sizes[0]


def test_nothing_is_adapted_where_it_is_switched_off_or_there_are_no_points():
    assert density.adapted(STAGES, gather([_wall(0.005)]), 0) == STAGES
    assert density.adapted(STAGES, gather([np.zeros((0, 3), np.float32)]), 64) == STAGES


def _noisy_scan(noise: float, seed: int) -> np.ndarray:
    """A wall, one that is seen aslant, and a floor that is seen at grazing angles: ranges are off by `noise` (m)."""
    rng = np.random.default_rng(seed)
    along, up = rng.uniform(-3, 3, (2, 20_000))
    wall = np.stack([np.full(20_000, 5.3), along, up], axis=1)
    aslant = wall @ geometry.exp(np.array([0, 0, 0.9, 0, 0, 0]))[:3, :3].T
    floor = np.stack([np.full(20_000, -1.2), *rng.uniform(3, 9, (2, 20_000))], axis=1)[:, [1, 2, 0]]
    points = np.concatenate([wall, aslant, floor])
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    return (points * (1 + rng.normal(0, noise, distance.shape) / distance)).astype(np.float32)


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.05])
def test_the_noise_of_ranges_is_measured_across_surfaces_of_single_scans(noise):
    scans = gather([_noisy_scan(noise, seed) for seed in range(3)])
    assert density.range_noise(scans, 1.0) == pytest.approx(noise, rel=0.12)


def test_cells_that_are_thin_beside_the_noise_go():
    exact, noisy, worst = (
        gather([_noisy_scan(noise, seed) for seed in range(3)]) for noise in (0.01, 0.05, 1.5)
    )
    assert density.without_noisy(STAGES, exact) == STAGES
    for before, after in zip(STAGES, density.without_noisy(STAGES, noisy), strict=True):
        assert after.sizes == tuple(size for size in before.sizes if size >= 0.5)
    assert all(stage.sizes for stage in density.without_noisy(STAGES, worst))
