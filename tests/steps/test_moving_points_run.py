"""A run takes what moves out of the map and of what images are compared with, and says how much it is."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lvba import evaluation, pipeline, plan, simulate
from lvba.io.dataset import load_scan, open_dataset
from lvba.pipeline import Config
from lvba.products.map_file import MapConfig
from lvba.simulate.disturbed import Disturbances

OFF_M = 0.15
"""Of what stands, points of the same place without people are nearer."""


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A courtyard with ten people, and which points of its scans are theirs."""
    folders = [tmp_path_factory.mktemp("moving") / name for name in ("people", "nobody")]
    for folder, people in zip(folders, (10, 0), strict=True):
        simulate.simulate(
            "courtyard", folder, frames=12, scans=40, seed=3, width=160, height=120, points_per_scan=6000,
            disturb=Disturbances(people=people),
        )  # fmt: skip
    dataset, empty = (open_dataset(folder) for folder in folders)
    scans = range(len(dataset.scan_paths))
    return dataset, [
        cKDTree(load_scan(empty, s).points).query(load_scan(dataset, s).points)[0] > OFF_M for s in scans
    ]


@pytest.fixture(scope="module")
def runs(walked):
    """Artifacts by the name of their steps: without the points that move, and with them."""
    store, made = {}, []
    for removed in (True, False):
        config = Config(refine_cameras=False, remove_moving_points=removed, map=MapConfig(voxel_m=0.0))
        work = pipeline.refine(walked[0], config)
        # scans are solved once
        store = plan.run(work, store)
        made.append({step.name: store[key] for key, step in work.steps.items()})
    return made


def test_people_are_seen_and_are_not_in_the_map(walked, runs):
    people = np.concatenate(walked[1])
    static, all_points = (len(run["map"].points_world) for run in runs)
    moving = np.zeros(len(people), bool)
    moving[runs[0]["moving-points"].numbers] = True
    assert moving[people].mean() > 0.4
    assert people[moving].mean() > 0.9
    assert all_points == len(people)
    assert static == all_points - moving.sum()


def test_the_report_says_how_many_points_move(walked, runs):
    moving = runs[0]["moving-points"]
    said = [run["facts"]["lidar"]["moving_points"] for run in runs]
    assert said[0] == {"count": len(moving.numbers), "fraction": len(moving.numbers) / moving.count}
    assert said[1] == {"count": 0, "fraction": 0.0}


def test_images_show_less_that_is_not_there(runs):
    with_static, with_all = (run["evaluate"]["rough"] for run in runs)
    assert with_static.psnr_leave_one_out > with_all.psnr_leave_one_out


def test_poses_of_others_are_judged_without_what_moves(walked, monkeypatch):
    clouds = []

    def judged(states, *rest, **options):
        clouds.append([len(state.cloud) for state in states.values()])
        return {}

    monkeypatch.setattr(evaluation.evaluation, "evaluate", judged)
    monkeypatch.setattr(evaluation.report_data, "of_evaluation", lambda *of: {})
    given = evaluation.read_given(walked[0])
    for removed in (True, False):
        evaluation.report(given, Config(refine_scans=False, remove_moving_points=removed), None)
    count = sum(len(load_scan(walked[0], s).points) for s in range(len(walked[0].scan_paths)))
    assert clouds[1] == [count, count]
    assert clouds[0][0] == clouds[0][1] < 0.995 * count
