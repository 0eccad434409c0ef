"""How true the colors of a map are, where the truth is known: simulated scenes at given poses.

    python benchmarks/colors.py DATASET POSES

POSES: a folder of lidar_poses.txt, image_poses.txt and exposures.csv: a result, or a recording's own `reference`.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.dataset import Dataset
from lvba.io.dataset import load_scan, open_dataset
from lvba.io.reference import read_reference
from lvba.products import cloud as clouds
from lvba.products import map_file
from lvba.products.recorded_images import views_of

_OFF_M = 0.06
"""Points further than this from what their beam met are no measurement of it: mixed from two surfaces."""
_STRIP_M, _EDGE_M = 0.3, 0.05


def _state(dataset: Dataset, poses: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """world_from_scan (S, 4, 4) and world_from_camera (I, 4, 4) in the dataset's frame, log exposures (I,)."""
    poses_read = read_reference(poses)
    assert poses_read.scans is not None
    assert poses_read.images is not None
    assert poses_read.exposures is not None
    moved = [poses_read.scans.world_from_sensor.copy(), poses_read.images.world_from_sensor.copy()]
    for each in moved:
        each[:, :3, 3] -= dataset.origin
    return moved[0], moved[1], np.log(poses_read.exposures.relative)


def colored_map(dataset: Dataset, poses: Path) -> map_file.PointMap:
    """The map, colored as `lvba run` does, at the poses of a folder."""
    scans, cameras, log_exposure = _state(dataset, poses)
    cloud = clouds.assemble(
        lambda s: load_scan(dataset, s).points,
        scans,
        dataset.scans.times,
        sensor_position=dataset.sensor_position_scan,
    )
    views = replace(views_of(dataset), world_from_camera=cameras, log_exposure=log_exposure)
    return map_file.build(cloud, views, camera=dataset.camera)


def judge(dataset_folder: Path, poses: Path) -> dict[str, Any]:
    """Shares and errors of the colors of the map at the poses of a folder."""
    from lvba.simulate import cabinet, known

    scene, dataset = known.read(dataset_folder), open_dataset(dataset_folder)
    world_from_scan, _, _ = _state(dataset, poses)
    made = colored_map(dataset, poses)
    points, scan, rgb = made.points_world, made.scan, made.rgb.astype(float)
    quad, place, off = np.full(len(points), -1), np.zeros((len(points), 3)), np.full(len(points), np.inf)
    for s in range(len(world_from_scan)):
        mine = np.flatnonzero(scan == s)
        measured = geometry.transform_points(geometry.inverse(world_from_scan[s]), points[mine].astype(float))
        quad[mine], place[mine], off[mine] = scene.surface(s, measured)
    on = (quad >= 0) & (off < _OFF_M)
    colored = made.views > 0
    true = scene.radiance(np.where(on, quad, -1), place, made.voxel_m / 2).astype(float)
    both = on & colored
    true = np.clip(true * np.median(rgb[both].sum(1) / true[both].sum(1)), 0, 255)
    error = np.abs(rgb - true).mean(1)
    row = {
        "points": int(on.sum()),
        "uncolored": float(1 - colored[on].mean()),
        "error": float(error[both].mean()),
        "error_p95": float(np.quantile(error[both], 0.95)),
    }
    if json.loads((dataset_folder / "reference" / "simulation.json").read_text())["scene"] == "cabinet":
        row |= _cabinet(cabinet, on, colored, quad, place, rgb, error)
    return row


def _cabinet(
    cabinet: Any,
    on: np.ndarray,
    colored: np.ndarray,
    quad: np.ndarray,
    place: np.ndarray,
    rgb: np.ndarray,
    error: np.ndarray,
) -> dict[str, float]:
    """Shares of the points on the cabinet's sides that carry the floor's color, and of the floor round it the reverse."""
    half, side = np.array(cabinet.SIZE_M) / 2, on & np.isin(quad, cabinet.SIDES)
    floor = on & (quad == cabinet.FLOOR) & (np.abs(place[:, :2]) < half[:2] + _STRIP_M).all(1)
    wide = np.isin(quad, cabinet.SIDES[:2])
    to_edge = np.where(wide, half[0] - np.abs(place[:, 0]), half[1] - np.abs(place[:, 1]))
    edge = side & ((to_edge < _EDGE_M) | (2 * half[2] - place[:, 2] < _EDGE_M))
    floors, sides = (_chroma(style[None, :3]) for style in (cabinet.FLOOR_STYLE, cabinet.CABINET_STYLE))
    half_way = 0.5 * np.linalg.norm(floors - sides)
    chroma = _chroma(rgb)
    as_floor = np.linalg.norm(chroma - floors, axis=1) < half_way
    as_side = np.linalg.norm(chroma - sides, axis=1) < half_way
    out = {}
    for name, where, wrong in (
        ("sides", side, as_floor),
        ("strip", side & (place[:, 2] < _STRIP_M), as_floor),
        ("edges", edge, as_floor),
        ("floor", floor, as_side),
    ):
        out[f"{name}_points"] = int(where.sum())
        out[f"{name}_wrong"] = float(wrong[where & colored].mean())
        out[f"{name}_uncolored"] = float(1 - colored[where].mean())
        out[f"{name}_error"] = float(error[where & colored].mean())
    return out


def _chroma(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb / np.maximum(rgb.sum(1, keepdims=True), 1e-9))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(judge(*map(Path, sys.argv[1:])), indent=1) + "\n")
