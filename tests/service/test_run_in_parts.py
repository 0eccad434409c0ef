"""`lvba run` on a recording in parts: the undivided solution, every pose accounted for, a row for every seam."""

import json

import numpy as np
import pytest

from lvba import geometry, simulate
from lvba.io import ply, tum
from lvba.trajectory import align, pose_error

PARTS = ("--set", "split.by=count", "--set", "split.size=10")


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """30 images of 320 x 240 and as many scans, one a second; truth in reference/."""
    folder = tmp_path_factory.mktemp("parts") / "street"
    simulate.simulate(
        "street",
        folder,
        frames=30,
        scans=30,
        length=24.0,
        seed=7,
        width=320,
        height=240,
        points_per_scan=6000,
    )
    return folder


@pytest.fixture(scope="module")
def runs(street, lvba, tmp_path_factory):
    """Result folders of the undivided recording and of three parts, and of these merged without any joint round.

    In one store: what they share is made once.
    """
    outs = tmp_path_factory.mktemp("out")
    options = {
        "whole": (),
        "parts": PARTS,
        # its scans are looked at, nothing else
        "merged": (
            *PARTS, "--set", "merge.coarse_rounds=0", "--set", "merge.scan_rounds=0", "--set", "refine_cameras=false",
            "--set", "evaluate.max_images=2",
        ),
    }  # fmt: skip
    for name, more in options.items():
        lvba("run", street, "--out", outs / name, "--reference", street / "reference", *more, *store_of(outs))
    return outs


def store_of(outs):
    return "--store", outs / "stages"


def poses(out):
    return [
        tum.read_trajectory(out / name).world_from_sensor for name in ("lidar_poses.txt", "image_poses.txt")
    ]


def exposures(out):
    return np.loadtxt(out / "exposures.csv", delimiter=",", skiprows=1)[:, 1]


def report(out):
    return json.loads((out / "report.json").read_text())


def differences(out, other):
    """Of all scans and of all cameras, in the frame of the aligned scans."""
    (scans, cameras), (scans_there, cameras_there) = poses(out), poses(other)
    aligned = align(scans, scans_there)
    return pose_error(scans, scans_there, aligned=aligned), pose_error(
        cameras, cameras_there, aligned=aligned
    )


def test_parts_end_where_the_undivided_recording_does(runs):
    scans, _ = differences(runs / "parts", runs / "whole")
    # these scans are thin and few: the undivided solution is itself off by about 3 mm
    assert scans.ate_max_m < 0.0015
    assert scans.rotation_max_deg < 0.01
    ratio = np.log(exposures(runs / "parts") / exposures(runs / "whole"))
    assert np.abs(ratio - ratio.mean()).max() < 0.004


def test_cameras_of_parts_are_those_of_the_undivided_recording(runs):
    """Among themselves; where all of them are along a straight street, neither knows: driven at one speed, a time offset
    looks like a camera that sits further ahead. There they agree within what is promised."""
    cameras, cameras_there = poses(runs / "parts")[1], poses(runs / "whole")[1]
    assert pose_error(cameras, cameras_there, aligned=align(cameras, cameras_there)).ate_m < 0.001
    _, in_the_map = differences(runs / "parts", runs / "whole")
    assert in_the_map.rotation_max_deg < 0.02
    assert in_the_map.ate_m < report(runs / "whole")["reference"]["camera"]["predicted_ate_m"]


def test_joint_rounds_bring_the_parts_closer_to_the_undivided_solution(runs):
    joint, merged = (differences(runs / name, runs / "whole")[0] for name in ("parts", "merged"))
    assert joint.ate_m < merged.ate_m


def test_parts_are_as_good_as_the_whole_against_the_truth(runs):
    """Cameras among themselves: where all of them are, nothing tells; whole or in parts it is 0 to 4 mm off by luck."""
    whole, parts = (report(runs / name)["reference"] for name in ("whole", "parts"))
    for what in ("lidar", "camera_aligned"):
        assert parts[what]["ate_m"] < 1.2 * whole[what]["ate_m"] + 0.0001
        assert parts[what]["rotation_deg"] < 1.2 * whole[what]["rotation_deg"] + 0.002
    for of in (whole, parts):
        assert of["camera"]["ate_m"] < of["camera"]["predicted_ate_m"]


def test_the_report_accounts_for_every_pose_and_seam(runs):
    merge = report(runs / "parts")["merge"]
    assert [part["core_scans"] for part in merge["parts"]] == [[0, 10], [10, 20], [20, 30]]
    assert merge["poses"] == {
        "scans": 30, "scans_accounted_for": 30, "images": 30, "images_accounted_for": 30,
    }  # fmt: skip
    assert {(row["first"], row["second"]) for row in merge["seams"]} >= {(0, 1), (1, 2)}
    for row in merge["seams"][:1]:
        assert row["scans"] >= 10
        assert row["wall_m"] < row["wall_rough_m"]
        assert row["wall_m"] < 1.1 * row["wall_one_side_m"]
        assert row["exposure_ratio"] > 0
    page = (runs / "parts" / "report.html").read_text()
    assert "Parts and seams" in page
    assert "Parts and seams" not in (runs / "whole" / "report.html").read_text()


def test_the_first_pose_and_the_world_frame_stay(street, runs):
    rough = tum.read_trajectory(street / "all_pcd_body" / "lidar_poses.txt").world_from_sensor
    first = poses(runs / "parts")[0][0]
    assert np.abs(geometry.log(geometry.inverse(rough[:1]) @ first[None])).max() < 1e-6


def test_the_map_of_parts_is_that_of_the_whole_without_doubles(runs):
    maps = {name: ply.read_ply(runs / name / "map.ply") for name in ("whole", "parts")}
    sizes = {name: len(columns["x"]) for name, columns in maps.items()}
    assert 0.85 < sizes["parts"] / sizes["whole"] < 1.1
    points = np.column_stack([maps["parts"][axis] for axis in "xyz"])
    assert len(np.unique(points, axis=0)) == len(points)


def test_a_second_run_makes_nothing_anew(street, runs, lvba):
    before = {
        path.name: path.read_bytes() for path in (runs / "parts").iterdir() if path.suffix in (".txt", ".ply")
    }
    lvba("run", street, "--out", runs / "parts", "--reference", street / "reference", *PARTS,
         *store_of(runs))  # fmt: skip
    assert all(row["reused"] for row in report(runs / "parts")["stages"] if row["name"] != "input")
    assert before == {name: (runs / "parts" / name).read_bytes() for name in before}


def test_parts_too_short_are_refused_with_the_numbers(street, lvba, tmp_path):
    done = lvba(
        "run", street, "--out", tmp_path / "out", "--set", "split.by=count", "--set", "split.size=4", code=2
    )
    assert "scans of its own; at least 10" in done.stderr
