"""What the first line of a file of scan poses says."""

import numpy as np
import pytest

from lvba.dataset import DESKEWED_BY, SHIFT, TURN
from lvba.io import scan_poses, tum
from lvba.trajectory import Trajectory


@pytest.mark.parametrize("parts", [(), (TURN,), (SHIFT,), DESKEWED_BY])
def test_a_file_says_by_what_its_scans_were_deskewed(tmp_path, parts):
    path = tmp_path / "lidar_poses.txt"
    poses = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    path.write_text(tum.trajectory_text(poses, comment=scan_poses.comment(parts)))
    assert scan_poses.deskewed_by(tum.read_pose_file(path).comments) == parts


@pytest.mark.parametrize(
    "line",
    [
        "timestamp tx ty tz qx qy qz qw",
        "scans deskewed by these poses: ",
        "scans deskewed by these poses: haste",
        "scans are not deskewed",
    ],
)
def test_other_comments_say_nothing(line):
    assert scan_poses.deskewed_by(["", line]) == ()
