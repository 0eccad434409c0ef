"""A recording in a textured room, with the surfels of its scans: images are taken with every second scan."""

from types import SimpleNamespace

import numpy as np
import textured_room
from textured_room import CAMERA, COUNT, MOUNT, RAYS

from lvba import geometry
from lvba.loop_closure import rough_poses
from lvba.steps import features_on_scans
from lvba.trajectory import Trajectory


def room():
    """The surfels of each scan, its true pose, and the images."""
    inputs, _, _ = textured_room.make()
    truth, points = inputs["refined_scans"], inputs["plane_points"].points_world.reshape(-1, RAYS, 3)
    back = geometry.inverse(truth)
    scans = [
        geometry.transform_points(one, each).astype(np.float32)
        for one, each in zip(back, points, strict=True)
    ]
    surfels = rough_poses.surfels_of(scans)
    return SimpleNamespace(
        truth=truth, surfels=surfels, images=inputs["pyramid"].levels[0], times=inputs["scans"].times
    )


def recording(room, poses, monkeypatch, images=range(COUNT)):
    """With some scan poses, and images of some numbers."""
    pictures = room.images[list(images)].repeat(3, axis=3)
    monkeypatch.setattr(features_on_scans.recordings, "load_image", lambda _, number: pictures[number])
    return SimpleNamespace(
        scans=Trajectory(room.times, poses), images=SimpleNamespace(times=room.times[::2][list(images)]),
        image_paths=tuple(images), camera=CAMERA, camera_from_scan=geometry.inverse(MOUNT),
    )  # fmt: skip
