import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import density
from lvba.lidar.bundle_adjustment import find_planes
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


def test_cells_of_several_surfaces_are_looked_into_where_there_are_no_finer_ones():
    """Dense scans with too much noise for finer cells have none."""
    assert STAGES[-1].mixed_cells
    exact, noisy = (gather([_noisy_scan(noise, seed) for seed in range(3)]) for noise in (0.002, 0.03))
    assert density.with_finer(STAGES, noisy, 4)[-1].sizes[0] < STAGES[-1].sizes[0]
    assert not density.adapted(STAGES, exact, 4)[-1].mixed_cells
    adapted = density.adapted(STAGES, noisy, 4)[-1]
    assert adapted.sizes[0] == STAGES[-1].sizes[0]
    assert adapted.mixed_cells


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


def _cluttered_scan(seed: int, noise: float, box: float = 0.4) -> np.ndarray:
    """A floor with boxes (m), each of another height, seen from above: ranges are off by `noise` (m)."""
    rng = np.random.default_rng(seed)
    height = np.random.default_rng(99).uniform(-0.7, 0.7, (40, 40))
    across = rng.uniform(0, 6, (60_000, 2))
    number = (across / box).astype(int)
    points = np.column_stack([across - 3, height[number[:, 0], number[:, 1]] - 5])
    return (points * (1 + rng.normal(0, noise / 5, (len(points), 1)))).astype(np.float32)


def test_clutter_of_large_cells_is_no_noise():
    scans = gather([_cluttered_scan(seed, noise=0.005) for seed in range(3)])
    assert density.range_noise(scans, 1.0) > 0.065
    assert density.range_noise(scans, 0.5) < 0.03
    assert density.without_noisy(STAGES, scans) == STAGES


def test_cells_too_small_for_the_noise_go_and_larger_ones_stay_whatever_clutter_is_in_them():
    scans = gather([_cluttered_scan(seed, noise=0.04, box=0.4) for seed in range(3)])
    assert 0.03125 < density.range_noise(scans, 0.5) < 0.0625
    assert density.range_noise(scans, 1.0) > 0.0625
    for before, after in zip(STAGES, density.without_noisy(STAGES, scans), strict=True):
        assert after.sizes == tuple(size for size in before.sizes if size >= 0.5)


def test_the_noise_is_that_of_plain_surfaces_where_more_than_half_of_all_cells_are_cluttered():
    plain = [_noisy_scan(0.02, seed)[::3] for seed in range(3)]
    cluttered = [_cluttered_scan(seed, noise=0.02) + np.float32([0, 0, -20]) for seed in range(3)]
    scans = gather([np.concatenate(each) for each in zip(plain, cluttered, strict=True)])
    assert density.range_noise(scans, 1.0) == pytest.approx(0.02, rel=0.15)


def _depth_image(seed: int) -> np.ndarray:
    """A shelf at one meter, aslant, and a wall at ten, of which a depth camera knows no more than steps of 0.2 m."""
    rng = np.random.default_rng(seed)
    column, row = np.meshgrid(np.arange(-160, 160) / 300, np.arange(-120, 120) / 300)
    far = 10 + rng.normal(0, 0.3, column.shape)
    near = 1 + 0.4 * row + rng.normal(0, 0.003, column.shape)
    depth = np.where(column < 0.2, near, np.round(far / 0.2) * 0.2)
    return np.stack([column * depth, row * depth, depth], axis=-1).reshape(-1, 3).astype(np.float32)


def test_steps_of_a_depth_camera_are_no_planes():
    scans = [_depth_image(seed) for seed in range(12)]
    planes, _ = find_planes(scans, np.tile(np.eye(4), (12, 1, 1)))
    far = planes.center[:, 2] > 5
    assert (planes.size[~far] < 0.2).sum() > 10
    assert not (planes.size[far] < 0.2).any()
