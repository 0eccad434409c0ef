"""A corridor: planes let scans slide along it, and images do not."""

import numpy as np

from lvba import pipeline, plan, simulate
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.trajectory import align


def scan_error(poses, truth):
    """m, root mean square, after alignment."""
    off = (align(poses, truth) @ poses)[:, :3, 3] - truth[:, :3, 3]
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def test_scans_of_a_corridor_slide_to_where_their_images_have_them(tmp_path):
    folder = tmp_path / "corridor"
    sizes = {"width": 240, "height": 180, "points_per_scan": 3000}
    simulate.simulate("corridor", folder, frames=20, scans=20, seed=3, difficulty="easy", **sizes)
    work = pipeline.refine(open_dataset(folder))
    names = {key: step.name for key, step in work.steps.items()}
    made = {names[key]: value for key, value in plan.run(work, {}).items()}
    truth = read_reference(folder / "reference").scans.world_from_sensor
    assert len(made["lidar"].result.degenerate_directions) == 1
    by_planes = scan_error(made["lidar-gate"].world_from_scan, truth)
    with_images = scan_error(made["fusion-gate"].world_from_scan, truth)
    assert made["fusion-gate"].verdict.accepted
    assert by_planes > 0.01
    assert with_images < 0.25 * by_planes
