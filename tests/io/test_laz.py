"""LAS and LAZ files, read back with laspy."""

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import laz

laspy = pytest.importorskip("laspy")


def chunk(count, seed):
    rng = np.random.default_rng(seed)
    xyz = rng.normal(0, 10, (count, 3)) + np.array([5e5, 5e6, 100])
    return {
        **dict(zip("xyz", xyz.T)),
        **{name: rng.integers(0, 256, count).astype(np.uint8) for name in ("red", "green", "blue", "views")},
        "spread": rng.random(count).astype(np.float32),
    }


@pytest.mark.parametrize("name", ["map.laz", "map.las"])
def test_points_colors_and_extra_columns_are_read_back(tmp_path, name):
    chunks = [chunk(100, 0), chunk(1, 1), chunk(50, 2)]
    extra = {"views": np.dtype(np.uint8), "spread": np.dtype(np.float32)}
    laz.write_las(tmp_path / name, chunks, extra, np.array([5e5 - 40, 5e6 - 40, 60]))
    las = laspy.read(tmp_path / name)
    assert len(las.points) == 151
    for axis in "xyz":
        np.testing.assert_allclose(las[axis], np.concatenate([c[axis] for c in chunks]), atol=6e-5)
    np.testing.assert_array_equal(las["red"], np.concatenate([c["red"].astype(int) * 257 for c in chunks]))
    np.testing.assert_array_equal(las["views"], np.concatenate([c["views"] for c in chunks]))
    np.testing.assert_array_equal(las["spread"], np.concatenate([c["spread"] for c in chunks]))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        laz.write_las(tmp_path / "nowhere" / "a.las", [chunk(3, 0)], {}, np.zeros(3))
