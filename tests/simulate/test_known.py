"""What a simulated recording truly shows, made again from its own note."""

import numpy as np
import pytest

from lvba import geometry
from lvba.errors import InputError
from lvba.io.dataset import load_scan, open_dataset
from lvba.io.reference import read_reference
from lvba.simulate import cabinet, known, simulate


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    out = tmp_path_factory.mktemp("cabinet")
    simulate("cabinet", out, frames=40, seed=3, width=96, height=72, points_per_scan=4000)
    return out


def surfaces(recording):
    """(points, scan, rectangle, place, off) of all points, at the true poses."""
    dataset, scene, true = (
        open_dataset(recording),
        known.read(recording),
        read_reference(recording / "reference"),
    )
    poses = true.scans.world_from_sensor.copy()
    poses[:, :3, 3] -= dataset.origin
    scans = [load_scan(dataset, s).points for s in range(len(poses))]
    met = [scene.surface(s, points) for s, points in enumerate(scans)]
    world = [geometry.transform_points(pose, points) for pose, points in zip(poses, scans)]
    number = np.repeat(np.arange(len(scans)), [len(points) for points in scans]).astype(np.int32)
    return np.concatenate(world).astype(np.float32), number, *map(np.concatenate, zip(*met)), poses


def test_points_lie_on_what_their_beams_met(recording):
    _, _, quad, place, off, _ = surfaces(recording)
    assert (quad >= 0).mean() > 0.99
    assert np.median(off) == pytest.approx(0.6745 * 0.02, rel=0.1), "the range noise of a scan is 20 mm"
    wide = np.isin(quad, cabinet.SIDES[:2])
    assert wide.sum() > 300
    assert np.abs(place[wide, 1]) == pytest.approx(cabinet.SIZE_M[1] / 2, abs=1e-3)


def test_a_folder_that_no_simulation_wrote_is_told(tmp_path):
    with pytest.raises(InputError, match=r"simulation\.json"):
        known.read(tmp_path)
