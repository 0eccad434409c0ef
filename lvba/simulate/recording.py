"""The text files of a simulated recording: poses, true poses, exposures, calibration, and what was put in."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.dataset import CAMERA
from lvba.errors import InputError
from lvba.io import calibration, exposures, files, image_poses, imu, tum
from lvba.io.exposures import Exposures
from lvba.simulate.imu import SimulatedImu
from lvba.simulate.truth import Rig, Truth
from lvba.trajectory import Trajectory

IMAGES, SCANS, REFERENCE = "all_image", "all_pcd_body", "reference"


def make_folders(out: str | Path, facts: dict[str, Any]) -> Path:
    """The folder to write to, with its parts; notes there what is being simulated.

    Raises: InputError if it holds anything but the same simulation: the files of two would mix.
    """
    root, text = files.make_folder(out), json.dumps(facts, indent=1) + "\n"
    note = root / REFERENCE / "simulation.json"
    if not (note.is_file() and files.read_text(note) == text):
        for name in (IMAGES, SCANS):
            if (root / name).is_dir() and any((root / name).iterdir()):
                raise InputError(root / name, "is not empty", "take another folder, or remove this one")
    for name in (IMAGES, SCANS, REFERENCE):
        files.make_folder(root / name)
    files.write_text(note, text)
    return root


def write_texts(
    root: Path, truth: Truth, rig: Rig, camera: Camera, exposure: np.ndarray, kind: str = CAMERA
) -> None:
    """Poses, true poses, exposures and calibration.

    kind: what the rough image poses are of (`io.image_poses`), by the calibration written; the true ones are the camera's
    exposure: (I,) float64, relative exposure times
    """
    rough = truth.rough_images
    written = image_poses.from_camera(rough.world_from_sensor, kind, truth.rough_camera_from_body)
    tum.write_trajectory(root / SCANS / "lidar_poses.txt", truth.rough_scans)
    tum.write_trajectory(root / IMAGES / "image_poses.txt", Trajectory(rough.times, written))
    reference = root / REFERENCE
    tum.write_trajectory(reference / "lidar_poses.txt", truth.scans)
    tum.write_trajectory(reference / "image_poses.txt", truth.images)
    exposures.write_exposures(reference / "exposures.csv", Exposures(truth.images.times, exposure))
    # its camera extrinsic is the rough one
    camera_from_lidar = truth.rough_camera_from_body @ rig.body_from_lidar
    text = calibration.recording_text(camera, rig.body_from_lidar, camera_from_lidar)
    files.write_text(root / "config.yaml", text)


def imu_facts(measured: SimulatedImu, truth: Truth) -> dict[str, Any]:
    """What is true of an IMU: biases, axes, and which way is down in the world frame of the poses."""
    world_from_scene = truth.scans.world_from_sensor[0] @ geometry.inverse(truth.scene_from_body[0])
    return {
        "gyroscope_bias": measured.gyroscope_bias.tolist(),
        "accelerometer_bias": measured.accelerometer_bias.tolist(),
        "gyroscope_axes": measured.gyroscope_axes.tolist(),
        "accelerometer_axes": measured.accelerometer_axes.tolist(),
        "down": (-world_from_scene[:3, 2]).tolist(),
    }


def write_imu(root: Path, measured: SimulatedImu, truth: Truth) -> None:
    """imu.csv on the clock of the scans."""
    start = float(np.round(truth.scans.times[0] - truth.scan_moments[0]))
    readings = measured.readings
    imu.write(root / imu.NAME, replace(readings, times=readings.times + start))
