"""Recordings with known truth as drivers leave them: skewed scans, images, IMU and odometry as a `Source`.

Each beam is cast from where the sensor truly was when it left; only what drivers and odometries say of themselves
(stamps, units, what a pose is of) is by their convention, which may be any of `Conventions`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.simulate import camera as cameras
from lvba.simulate import drift, imu, lidar, simulation
from lvba.simulate.camera import Sensor
from lvba.simulate.lidar import Surroundings
from lvba.simulate.trajectories import Motion
from lvba.simulate.truth import Rig
from lvba.simulate.view import View
from lvba.sources.source import (
    CameraInfo,
    ImuSample,
    Kind,
    KnownGeometry,
    ListSource,
    PoseSample,
    RawImage,
    RawScan,
    Record,
    SourceDescription,
    Stream,
    TransformSample,
)

LIDAR, IMAGES, IMU, ODOMETRY = "/lidar/points", "/camera/image", "/imu/data", "/odometry"
CAMERA_INFO, TF_STATIC = "/camera/camera_info", "/tf_static"
LIDAR_FRAME, CAMERA_FRAME, IMU_FRAME, BODY_FRAME, WORLD_FRAME = (
    "lidar",
    "camera_optical",
    "imu",
    "base",
    "odom",
)
START_NS = 1_700_000_000_000_000_000
_LEAD_S = 0.3
"""Of the motion before the first sweep and after the last one: odometry and IMU begin earlier and end later."""
_IMU_HZ = 200
_START_S = 2.0
"""How long sensors take from rest to their speed."""
_SHAKE_HZ = 2.5
_GYROSCOPE_NOISE, _GYROSCOPE_BIAS = 2e-3, 2e-3
_ACCELEROMETER_NOISE, _ACCELEROMETER_BIAS = 0.02, 0.05
_GREY = 95.0 / 0.45
"""Grey value of radiance 1 at the middle exposure."""
_DRIFT_DEG_PER_M = 2.5


class Moment(StrEnum):
    """Of a sweep."""

    BEGIN = "begin"
    MIDDLE = "middle"
    END = "end"


PART = {Moment.BEGIN: 0.0, Moment.MIDDLE: 0.5, Moment.END: 1.0}


class PoseOf(StrEnum):
    """What the poses of an odometry are of."""

    BODY = "body"
    LIDAR = "lidar"
    CAMERA = "camera"


@dataclass(frozen=True)
class Conventions:
    """What drivers and odometry of a raw recording write.

    header: moment of the sweep that stamps of scans are of
    unit, absolute: of the field of times, s; absolute: since 1970, else since `header`; time_type: numpy's name of its
        type, "" for scans without times
    pose_moment: moment of the sweep that a pose of the odometry holds at; it has the stamp of the scan
    pose_of, inverse: of what, and whether it is world from that or the inverse
    image_delay, odometry_delay: s by which images and poses are stamped too late
    extrinsic_inverse: the calibration has LiDAR from camera in place of camera from LiDAR
    imu: where the IMU is on the body, 6 numbers as of `geometry.exp`; (): it is the body's frame
    """

    header: Moment = Moment.BEGIN
    unit: float = 1e-9
    absolute: bool = False
    time_type: str = "float64"
    pose_moment: Moment = Moment.BEGIN
    pose_of: PoseOf = PoseOf.BODY
    inverse: bool = False
    image_delay: float = 0.0
    odometry_delay: float = 0.0
    extrinsic_inverse: bool = False
    imu: tuple[float, ...] = ()

    def body_from_imu(self) -> Pose:
        """(4, 4), m."""
        return np.asarray(geometry.exp(np.array(self.imu))) if self.imu else np.eye(4)


@dataclass(frozen=True)
class Sensors:
    """How much is simulated, and how well: rates in Hz, noise of single poses of the odometry in m and degrees."""

    lidar: str = "spinning"
    points: int = 10_000
    width: int = 320
    height: int = 240
    image_hz: float = 10.0
    odometry_noise: float = 0.005
    odometry_noise_deg: float = 0.05
    drift_m: float = 0.0
    """Of the odometry over the whole recording, root mean square."""
    shake_deg: float = 0.0
    """Yaw and pitch swing by this at 2.5 Hz, as in a hand that walks."""
    rest_s: float = 0.0
    """How long the sensors stand still before they move, of which 0.3 s come before the first sweep."""


@dataclass(frozen=True)
class RawTruth:
    """What is true of a raw recording. All times are int64 ns.

    scans, images: (S,), (I,): start of each sweep, and when each image was taken
    points: of each scan, (N, 3) float32, m, LiDAR frame, each as seen from where the sensor was at its own time
    point_times: of each scan, (N,): when each of its points was measured
    """

    motion: Motion
    rig: Rig
    camera: Camera
    around: Surroundings
    scans: np.ndarray
    images: np.ndarray
    points: tuple[np.ndarray, ...]
    intensity: tuple[np.ndarray, ...]
    point_times: tuple[np.ndarray, ...]
    exposure: np.ndarray
    encoded: tuple[bytes, ...]
    """JPEG files of the images."""

    def scene_from_body(self, times: np.ndarray) -> np.ndarray:
        """True poses (N, 4, 4). times: (N,) int64, ns"""
        return self.motion.poses(moments(times))


def moments(times: np.ndarray) -> np.ndarray:
    """(N,) float64, s since the start of the motion. times: (N,) int64, ns"""
    return np.asarray(_LEAD_S + (times - START_NS) * 1e-9)


def measure(
    scene: str, *, seconds: float = 4.0, seed: int = 0, frames: int = 100, sensors: Sensors | None = None
) -> RawTruth:
    """What sensors measure on their way through a scene: the same for the same arguments.

    seconds: s, how long it is, at most as long as the motion; frames: as of `simulate`, of which only the length of the
        path through some scenes depends
    Raises InputError: there is no such scene or LiDAR, or Open3D is not installed.
    """
    sensors = sensors or Sensors()
    if sensors.lidar not in ("spinning", "non_repetitive"):
        raise InputError("lidar", f"{sensors.lidar[:40]!r} has no sweep", "take spinning or non_repetitive")
    made = simulation.make(scene, seed, "easy", max(frames, 2), 2, None, None)
    motion = made.scene.motion
    if sensors.shake_deg:
        motion = _shaken(motion, sensors.shake_deg)
    if sensors.rest_s:
        motion = _from_rest(motion, sensors.rest_s)
    made = replace(made, scene=replace(made.scene, motion=motion))
    seconds = min(seconds, made.scene.motion.duration - 2 * _LEAD_S)
    begins = _begins(np.arange(max(int(seconds / lidar.SWEEP_S), 2)))
    # between two begins of sweeps, so that no image has the time of a scan
    numbers = np.arange(max(int(seconds * sensors.image_hz), 1))
    taken = START_NS + np.round((0.037 + numbers / sensors.image_hz) * 1e9).astype(np.int64)
    camera = cameras.random_camera(sensors.width, sensors.height, made.optics)
    exposure = cameras.exposures(len(taken), made.optics)
    around = Surroundings(made.scene.world, made.caster)
    scans = [_sweep(made, around, sensors, begin, [seed, 11, index]) for index, begin in enumerate(begins)]
    return RawTruth(
        motion=made.scene.motion,
        rig=made.rig,
        camera=camera,
        around=around,
        scans=begins,
        images=taken,
        points=tuple(points for points, _, _ in scans),
        intensity=tuple(intensity for _, intensity, _ in scans),
        point_times=tuple(times for _, _, times in scans),
        exposure=exposure,
        encoded=tuple(_pictures(made, camera, exposure, taken, seed)),
    )


def simulate_raw(
    scene: str,
    *,
    seconds: float = 4.0,
    seed: int = 0,
    frames: int = 100,
    sensors: Sensors | None = None,
    conventions: Conventions | None = None,
) -> tuple[ListSource, RawTruth]:
    """A raw recording of a scene, and what is true of it; arguments as of `measure` and `written`.

    seconds: s

    Raises InputError: as `measure`
    """
    truth = measure(scene, seconds=seconds, seed=seed, frames=frames, sensors=sensors)
    return written(truth, conventions, sensors, seed), truth


def written(
    truth: RawTruth, conventions: Conventions | None = None, sensors: Sensors | None = None, seed: int = 0
) -> ListSource:
    """What drivers and an odometry write of it, by their conventions.

    sensors: of which the noise of the odometry counts here; seed: of all noise
    """
    sensors, conventions = sensors or Sensors(), conventions or Conventions()
    items: list[tuple[str, Record]] = [(LIDAR, scan) for scan in _scans(truth, conventions)]
    for time, encoded in zip(truth.images, truth.encoded, strict=True):
        stamp = int(time) + round(conventions.image_delay * 1e9)
        items.append((IMAGES, RawImage(stamp, CAMERA_FRAME, encoded, None, ".jpg")))
    items += [(IMU, sample) for sample in _imu(truth, conventions, seed)]
    items += [(ODOMETRY, pose) for pose in _odometry(truth, conventions, sensors, seed)]
    timed = [*_calibration(truth, conventions), *sorted(items, key=lambda item: item[1].stamp)]
    return ListSource(_describe(timed), tuple(timed), KnownGeometry())


def _shaken(motion: Motion, size_deg: float) -> Motion:
    """The motion with a swing of yaw and pitch."""
    times = np.arange(0, motion.duration, 5e-3)
    phase = 2 * np.pi * _SHAKE_HZ * times
    swing = np.radians(size_deg) * np.stack(
        [np.sin(phase), np.cos(1.3 * phase), np.zeros(len(times))], axis=-1
    )
    return replace(motion, angles=CubicSpline(times, motion.angles(times) + swing))


def _from_rest(motion: Motion, rest_s: float) -> Motion:
    """The motion after a rest; its speed rises from zero within `_START_S`."""
    duration = rest_s + motion.duration + 0.5 * _START_S
    times = np.arange(0, duration, 5e-3)
    moved = np.clip((times - rest_s) / _START_S, 0, 1)
    # the integral of the smooth step 3 m^2 - 2 m^3
    on_path = _START_S * (moved**3 - 0.5 * moved**4) + np.maximum(times - rest_s - _START_S, 0)
    position, angles = (CubicSpline(times, spline(on_path)) for spline in (motion.position, motion.angles))
    return Motion(duration, position, angles)


def _begins(numbers: np.ndarray) -> np.ndarray:
    """(N,) int64 ns: begins of sweeps of these numbers."""
    return START_NS + np.round(numbers * lidar.SWEEP_S * 1e9).astype(np.int64)


def _sweep(
    made: simulation.Made, around: Surroundings, sensors: Sensors, begin: int, seed: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, intensities and times (N,) int64 ns of a sweep."""
    rng = np.random.default_rng(seed)
    directions = lidar.PATTERNS[sensors.lidar](sensors.points, rng)
    from_begin = lidar.SWEEP_S + lidar.beam_times(sensors.lidar, len(directions))
    times = begin + np.round(from_begin * 1e9).astype(np.int64)
    scene_from_lidar = made.scene.motion.poses(moments(times)) @ made.rig.body_from_lidar
    points, intensity, beams = lidar.scan(around, scene_from_lidar, directions, rng)
    return points, intensity, times[beams]


