"""A result folder as version 0.1 wrote it opens, is exported and reported; what its stages made is not used again.

Version 0.1 had no poses of the body in image_poses.txt, no columns `scan` and `error` in map.ply, and no verdict,
expected errors or states in report.json; names of facts that have changed since are those of that version.
"""

import json

import anyio
import box_world
import httpx
import numpy as np
import pytest
import yaml

from lvba import config, retired_settings
from lvba.io import exposures, images, pcd, ply, tum
from lvba.pipeline import Config
from lvba.plan import Plan
from lvba.products import export, map_file, part_verdicts, report
from lvba.steps import verdict_data
from lvba.trajectory import Trajectory
from service.api import result_viewer
from service.cli import view_command
from service.settings import Settings
from workers import local, versions
from workers.store import ZarrStore

OLD_COLUMNS = ("x", "y", "z", "red", "green", "blue", "views", "spread")
TIMES = 100 + np.arange(4.0)


def facts(recording):
    """report.json of version 0.1: its keys, with figures made up."""
    score = {
        "psnr": 22.0,
        "ssim": 0.6,
        "coverage": 0.9,
        "psnr_leave_one_out": 21.0,
        "ssim_leave_one_out": 0.55,
    }
    scores = score | {
        "map_entropy": -3.1,
        "images": [0, 1, 2, 3],
        "per_image": {name: [20.0] * 4 for name in score},
    }
    path = {"times": TIMES.tolist(), "rough": [[0.0] * 3] * 4, "refined": [[0.0] * 3] * 4}
    history = [{"cost_before": 2.0, "cost_after": 1.0, "sigma": 0.01, "planes": 50}]
    return {
        "schema": 1,
        "dataset": {"path": str(recording), "scans": 4, "images": 4, "duration_s": 3.0, "path_length_m": 2.0},
        "config": {},
        "versions": {"lvba": "0.1.0"},
        "stages": [{"name": "lidar", "seconds": 2.0, "peak_memory_mb": 300.0, "tasks": 1, "reused": False}],
        "lidar": {"accepted": True, "reason": "accepted", "planes": 50, "converged": True, "weak_directions": [[0.0] * 6],
                  "weak_scans": [0, 1, 0, 0],
                  "loose": [0.1] * 3, "history": history},
        "visual": {"accepted": False, "reason": "input camera poses kept: images are not predicted better",
                   "exposures_accepted": True, "keyframes": 4, "scene_points": 100, "history": [],
                   "levels": [{"level": 0, "local_pairs": 10, "global_pairs": 2, "rms": 4.5, "iterations": [],
                               "inflation": 9.0, "converged": True}]},
        "fusion": {"between": 0.4, "disagreement": 1.5},
        "trajectory": {"scans": path, "images": path},
        "exposure": {"times": TIMES.tolist(), "relative": [1.0] * 4},
        "evaluation": {"rough": scores, "refined": scores},
        "merge": {
            "parts": [{"number": k, "scans": [0, 4], "core_scans": [2 * k, 2 * k + 2], "images": [0, 4],
                       "core_images": [2 * k, 2 * k + 2], "seconds": 3.0} for k in range(2)],
            "scan_rounds": [], "image_rounds": [], "loops": [],
            "seams": [{"first": 0, "second": 1, "scans": 4, "jump_m": 0.0123, "jump_deg": 0.2, "left_m": 0.001}],
            "poses": {"scans": 4, "images": 4, "scans_accounted_for": 4, "images_accounted_for": 4},
        },
        "warnings": [],
    }  # fmt: skip


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    world, root = box_world.make(images=4, points_per_scan=6000), tmp_path_factory.mktemp("old")
    recording, out = root / "recording", root / "result"
    for folder in (recording / "all_image", recording / "all_pcd_body", out / "stages"):
        folder.mkdir(parents=True)
    for time, picture, scan in zip(TIMES, world.pictures, world.scans):
        images.write_image(recording / "all_image" / f"{time:.6f}.png", picture)
        pcd.write_pcd(recording / "all_pcd_body" / f"{time:.6f}.pcd", scan)
    poses = Trajectory(TIMES, world.world_from_camera)
    tum.write_trajectory(recording / "all_image/image_poses.txt", poses)
    tum.write_trajectory(recording / "all_pcd_body/lidar_poses.txt", poses)
    for name in ("image_poses.txt", "lidar_poses.txt"):
        (out / name).write_text(tum.trajectory_text(poses))
    camera = box_world.CAMERA
    (recording / "config.yaml").write_text(
        f"cam_model: {{cam_width: {camera.width}, cam_height: {camera.height}, scale: 1.0, cam_fx: {camera.fx}, "
        f"cam_fy: {camera.fy}, cam_cx: {camera.cx}, cam_cy: {camera.cy}, cam_d0: 0, cam_d1: 0, cam_d2: 0, cam_d3: 0}}\n"
        "extrin_calib: {extrinsic_T: [0, 0, 0], extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1], "
        "Rcl: [1, 0, 0, 0, 1, 0, 0, 0, 1], Pcl: [0, 0, 0]}\n"
    )
    point_map = map_file.build(world.cloud(), world.views(), map_file.MapConfig(voxel_m=0.05))
    columns = map_file.columns(point_map, np.zeros(3))
    ply.write_ply(out / "map.ply", {name: columns[name] for name in OLD_COLUMNS})
    exposures.write_exposures(out / "exposures.csv", exposures.Exposures(TIMES, np.exp(world.log_exposure)))
    (out / "config.yaml").write_text(yaml.safe_dump({"visual": {"points": {"tries": 12}}}))
    (out / "report.json").write_text(json.dumps(facts(recording)))
    (out / "report.html").write_text("<html></html>")
    return out


