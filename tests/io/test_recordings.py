"""The real recordings, where they lie beside the checkout."""

from pathlib import Path

import numpy as np
import pytest

from lvba import geometry
from lvba.io import tum
from lvba.io.dataset import load_image, load_scans, open_dataset
from lvba.io.reference import read_reference
from lvba.trajectory import pose_error

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not DATA.is_dir(), reason="no recordings in ../shared/data beside the checkout"),
]


@pytest.mark.parametrize(
    ("name", "scans", "pictures", "size", "points"),
    [
        ("kitti360_suburb", 50, 50, (1408, 376), 2_747_534),
        ("seven_scenes_kitchen", 100, 100, (640, 480), 2_907_399),
        ("balm_realworld", 177, 0, (0, 0), 3_351_303),
    ],
)
def test_all_frames_open_without_a_warning(
    name: str, scans: int, pictures: int, size: tuple[int, int], points: int
):
    found = open_dataset(DATA / name)
    assert found.warnings == ()
    assert (len(found.scan_paths), len(found.image_paths)) == (scans, pictures)
    assert (found.camera.width, found.camera.height) == size
    loaded = load_scans(found)
    assert sum(map(len, loaded)) == points
    assert all(np.isfinite(scan).all() for scan in loaded)
    if pictures:
        assert load_image(found, pictures - 1).shape == (size[1], size[0], 3)
        expected = found.scans.world_from_sensor @ geometry.inverse(found.camera_from_scan)
        np.testing.assert_allclose(expected, found.images.world_from_sensor, atol=2e-5)


def test_the_kitchen_s_reference_opens():
    found, reference = (
        open_dataset(DATA / "seven_scenes_kitchen"),
        read_reference(DATA / "seven_scenes_kitchen/reference"),
    )
    error = pose_error(found.scans.world_from_sensor, reference.scans.world_from_sensor)
    assert 0.05 < error.ate_m < 0.15
    assert reference.exposures is None


def test_the_oracle_s_poses_open():
    rough = tum.read_trajectory(DATA / "balm_realworld/oracle/poses_initial.txt")
    found = open_dataset(DATA / "balm_realworld")
    np.testing.assert_array_equal(rough.times, found.scans.times)
