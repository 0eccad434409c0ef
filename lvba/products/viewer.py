"""What a viewer shows beside the cloud: cameras, both trajectories, photographs and the map rendered at their poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lvba.dataset import Dataset
from lvba.errors import InputError
from lvba.io import calibration, exposures, files, images, result_folder
from lvba.io import dataset as recordings
from lvba.io.dataset import IMAGE_POSES
from lvba.parallel import in_order
from lvba.products import evaluate, pictures
from lvba.products.cloud import Cloud, assemble
from lvba.products.evaluate import State
from lvba.products.recorded_images import Undistorted, light_in, radiometry_of, views_of
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.trajectory import Trajectory
from lvba.visual.trajectory_rates import turns_of

MAX_PICTURES = 400
"""Images with pictures, spread evenly over longer recordings."""
MAX_WIDTH = 1280
"""Wider pictures are made smaller, px."""
_QUALITY = 88
KINDS = ("photo", "before", "after")
"""Folders of pictures: the photograph without lens distortion, and the map from rough and from refined poses."""


def write(result: Path, dataset: Dataset, out: Path, progress: Progress = silent) -> None:
    """Writes cloud/cloud.json into the folder `out`, and pictures into frames/photo, frames/before, frames/after.

    Pictures are NNNNNN.jpg by the image's index; the map is rendered from the points of the other images.
    Raises: InputError if the result does not fit the recording, or nothing can be written.
    """
    files.make_folder(out / "cloud")
    report = _report(result)
    expected = report.get("expected_error") or {}
    scans = result_folder.read_scans(result, dataset).world_from_sensor
    cameras = _refined_cameras(result, dataset) if dataset.image_paths else None
    shown: list[int] = []
    if cameras is not None:
        shown = _write_pictures(result, dataset, scans, cameras, out / "frames", progress)
    content = {
        "schema": 1,
        "octree": "metadata.json",
        "camera": _camera(dataset),
        "parts": _parts(report),
        "scans": {
            **_poses(dataset.scans, scans, dataset.origin),
            "error": _errors(expected, "scans", len(scans)),
        },
        "images": None
        if cameras is None
        else {
            **_poses(dataset.images, cameras, dataset.origin),
            "error": _errors(expected, "cameras", len(cameras)),
            "names": [Path(path).name for path in dataset.image_paths],
            "pictures": shown,
        },
    }
    files.write_text(out / "cloud" / "cloud.json", json.dumps(content, separators=(",", ":")))


def _refined_cameras(result: Path, dataset: Dataset) -> np.ndarray:
    """world_from_camera (I, 4, 4) of the result, in the recording's shifted frame."""
    cameras = result_folder.read_cameras(result, dataset)
    _check_times(result / IMAGE_POSES, cameras, dataset.images)
    return cameras.world_from_sensor


def _check_times(path: Path, refined: Trajectory, rough: Trajectory) -> None:
    if len(refined) != len(rough) or np.abs(refined.times - rough.times).max(initial=0) > 1e-5:
        raise InputError(
            path, "has other times than its recording", "run again on the recording as it is now"
        )


def _report(result: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(files.read_text(result / "report.json")))
    except (json.JSONDecodeError, TypeError, ValueError) as error:
        raise InputError(result / "report.json", "is not a report", "run again") from error


def _parts(report: dict[str, Any]) -> list[list[int]]:
    """First scan, and one after the last, of what each part of the recording owns; one part where it was not cut."""
    return [part["core_scans"] for part in (report.get("merge") or {}).get("parts", [])]


def _errors(expected: dict[str, Any], kind: str, frames: int) -> list[float | None] | None:
    """Expected error of each frame's position, m; None where, or if, it is not known."""
    errors = (expected.get(kind) or {}).get("per_frame_m")
    return errors if isinstance(errors, list) and len(errors) == frames else None


def _camera(dataset: Dataset) -> dict[str, Any] | None:
    """The pinhole camera of the undistorted images."""
    camera = dataset.camera
    return (
        {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        if dataset.image_paths
        else None
    )


def _poses(rough: Trajectory, refined: np.ndarray, origin: np.ndarray) -> dict[str, Any]:
    """Times, s, and the upper three rows of world_from_sensor, row by row, in the input's world frame."""
    both = {"rough": rough.world_from_sensor.copy(), "refined": refined.copy()}
    facts: dict[str, Any] = {"times": np.round(rough.times, 6).tolist()}
    for name, poses in both.items():
        poses[:, :3, 3] += origin
        facts[name] = np.round(poses[:, :3], 8).reshape(-1, 12).tolist()
    return facts


def _write_pictures(
    result: Path, dataset: Dataset, scans: np.ndarray, cameras: np.ndarray, folder: Path, progress: Progress
) -> list[int]:
    """Writes the pictures and returns the indices of their images."""
    for kind in KINDS:
        files.make_folder(folder / kind)
    rough = views_of(dataset, full=True)
    turns = turns_of(Trajectory(dataset.images.times, cameras), calibration.read_readout(result))
    photographs = Undistorted(dataset, turns=turns)
    log_exposure = np.log(exposures.read_exposures(result / "exposures.csv").relative)
    supposed = radiometry_of(result)
    refined = Views(
        load=photographs,
        camera=rough.camera,
        times=rough.times,
        world_from_camera=cameras,
        log_exposure=log_exposure,
        valid=rough.valid,
        light=light_in(supposed, dataset.camera),
        curve=supposed.response,
    )
    states = {
        "before": State(_cloud(dataset, dataset.scans.world_from_sensor, progress), rough),
        "after": State(_cloud(dataset, scans, progress), refined),
    }
    chosen = [int(i) for i in evaluate.judged_images(len(rough), np.empty(0, np.int32), MAX_PICTURES)]
    _each(
        lambda image: _save(folder, "photo", image, photographs(image)), chosen, "write photographs", progress
    )
    for kind, state in states.items():
        render = _renderer(state, folder, kind, progress)
        _each(render, chosen, f"render pictures {kind}", progress)
    return chosen


def _each(work: Callable[[int], None], chosen: list[int], what: str, progress: Progress) -> None:
    for done, _ in enumerate(in_order(work, chosen)):
        progress(what, done + 1, len(chosen))


def _renderer(state: State, folder: Path, kind: str, progress: Progress) -> Callable[[int], None]:
    """Writes the picture of an image, rendered from one state."""
    (colored,) = evaluate.color_by_paper([state], progress=progress)
    return lambda image: _save(folder, kind, image, pictures.leave_one_out(colored, state, image))


def _cloud(dataset: Dataset, world_from_scan: np.ndarray, progress: Progress) -> Cloud:
    return assemble(
        lambda index: recordings.load_scan(dataset, index).points,
        world_from_scan,
        dataset.scans.times,
        progress,
    )


def _save(folder: Path, kind: str, image: int, rgb: np.ndarray) -> None:
    images.write_image(folder / kind / f"{image:06d}.jpg", _small(rgb), quality=_QUALITY)


def _small(rgb: np.ndarray) -> np.ndarray:
    """The picture, made smaller where it is wider than MAX_WIDTH."""
    height, width = rgb.shape[:2]
    if width <= MAX_WIDTH:
        return rgb
    size = (MAX_WIDTH, round(height * MAX_WIDTH / width))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