def _pictures(
    made: simulation.Made, camera: Camera, exposure: np.ndarray, taken: np.ndarray, seed: int
) -> Iterator[bytes]:
    view = View.of(made.caster, made.texture, camera)
    sensor = Sensor(gain=_GREY / float(np.exp(np.median(np.log(exposure)))))
    body_from_camera = geometry.inverse(made.rig.camera_from_body)
    for index, pose in enumerate(made.scene.motion.poses(moments(taken)) @ body_from_camera):
        rng = np.random.default_rng([seed, 12, index])
        rgb = sensor.picture(view.radiance(pose), float(exposure[index]), rng)
        _, encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        yield encoded.tobytes()


def _scans(truth: RawTruth, conventions: Conventions) -> Iterator[RawScan]:
    header = round(PART[conventions.header] * lidar.SWEEP_S * 1e9)
    for begin, points, intensity, times in zip(
        truth.scans, truth.points, truth.intensity, truth.point_times, strict=True
    ):
        stamp, stored = int(begin) + header, None
        if conventions.time_type:
            counted = times if conventions.absolute else times - stamp
            stored = (counted / (conventions.unit * 1e9)).astype(conventions.time_type)
        yield RawScan(
            stamp=stamp,
            frame=LIDAR_FRAME,
            points=points,
            intensity=intensity,
            times=stored,
            time_field="t" if conventions.time_type else "",
        )


