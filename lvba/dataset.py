"""What goes in: scans and images by path, with rough poses; nothing is loaded until asked for."""

from dataclasses import dataclass, field, replace

import numpy as np

from lvba.camera import Camera
from lvba.trajectory import Trajectory

CAMERA, BODY = "camera", "body"
"""What the poses of a recording's image_poses.txt are of."""
TURN, SHIFT = "rotation", "translation"
DESKEWED_BY = (TURN, SHIFT)
"""What of their motion scans may be deskewed by with rough poses: an odometry with an IMU turns them by its gyroscope."""
NO_CAMERA = Camera(width=0, height=0, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
"""The camera of a recording without images."""


@dataclass(frozen=True)
class Scan:
    """The points of one scan file.

    points: (N, 3) float32, m, scan frame, all finite
    intensity: (N,) float32 in the file's unit, or None
    time: (N,) float64 in the file's unit and from the file's zero (drivers agree on neither), or None
    """

    points: np.ndarray
    intensity: np.ndarray | None = None
    time: np.ndarray | None = None
    dropped: int = 0
    """Points of the file left out because they had no finite position, or the sensor's own (no return)."""

    def __len__(self) -> int:
        return len(self.points)

    def of_points(self, kept: np.ndarray) -> "Scan":
        """The scan of some of its points. kept: (n,) int64, their numbers, or (N,) bool"""
        intensity, time = (None if each is None else each[kept] for each in (self.intensity, self.time))
        return replace(self, points=self.points[kept], intensity=intensity, time=time)


@dataclass(frozen=True)
class RigCamera:
    """A camera and where it is on the sensor rig.

    camera: intrinsics of the raw (distorted) images, at the size of the files
    camera_from_scan: (4, 4) float64, m, rough extrinsic
    """

    camera: Camera
    camera_from_scan: np.ndarray


@dataclass(frozen=True)
class InputFindings:
    """What speaks against the files of a recording as they are; defaults: nothing does.

    skipped_scans, skipped_images: files left out, for they have no pose, are bad or have another size
    apart_s: s between the times of scans and those of images, where the two do not overlap
    repeated_scans, repeated_poses: scans whose file, or whose pose, is identical to that of the scan before
    speed_m_s: median from scan to scan, m/s, where nothing moves so fast; range_m: median of points, m, likewise
    poses_as: reading of the scan poses under which scans agree far better than as given: a key of
        `io.pose_readings.READINGS`, or ""
    """

    skipped_scans: int = 0
    skipped_images: int = 0
    apart_s: float = 0.0
    repeated_scans: int = 0
    repeated_poses: int = 0
    speed_m_s: float = 0.0
    range_m: float = 0.0
    poses_as: str = ""


@dataclass(frozen=True)
class Dataset:
    """A recording: files and matched rough poses, in time order.

    The scan frame is the frame the PCD points are given in (FAST-LIVO2's body frame). The world frame of all poses here
    is the input's, shifted by `origin` so that coordinates stay small: `x_input_world = x + origin`.
    """

    root: str
    scan_paths: tuple[str, ...]
    scans: Trajectory
    """world_from_scan of each scan, (S, 4, 4)."""
    image_paths: tuple[str, ...]
    images: Trajectory
    """world_from_camera of each image, (I, 4, 4); z forward."""
    cameras: tuple[RigCamera, ...]
    """The cameras that took the images: today one, or none if there are no images."""
    sensor_position_scan: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,), m: where the LiDAR is in the scan frame (from extrinsic_T); view directions start here."""
    sensor_axes_scan: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3): columns are the LiDAR's own axes in the scan frame (from extrinsic_R)."""
    deskewed_by: tuple[str, ...] = ()
    """With what of the rough poses the scans were deskewed, of DESKEWED_BY, as their file says; (): it says nothing."""
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,), m: added to positions when poses and maps are written."""
    scan_stamps: tuple[str, ...] = ()
    """Times of the scans as results write them, with digits that float64 cannot hold; none: the shortest text."""
    image_stamps: tuple[str, ...] = ()
    """The same of the images."""
    image_poses: str = CAMERA
    """What the image poses are of in the recording's file, CAMERA or BODY; here they are the camera's, in results the
    file's."""
    image_poses_reason: str = ""
    """Why that was taken; empty where there is no question."""
    imu_path: str = ""
    """Readings of an IMU between the scans (`io.imu`); empty: there are none."""
    scan_from_imu: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4), m: its extrinsic in the scan frame (from body_from_imu)."""
    warnings: tuple[str, ...] = ()
    """What was left out, and why, one sentence each."""
    findings: InputFindings = field(default_factory=InputFindings)
    """What speaks against its files, for the verdict."""
    digest: str = ""
    """sha256 over names, sizes and contents of everything used: equal digest, equal input."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of the one camera; NO_CAMERA if there are no images."""
        return self._rig_camera().camera

    @property
    def camera_from_scan(self) -> np.ndarray:
        """(4, 4) float64, m: rough extrinsic of the one camera; the identity if there are no images."""
        return self._rig_camera().camera_from_scan

    def with_camera(self, camera: Camera) -> "Dataset":
        """The recording with other intrinsics of its one camera."""
        return replace(self, cameras=(replace(self._rig_camera(), camera=camera),))

    def _rig_camera(self) -> RigCamera:
        if len(self.cameras) > 1:
            raise NotImplementedError("images of several cameras are not refined yet")
        return self.cameras[0] if self.cameras else RigCamera(NO_CAMERA, np.eye(4))