@pytest.mark.parametrize("kind", ["ply", "las", "colmap", "nerfstudio", "lod"])
def test_it_is_exported(result, tmp_path, kind):
    written = export.export(result, kind, tmp_path / kind)
    assert written.stat().st_size > 0


def test_it_is_reported(result):
    old = json.loads((result / "report.json").read_text())
    page = report.page(old)
    assert "12\N{NO-BREAK SPACE}mm" in page  # the offset of the seam, which that version called a jump
    kept = {part.name: part for part in part_verdicts.of_report(old)}
    assert kept["scans"].accepted
    assert "not predicted better" in kept["cameras"].reason


def test_its_figures_are_read_by_their_old_names(result):
    figures = verdict_data.figures(json.loads((result / "report.json").read_text()))
    assert figures.overdispersion == 4.5
    assert figures.spline_error == 0.4
    assert figures.fusion_variance_factor == 1.5
    assert (figures.common_degenerate, figures.degenerate_scans) == (1, 1)
    assert "not predicted better" in figures.camera_poses.reason


def get(app, path):
    async def ask():
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return (await client.get(path)).json()

    return anyio.run(ask)


def test_it_is_viewed(result, tmp_path):
    assert view_command.checked(result) == result.resolve()
    export.export(result, "lod", tmp_path)
    viewed = result_viewer.ViewedResult(result, tmp_path)
    app = result_viewer.create(viewed, Settings())
    names = {item["name"] for item in get(app, "/v1/result/results")["items"]}
    assert {"map.ply", "report.json", "cloud/metadata.json"} <= names
    assert not any(name.startswith("stages") for name in names)
    assert get(app, "/v1/result/results/report.json")["versions"] == {"lvba": "0.1.0"}
    assert len(get(app, "/v1/result/frames")["items"]) == 4


def test_its_config_is_read(result):
    loaded = config.load(Config, (result / "config.yaml").read_text())
    assert loaded == Config()
    assert "visual.points.tries" in retired_settings.DEFAULTS


def count(calls, name):
    calls.write_text(calls.read_text() + name)
    return Trajectory(np.arange(2.0), np.stack([np.eye(4)] * 2))


def run(version, calls, store):
    plan = Plan(version)
    plan.add("lidar", count, calls, "x")
    return local.run(plan, ZarrStore(store))


def test_what_its_stages_made_is_made_again_and_that_of_this_version_is_not(tmp_path):
    calls, store = tmp_path / "calls", tmp_path / "stages"
    calls.write_text("")
    run("0.1.0", calls, store)
    (new,) = run(versions.key_version(), calls, store)
    assert not new.reused
    (again,) = run(versions.key_version(), calls, store)
    assert again.reused
    assert calls.read_text() == "xx"
