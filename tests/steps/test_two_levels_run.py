"""A whole run of a compact place at two levels ends where the run with all pairs of scans does."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from lvba import pipeline, plan, simulate
from lvba.blocks import lidar_joint
from lvba.blocks.split import SplitConfig
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.kernels.lidar import TILE
from lvba.pipeline import Config
from lvba.trajectory import pose_error

SCANS = 3 * TILE + 4
CONFIG = replace(Config(), split=SplitConfig(by="count", size=20))
BEFORE = ("input", "survey", "scans", "lidar-part", "lidar-loop")
"""Steps that come before the parts are merged."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder of thin scans, with the truth and without images."""
    folder = tmp_path_factory.mktemp("two_levels") / "site"
    sizes = {"width": 32, "height": 32, "points_per_scan": 3000}
    simulate.simulate("site", folder, frames=2, scans=SCANS, length=float(SCANS), seed=1, **sizes)
    shutil.rmtree(folder / "all_image")
    return folder


@pytest.fixture(scope="module")
def runs(site):
    """Artifacts by the name of their steps, of all pairs of scans and at two levels; parts are solved once."""
    dataset = open_dataset(site)
    work = pipeline.refine(dataset, CONFIG)
    names = {key: step.name for key, step in work.steps.items()}
    exact = plan.run(work, {})
    known = {key: value for key, value in exact.items() if names[key].startswith(BEFORE)}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(lidar_joint, "MOST_PAIRS", 100)
        grouped = plan.run(work, known)
    return [{names[key]: value for key, value in store.items()} for store in (exact, grouped)]


def test_a_run_at_two_levels_ends_where_all_pairs_do(site, runs):
    exact, grouped = runs
    assert (exact["lidar-start"].group_size, grouped["lidar-start"].group_size) == (0, TILE)
    bodies = [run["lidar-linearize-final-0"].bodies for run in runs]
    assert bodies[0] is None
    assert len(bodies[1].gradient) == -(-SCANS // TILE)
    rough = open_dataset(site).scans.world_from_sensor
    found, others = (run["visual-gate"].world_from_scan for run in (grouped, exact))
    truth = read_reference(site / "reference").scans.world_from_sensor
    apart = pose_error(found, others)
    assert apart.ate_max_m < 3e-4
    assert apart.rotation_max_deg < 1e-3
    # these scans are thin: the run with all pairs is itself off by 1.6 mm
    assert pose_error(found, truth).ate_m < 0.003 < 0.05 < pose_error(rough, truth).ate_m
    rounds = grouped["facts"]["merge"]["scan_rounds"]
    assert not any(each["refused"] for each in rounds)
    assert [each["small"] for each in rounds[-2:]] == [True, True]
    assert grouped["lidar"].result.converged


def test_covariances_at_two_levels_are_those_of_all_pairs(runs):
    deviation = [np.sqrt(np.diagonal(run["lidar"].result.covariance, axis1=1, axis2=2)) for run in runs]
    np.testing.assert_allclose(deviation[1], deviation[0], rtol=0.1)
