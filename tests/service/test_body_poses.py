"""A recording whose image_poses.txt holds the body's poses, as FAST-LIVO2 writes it, through the command line."""

import json
import shutil

import numpy as np

from lvba.io import image_poses, result_folder, tum
from lvba.io.dataset import open_dataset
from lvba.trajectory import Trajectory


def test_the_same_result_as_with_the_camera_s_poses(lvba, tiny_recording, tiny_result, tmp_path):
    folder, out = tmp_path / "body", tmp_path / "out"
    shutil.copytree(tiny_recording, folder)
    cameras = open_dataset(tiny_recording)
    bodies = image_poses.from_camera(cameras.images.world_from_sensor, "body", cameras.camera_from_scan)
    tum.write_trajectory(
        folder / "all_image" / "image_poses.txt", Trajectory(cameras.images.times, bodies), digits=15
    )
    lvba("run", folder, "--out", out)
    dataset = open_dataset(folder)
    scans, others = (tum.read_trajectory(each / "lidar_poses.txt") for each in (out, tiny_result))
    np.testing.assert_allclose(scans.world_from_sensor, others.world_from_sensor, atol=2e-9)
    exposures, others = (
        np.loadtxt(each / "exposures.csv", delimiter=",", skiprows=1) for each in (out, tiny_result)
    )
    # poses differ in the last bit, and so do pixels at edges, by which exposures are found that patches do not tell
    np.testing.assert_allclose(exposures, others, rtol=1e-6)
    assert (tiny_result / "image_poses.txt").read_text().startswith("# image_poses: camera - ")
    assert (out / "image_poses.txt").read_text().startswith("# image_poses: body - ")
    expected = result_folder.read_cameras(tiny_result, cameras).world_from_sensor
    found = result_folder.read_cameras(out, dataset).world_from_sensor
    np.testing.assert_allclose(found, expected, atol=2e-9)  # nine decimals in either file
    page, facts = (out / "report.html").read_text(), json.loads((out / "report.json").read_text())
    assert facts["dataset"]["image_poses"]["of"] == "body"
    assert "image_poses.txt holds poses of the body, and so does the file of the result" in page

    lvba("export", out, "nerfstudio")
    transforms = json.loads((out / "nerfstudio" / "transforms.json").read_text())
    flip = np.diag([1.0, -1, -1, 1])
    exported = np.array([frame["transform_matrix"] for frame in transforms["frames"]]) @ flip
    np.testing.assert_allclose(exported, expected, atol=1e-8)

    lvba("evaluate", folder, "--out", tmp_path / "judged", "--lidar-poses", out / "lidar_poses.txt",
         "--image-poses", out / "image_poses.txt", "--exposures", out / "exposures.csv", "--reference", out)  # fmt: skip
    judged = json.loads((tmp_path / "judged" / "report.json").read_text())
    assert judged["reference"]["camera"]["ate_max_m"] < 1e-7
    assert judged["reference"]["camera"]["rotation_max_deg"] < 1e-5


def test_simulated_recordings_hold_what_is_asked_for(lvba, tmp_path):
    size = ["--frames", 4, "--width", 64, "--height", 48, "--points", 200, "--length", 6]
    for kind in ("camera", "body"):
        lvba("simulate", "street", "--out", tmp_path / kind, "--image-poses", kind, *size)
    cameras, bodies = (open_dataset(tmp_path / kind) for kind in ("camera", "body"))
    assert (cameras.image_poses, bodies.image_poses) == ("camera", "body")
    np.testing.assert_allclose(bodies.images.world_from_sensor, cameras.images.world_from_sensor, atol=2e-9)
