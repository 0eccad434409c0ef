"""What calibration files say of a rig: one camera, one LiDAR, one body (IMU)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_config
from lvba.io.image_header import ImageSize


@dataclass(frozen=True)
class RigCalibration:
    """One camera on a rig, in the directions of lvba; None: no file says it, and it does not follow from what they say.

    camera: where no file says the size of its images (calib.json), width and height are 0; see `camera_for`
    camera_from_lidar, body_from_lidar, body_from_camera: (4, 4) float64, m; the third follows where two are said
    camera_time_offset_s: the stamp of an image + this = its time on the clock named in `clock`
    clock: "IMU" (Kalibr, FAST-LIVO2) or "LiDAR" (results of lvba); "" where no offset is said
    topic: of the camera's images; "" where no file says it; names: of the camera, in files that name theirs
    origins: the file of each of the above, by the name of the field; two where it follows from two
    notes: one sentence each, on what was assumed or passed over
    """

    camera: Camera | None = None
    camera_from_lidar: Pose | None = None
    body_from_lidar: Pose | None = None
    body_from_camera: Pose | None = None
    camera_time_offset_s: float | None = None
    clock: str = ""
    topic: str = ""
    names: tuple[str, ...] = ()
    origins: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def camera_for(self, size: ImageSize) -> Camera | None:
        """The camera of images of this size, which may be shrunk or enlarged by one factor; None where none is said.

        Raises: InputError if the calibration is of images of another shape.
        """
        if self.camera is None:
            return None
        where = self.origins.get("camera", "the calibration")
        if not self.camera.width:
            return sized(self.camera, size, where)
        return camera_config.fitted(self.camera, size, where)


def sized(camera: Camera, size: ImageSize, where: str) -> Camera:
    """A camera whose file does not say the size of its images, for images of this size.

    Raises: InputError if its principal point is not in the middle half of such images: they are others.
    """
    off = (
        abs(camera.cx + 0.5 - size.width / 2) / size.width,
        abs(camera.cy + 0.5 - size.height / 2) / size.height,
    )
    if max(off) > 0.25:
        place = f"({camera.cx:g}, {camera.cy:g})"
        problem = f"the principal point {place} is not near the middle of {size.width} x {size.height} px"
        raise InputError(where, problem, "give the calibration of these images")
    return replace(camera, width=size.width, height=size.height)


@dataclass(frozen=True)
class FileCalibration:
    """What one file says of one camera; fields as of `RigCalibration`.

    name: of the camera in a file that has several ("cam0"); else ""
    """

    path: str
    name: str = ""
    topic: str = ""
    camera: Camera | None = None
    camera_from_lidar: Pose | None = None
    body_from_lidar: Pose | None = None
    body_from_camera: Pose | None = None
    camera_time_offset_s: float | None = None
    clock: str = ""
    notes: tuple[str, ...] = ()
