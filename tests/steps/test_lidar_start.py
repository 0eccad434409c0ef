"""Where the LiDAR bundle adjustment of a part begins, and begins again."""

import numpy as np
import pytest

from lvba.blocks import decoded_scans, split
from lvba.blocks.split import SplitConfig
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.io import reference
from lvba.io.dataset import open_dataset
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import LidarConfig
from lvba.loop_closure import rough_motions, rough_poses
from lvba.simulate import simulate
from lvba.simulate.disturbances import Disturbances
from lvba.steps.lidar import solve_lidar
from lvba.trajectory import pose_error


@pytest.fixture(scope="module")
def round_a_cabinet(tmp_path_factory):
    """By an odometry that is 10 cm off at every step: too much to start from, too little to notice."""
    root = tmp_path_factory.mktemp("cabinet")
    disturb = Disturbances(rough_drift=0.3, range_noise=0.03)
    sizes = {"frames": 2, "scans": 40, "width": 64, "height": 48, "points_per_scan": 4000}
    simulate("cabinet", root, difficulty="hard", seed=5, disturb=disturb, **sizes)
    return open_dataset(root)


@pytest.fixture(scope="module")
def wrong_minimum(round_a_cabinet):
    """What the bundle adjustment comes to from the rough poses."""
    return bundle_adjustment.refine(
        recordings.load_scans(round_a_cabinet),
        round_a_cabinet.scans.world_from_sensor,
        sensor_position=round_a_cabinet.sensor_position_scan,
    )


def solved(dataset):
    [part] = split.parts(dataset, SplitConfig(), split.Load(4000, 0.0))
    piece = decoded_scans.decode_scans(dataset, (0, 40))
    return solve_lidar(dataset, part, [((0, 40), lambda: piece)], LidarConfig())


def test_scans_that_end_in_a_wrong_minimum_are_registered_and_refined_again(round_a_cabinet, wrong_minimum):
    dataset, sensor = round_a_cabinet, round_a_cabinet.sensor_position_scan
    truth = reference.read_reference(f"{dataset.root}/reference").scans.world_from_sensor
    scans, rough = recordings.load_scans(dataset), dataset.scans.world_from_sensor
    surfels = rough_poses.surfels_of(scans, sensor)
    assert len(rough_motions.contradicted(surfels, rough)) == 0
    alone = wrong_minimum.world_from_scan
    assert pose_error(alone, truth).ate_m > 0.1
    assert rough_motions.typically_off(surfels, alone) > rough_motions.WRONG_MINIMUM_M
    stage = solved(dataset)
    assert pose_error(stage.result.world_from_scan, truth).ate_m < 0.005
    assert rough_motions.typically_off(surfels, stage.result.world_from_scan) < 0.02
    assert stage.rough_error.step_m > 0.05
    assert len(stage.rough_error.open_after) == 0
    assert len(stage.rough_error.left_after) == 0


@pytest.mark.parametrize("lost", ["start", "refine"])
def test_another_start_that_leads_nowhere_costs_nothing(round_a_cabinet, wrong_minimum, monkeypatch, lost):
    """Motions that leave poses open, or poses from which no plane is seen twice."""
    results = [wrong_minimum]

    def degenerate(*_, **__):
        raise DegenerateProblemError(lost)

    def refine(*_, **__):
        return results.pop() if results else degenerate()

    monkeypatch.setattr(bundle_adjustment, "refine", refine)
    if lost == "start":
        monkeypatch.setattr(rough_poses, "start", degenerate)
    stage = solved(round_a_cabinet)
    assert not results
    assert np.array_equal(stage.result.world_from_scan, wrong_minimum.world_from_scan)
    assert stage.rough_error is None


def test_nothing_is_off_where_surfaces_tell_too_little(round_a_cabinet):
    """Of no scan, of one, and of scans that see too little."""
    rough = round_a_cabinet.scans.world_from_sensor
    assert rough_motions.typically_off([], rough[:0]) == 0.0
    assert rough_motions.typically_off([None], rough[:1]) == 0.0
    assert rough_motions.typically_off([None] * 40, rough) == 0.0