def _imu(truth: RawTruth, conventions: Conventions, seed: int) -> Iterator[ImuSample]:
    """Readings at 200 Hz in the IMU's axes: rad/s and m/s^2, with noise and a bias."""
    motion, rng = truth.motion, np.random.default_rng([seed, 13])
    length = round((len(truth.scans) * lidar.SWEEP_S + _LEAD_S) * _IMU_HZ)
    numbers = np.arange(-round(0.5 * _LEAD_S * _IMU_HZ), length)
    times = START_NS + np.round(numbers * (1e9 / _IMU_HZ)).astype(np.int64)
    rate, felt = imu.exact(motion, moments(times), conventions.body_from_imu())
    rate = rate + _GYROSCOPE_BIAS * rng.normal(size=3) + rng.normal(0, _GYROSCOPE_NOISE, rate.shape)
    felt = felt + _ACCELEROMETER_BIAS * rng.normal(size=3) + rng.normal(0, _ACCELEROMETER_NOISE, felt.shape)
    for time, turning, acceleration in zip(times, rate, felt, strict=True):
        yield ImuSample(int(time), IMU_FRAME, turning, acceleration)


def _odometry(truth: RawTruth, conventions: Conventions, sensors: Sensors, seed: int) -> Iterator[PoseSample]:
    """One pose for each sweep, and two before the first and after the last, as the conventions say."""
    rng, rig = np.random.default_rng([seed, 14]), truth.rig
    begins = _begins(np.arange(-2, len(truth.scans) + 2))
    when = moments(begins) + PART[conventions.pose_moment] * lidar.SWEEP_S
    noise = rng.normal(size=(len(begins), 6)) / np.sqrt(3)
    noise *= np.repeat([np.radians(sensors.odometry_noise_deg), sensors.odometry_noise], 3)
    drifted = drift.Drift(truth.motion.duration, rng).at(
        when, (np.radians(_DRIFT_DEG_PER_M * sensors.drift_m), sensors.drift_m)
    )
    poses = truth.motion.poses(when) @ geometry.exp(drifted) @ geometry.exp(noise)
    of = {
        PoseOf.BODY: np.eye(4),
        PoseOf.LIDAR: rig.body_from_lidar,
        PoseOf.CAMERA: geometry.inverse(rig.camera_from_body),
    }
    poses = poses @ of[conventions.pose_of]
    poses = geometry.inverse(poses) if conventions.inverse else poses
    late = PART[conventions.header] * lidar.SWEEP_S + conventions.odometry_delay
    stamps = begins + round(late * 1e9)
    for stamp, pose in zip(stamps, poses, strict=True):
        yield PoseSample(int(stamp), WORLD_FRAME, BODY_FRAME, pose)


