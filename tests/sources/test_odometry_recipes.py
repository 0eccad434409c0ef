"""The recipes of docs/odometry_programs.md, with stand-ins that take each program's arguments and write where it does.

The programs themselves are no part of the tests: each needs an environment of its own. `benchmarks/odometry_chain.py`
runs them.
"""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.sources.odometry import external

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "docs" / "examples" / "odometry"
POSE = "1700000000.1 1 2 3 0 0 0 1"

STAND_INS = {
    "kiss_icp": (
        "kiss_icp_pipeline",
        '[ "$1" = "$BAG" ] && [ "$2 $3" = "--topic /points" ]\n'
        'mkdir "$kiss_icp_out_dir/now" && ln -s now "$kiss_icp_out_dir/latest"\n'
        'echo "$POSE" > "$kiss_icp_out_dir/now/walk_poses_tum.txt"\n',
        "/points",
    ),
    "genz_icp": (
        "genz_icp_pipeline",
        '[ "$1" = "$BAG" ] && [ "$2 $3" = "--topic /points" ]\n'
        'mkdir "$genz_icp_out_dir/now" && ln -s now "$genz_icp_out_dir/latest"\n'
        'echo "$POSE" > "$genz_icp_out_dir/now/walk_poses_tum.txt"\n',
        "/points",
    ),
    "rko_lio": (
        "rko_lio",
        '[ -d "$1" ] && [ "$(cat "$1/$(basename "$BAG")")" = content ] && [ "$2 $3" = "--dataloader rosbag" ]\n'
        '[ "$4 $6 $7" = "--log_dir --run_name run" ] && [ "$8 $9" = "--lidar /points" ]\n'
        'mkdir -p "$5/run_0" && echo "$POSE" > "$5/run_0/run_0_tum.txt"\n',
        "/points /imu",
    ),
    "se3_lio": (
        "se3_lio_pipeline",
        '[ "$1 $2 $3 $4" = "$BAG --config rig.yaml --output" ]\n'
        '[ "$6 $7 $8" = "--no-progress --lidar-topic /points" ]\n'
        'echo "$POSE" > "$5/walk.bag_se3lio.tum"\n',
        "rig.yaml /points /imu",
    ),
}
"""By recipe: the program, what it checks and writes, and the arguments after the bag and the output."""


@pytest.fixture
def bag(tmp_path, monkeypatch):
    path = tmp_path / "my walk.bag"
    path.write_text("content")
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("BAG", str(path))
    monkeypatch.setenv("POSE", POSE)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return path


def stand_in(folder, name, body):
    program = folder / "bin" / name
    program.write_text(f"#!/bin/sh\nset -e\n{body}")
    program.chmod(0o755)


@pytest.mark.parametrize("recipe", STAND_INS)
def test_a_recipe_gives_the_poses_and_leaves_nothing(recipe, tmp_path, bag):
    name, body, arguments = STAND_INS[recipe]
    stand_in(tmp_path, name, body)
    poses = external.run(f"sh {RECIPES / recipe}.sh {{bag}} {{out}} {arguments}", bag, lambda: None)
    np.testing.assert_allclose(poses.world_from_sensor[0, :3, 3], [1, 2, 3])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bin", "my walk.bag"]


@pytest.mark.parametrize("recipe", STAND_INS)
def test_a_program_that_fails_is_one_error_with_its_words(recipe, tmp_path, bag):
    name, _, arguments = STAND_INS[recipe]
    stand_in(tmp_path, name, "echo no points in this bag\nexit 4\n")
    with pytest.raises(InputError, match="exit code 4: no points in this bag"):
        external.run(f"sh {RECIPES / recipe}.sh {{bag}} {{out}} {arguments}", bag, lambda: None)


def test_every_recipe_is_in_the_table_of_its_page():
    page = (ROOT / "docs" / "odometry_programs.md").read_text()
    assert {path.stem for path in RECIPES.glob("*.sh")} == set(STAND_INS)
    assert set(re.findall(r"\(examples/odometry/(\w+)\.sh\)", page)) == set(STAND_INS)
