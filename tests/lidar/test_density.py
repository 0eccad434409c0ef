import numpy as np

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
    assert density.adapted(STAGES, gather([_wall(0.005)]), 0) is STAGES
    assert density.adapted(STAGES, gather([np.zeros((0, 3), np.float32)]), 64) == STAGES