def _calibration(truth: RawTruth, conventions: Conventions) -> list[tuple[str, Record]]:
    """What drivers say of the rig: the camera, and static transforms from the body to the sensors.

    Where the IMU is the body, nothing is called by the name of the body that the odometry has.
    """
    apart: list[tuple[str, Record]] = []
    if conventions.imu:
        placed = TransformSample(START_NS, BODY_FRAME, IMU_FRAME, conventions.body_from_imu(), True)
        apart = [(TF_STATIC, placed)]
    camera_from_lidar = truth.rig.camera_from_body @ truth.rig.body_from_lidar
    lidar_from_camera = geometry.inverse(camera_from_lidar)
    if conventions.extrinsic_inverse:
        lidar_from_camera = camera_from_lidar
    extrinsic = TransformSample(
        START_NS, BODY_FRAME if apart else IMU_FRAME, LIDAR_FRAME, truth.rig.body_from_lidar, True
    )
    return [
        (CAMERA_INFO, CameraInfo(START_NS, CAMERA_FRAME, truth.camera)),
        (TF_STATIC, extrinsic),
        (TF_STATIC, TransformSample(START_NS, LIDAR_FRAME, CAMERA_FRAME, lidar_from_camera, True)),
        *apart,
    ]


_KINDS = {
    LIDAR: (Kind.SCANS, "sensor_msgs/msg/PointCloud2"),
    IMAGES: (Kind.IMAGES, "sensor_msgs/msg/CompressedImage"),
    IMU: (Kind.IMU, "sensor_msgs/msg/Imu"),
    ODOMETRY: (Kind.POSES, "nav_msgs/msg/Odometry"),
    CAMERA_INFO: (Kind.CAMERA_INFO, "sensor_msgs/msg/CameraInfo"),
    TF_STATIC: (Kind.TRANSFORMS, "tf2_msgs/msg/TFMessage"),
}


def _describe(items: list[tuple[str, Record]]) -> SourceDescription:
    streams = []
    for name, (kind, message_type) in _KINDS.items():
        stamps = [record.stamp for stream, record in items if stream == name]
        streams.append(
            Stream(
                name=name,
                kind=kind,
                message_type=message_type,
                count=len(stamps),
                first=min(stamps),
                last=max(stamps),
            )
        )
    return SourceDescription("simulated", "simulated raw recording", 0, tuple(streams))
