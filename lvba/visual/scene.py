"""What the visual bundle adjustment works on, and what all its levels share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Images, Poses
from lvba.camera import Camera
from lvba.carried import carry
from lvba.lidar import covariance as covariances
from lvba.lidar.covariance import Covariance
from lvba.lidar.plane import PlanePoints, Planes, Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import scene_points, trajectory_prior, visibility, white_balance
from lvba.visual.config import VisualConfig
from lvba.visual.image import Pyramid
from lvba.visual.scene_points import PointsConfig
from lvba.visual.states import CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.visual.variant import PRODUCT, Variant
from lvba.visual.visibility import DepthBuffers, VisibilityMap


@dataclass(frozen=True)
class Inputs:
    """What the visual stage works on, the same at every level.

    pyramid: of the keyframes only; keyframes: (K,) their indices among the images
    images, scans: rough trajectories; refined_scans: (S, 4, 4), poses the planes were made with
    camera_from_scan: (4, 4) calibrated extrinsic; sensor_position_scan: (3,) m
    scan_covariance: of refined_scans; None: not known; planes_off: (6, 6), as `RangeErrors.planes_off`
    camera: of the raw images, with its lens; None: they had none, and their camera is not refined
    colors: red (0), green or blue of the keyframes, (K, H, W, 1) uint8; None: not at hand; smaller_colors: of large ones
    """

    pyramid: Pyramid
    keyframes: np.ndarray
    images: Trajectory
    scans: Trajectory
    refined_scans: np.ndarray
    camera_from_scan: np.ndarray
    sensor_position_scan: np.ndarray
    planes: Planes
    plane_points: PlanePoints
    scan_covariance: Covariance | None = None
    planes_off: np.ndarray | None = None
    camera: Camera | None = None
    colors: Callable[[int], Images] | None = None
    smaller_colors: white_balance.SmallerColors | None = None


@dataclass(frozen=True)
class Scene:
    """What all levels share.

    start: carried rough poses, all equally exposed; prior: of all images
    """

    pyramid: Pyramid
    image_times: np.ndarray
    surfaces: Surfaces
    keyframes: np.ndarray
    start: VisualState
    prior: Prior
    seen: VisibilityMap | None
    """Which cameras are near a scan: that does not change by centimetres, so the rough poses will do."""
    variant: Variant
    points: PointsConfig
    camera: Camera | None = None
    vignetting: bool = False
    """Whether it is asked for."""

    def cameras(self, world_from_camera: Poses) -> Trajectory:
        """The images where these poses (I, 4, 4) have them."""
        return Trajectory(self.image_times, world_from_camera)

    def depth_buffers(self, camera: Camera, world_from_camera: Poses, time_window_s: float) -> DepthBuffers:
        """What hides what from a camera at poses (I, 4, 4); time_window_s: s, as of `visibility.depth_buffers`."""
        surfaces = self.surfaces
        return visibility.depth_buffers(
            camera, world_from_camera, self.image_times, surfaces.points, surfaces.scan_times, time_window_s
        )


def scene_of(given: Inputs, config: VisualConfig, variant: Variant = PRODUCT) -> Scene:
    """What all levels share, from the inputs."""
    times, scans = given.images.times[given.keyframes], given.scans
    known = given.scan_covariance
    local_covariance = None if known is None else covariances.local_covariance(known, given.refined_scans)
    prior = trajectory_prior.build(
        scans, given.refined_scans, given.images, given.camera_from_scan, config.prior, local_covariance,
        given.planes_off,
    )  # fmt: skip
    extrinsic = prior.calibration.reference.scan_from_camera
    start = carry(scans, given.refined_scans, given.images, extrinsic).world_from_sensor[given.keyframes]
    sensors = (given.refined_scans @ np.append(given.sensor_position_scan, 1.0))[:, :3]
    return Scene(
        pyramid=given.pyramid,
        image_times=times,
        surfaces=Surfaces(given.planes, given.plane_points, scans.times),
        keyframes=given.keyframes,
        start=VisualState(CameraStates(start, np.zeros(len(times))), prior.calibration.reference),
        prior=prior,
        seen=visibility.map_near_scans(scans.times, sensors, times, start, given.plane_points)
        if variant.global_points
        else None,
        variant=variant,
        points=scene_points.over(config.points, given.pyramid.camera, given.camera),
        camera=given.camera,
        vignetting=config.vignetting,
    )
