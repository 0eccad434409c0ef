"""How intrinsics and the readout time of a rolling shutter move what patches see: the columns of their Jacobian.

Images are undistorted with the camera as it is known. Where the camera turns out to be another, each pixel of an
undistorted image shows another ray: `x + dx` with `K d(x)` kept, K the raw camera's matrix and d its lens. To first order
that moves a target pixel by `G(u_t) - A G(u_r)` per step, where G is the field of these displacements in the undistorted
image and A the derivative of the target pixel by the reference pixel. Undistorting the images anew takes up what is left.

A row of an image that is read out over a time is seen when it is read: the pose there is the image's own, moved on by
the velocity of the camera.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lvba import geometry, lens
from lvba.arrays import Poses
from lvba.camera import Camera
from lvba.kernels import moving_rows
from lvba.kernels import photometric_shared as kernels
from lvba.kernels.scene import PlanePatches
from lvba.parallel import in_order
from lvba.visual import fixed_calibration
from lvba.visual.image import intrinsics_of
from lvba.visual.patch_shifts import Shifts
from lvba.visual.scene_points import Observations, ScenePoints
from lvba.visual.states import Calibration

COEFFICIENTS = 4
"""Coefficients of a lens that are refined: k1 k2 p1 p2, or k1 k2 k3 k4 of an equidistant one."""
_STEP = 1e-5
"""Of differences, in normalized coordinates."""
_AT_ONCE = 8192
"""Pairs of patches whose shifts are computed at once, in one thread."""
_ROW_STEPS = 3
"""Times that the row at which a point is read is computed from where that row shows it: each leaves a fiftieth."""


def corrected(camera: Camera, calibration: Calibration) -> Camera:
    """The raw camera with the corrections of a calibration."""
    changed = (
        *(float(a + b) for a, b in zip(camera.distortion, calibration.distortion, strict=False)),
        *camera.distortion[COEFFICIENTS:],
    )
    return replace(
        camera,
        fx=camera.fx * (1 + float(calibration.focal[0])),
        fy=camera.fy * (1 + float(calibration.focal[0])) * (1 + float(calibration.focal[1])),
        cx=camera.cx + float(calibration.principal_point[0]),
        cy=camera.cy + float(calibration.principal_point[1]),
        distortion=changed,
    )


def displacement(camera: Camera, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """(N, 2, 8) float64, px of the undistorted image: how far what a ray shows moves there, per step of both focal
    lengths and of fy alone (relative), principal point (px of the raw image) and four coefficients of the lens.

    camera: the raw camera that the images were undistorted with; pinhole: that of the undistorted images
    pixels: (N, 2) float64, px, undistorted
    """
    x, y = pinhole.normalized(pixels)
    across, down = lens.distort(camera.lens, camera.distortion, x, y)
    focal = np.array([camera.fx, camera.fy])
    by_ray = focal[:, None] * np.stack(
        [_difference(camera, x, y, _STEP, 0.0), _difference(camera, x, y, 0.0, _STEP)], axis=-1
    )
    by_step = np.zeros((len(pixels), 2, 8))
    by_step[:, 0, 0], by_step[:, 1, 0] = camera.fx * across, camera.fy * down
    by_step[:, 1, 1] = by_step[:, 1, 0]
    by_step[:, 0, 2] = by_step[:, 1, 3] = 1.0
    for number in range(COEFFICIENTS):
        ends = [
            np.stack(
                lens.distort(camera.lens, _moved(camera.distortion, number, sign * _STEP), x, y), axis=-1
            )
            for sign in (1, -1)
        ]
        by_step[:, :, 4 + number] = focal * (ends[0] - ends[1]) / (2 * _STEP)
    return np.asarray(np.array([pinhole.fx, pinhole.fy])[:, None] * _solved(by_ray, by_step))


def _solved(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, 2, k): matrices (N, 2, 2) times these are right (N, 2, k); written out, a tenth of the time of LAPACK."""
    a, b, c, d = (matrices[:, row, column, None] for row in (0, 1) for column in (0, 1))
    first, second = right[:, 0], right[:, 1]
    solved = np.stack([d * first - b * second, a * second - c * first], axis=1)
    return np.asarray(solved / (a * d - b * c)[:, None])


def _difference(camera: Camera, x: np.ndarray, y: np.ndarray, along_x: float, along_y: float) -> np.ndarray:
    """(N, 2): derivative of the distorted normalized coordinates along one axis."""
    ends = [
        np.stack(
            lens.distort(camera.lens, camera.distortion, x + sign * along_x, y + sign * along_y), axis=-1
        )
        for sign in (1, -1)
    ]
    return np.asarray((ends[0] - ends[1]) / (2 * _STEP))


def _moved(coefficients: tuple[float, ...], number: int, step: float) -> tuple[float, ...]:
    return tuple(value + step * (index == number) for index, value in enumerate(coefficients))


def row_part(camera: Camera, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """(N,) float64: when pixels are read, in parts of the readout time after the middle of the image.

    pixels: (N, 2) float64, px, of the undistorted image
    """
    x, y = pinhole.normalized(pixels)
    _, down = lens.distort(camera.lens, camera.distortion, x, y)
    return np.asarray((camera.fy * down + camera.cy) / camera.height - 0.5)


def velocities(
    rate_scan: np.ndarray,
    velocity_world: np.ndarray,
    world_from_scan: np.ndarray,
    scan_from_camera: np.ndarray,
) -> np.ndarray:
    """(I, 6) float64 `[rotation | translation]` per second of the camera, in its own axes, rad/s and m/s.

    rate_scan: (I, 3) float64, rad/s, about the LiDAR's axes; velocity_world: (I, 3) float64, m/s, of the LiDAR
    world_from_scan: (I, 4, 4) float64, where the LiDAR is at each image; scan_from_camera: (4, 4) float64
    """
    local = np.einsum("nji,nj->ni", world_from_scan[:, :3, :3], velocity_world)
    twist = np.concatenate([rate_scan, local], axis=1)
    return np.asarray(twist @ geometry.adjoint(geometry.inverse(scan_from_camera)).T)


def shifts(
    camera: Camera,
    pinhole: Camera,
    points: ScenePoints,
    observations: Observations,
    world_from_camera: np.ndarray,
    velocity: np.ndarray,
    calibration: Calibration,
) -> Shifts:
    """How the calibration moves all patches: exactly at its present values, and linear about them.

    To first order a row would be read where it is without the motion: rows that lie 5 px off are seen 0.1 px elsewhere.

    camera: the raw one that the images were undistorted with; pinhole: of these images
    world_from_camera: (I, 4, 4) float64; velocity: (I, 6) float64, rad/s and m/s, of `velocities`
    """
    pixels = points.pixel.astype(float)
    now, columns = corrected(camera, calibration), fixed_calibration.indices()
    offset = np.zeros((len(observations), 2))
    jacobian = np.zeros((len(observations), 3, len(columns)))
    rows = np.empty((len(observations), 2))
    by_reference = displacement(camera, pinhole, pixels)
    moves = now != camera or bool(calibration.readout)
    # the ray that the pixel of the reference shows, where it is seen in the target, and where that pixel has gone to
    seen = _carried(camera, now, pinhole, pixels) if moves else pixels

    def of_some(first: int) -> None:
        some = slice(first, first + _AT_ONCE)
        pairs = Observations(
            observations.point[some], observations.target[some], observations.is_global[some]
        )
        at, images = pairs.point, (points.reference[pairs.point], pairs.target)
        place, by_pixel, by_poses = _centers(points, pairs, pixels, pinhole, world_from_camera)
        by, by_readout = jacobian[some, :2, :-1], jacobian[some, :2, -1]
        by[:] = displacement(camera, pinhole, place) - by_pixel @ by_reference[at]
        rows[some] = np.stack([row_part(camera, pinhole, where) for where in (pixels[at], place)], axis=1)
        for end, image in enumerate(images):
            moving = velocity[image] * rows[some, end : end + 1]
            by_readout += np.einsum("oai,oi->oa", by_poses[:, :, 6 * end : 6 * end + 6], moving)
        if not moves:
            return
        if calibration.readout:
            over = _Rows(world_from_camera, calibration.readout * velocity, rows[some])
            ends = _seen_by_rows(points, pairs, seen, pinhole, now, over)
        else:
            ends = _centers(points, pairs, seen, pinhole, world_from_camera)[0]
        offset[some] = _carried(now, camera, pinhole, ends) - place

    for _ in in_order(of_some, range(0, len(observations), _AT_ONCE), parallel_kernels=True):
        pass
    return Shifts(offset, jacobian, columns, calibration.layout().size, rows)


class _Rows(NamedTuple):
    """world_from_camera: (I, 4, 4) at the middle rows; over: (I, 6) float64, how far each moves during its readout, rad
    and m; parts: (O, 2) of `Shifts.rows`, as far as they are known yet"""

    world_from_camera: np.ndarray
    over: np.ndarray
    parts: np.ndarray


def _seen_by_rows(
    points: ScenePoints,
    observations: Observations,
    pixels: np.ndarray,
    pinhole: Camera,
    raw: Camera,
    moving: _Rows,
) -> np.ndarray:
    """(O, 2) px: where what pixels (P, 2) of the references show is in the targets, each row at its own pose."""
    patches = PlanePatches(points.position_world, points.normal_world, points.reference, pixels)
    poses, intrinsics = np.ascontiguousarray(moving.world_from_camera), intrinsics_of(pinhole)
    first, part = np.ascontiguousarray(moving.parts.T)
    world = moving_rows.onto_planes(observations.point, poses, moving.over, first, intrinsics, patches)
    for _ in range(_ROW_STEPS):
        place = moving_rows.into_images(world, observations.target, poses, moving.over, part, intrinsics)
        part = row_part(raw, pinhole, place)
    return place


def near_target(
    points: ScenePoints, observations: Observations, pinhole: Camera, world_from_camera: Poses
) -> np.ndarray:
    """(O,) bool: whether patches lie in their target images, or outside by less than the size of one.

    No calibration moves others into the images. pinhole: of these images; world_from_camera: (I, 4, 4) float64
    """
    place = _centers(points, observations, points.pixel.astype(float), pinhole, world_from_camera)[0]
    off_middle = place / np.array([pinhole.width, pinhole.height]) - 0.5
    return np.asarray((np.abs(off_middle) <= 1.5).all(axis=1))


def _centers(
    points: ScenePoints,
    observations: Observations,
    pixels: np.ndarray,
    pinhole: Camera,
    world_from_camera: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`kernels.centers` of patches at the pixels (P, 2) float64 of their reference images."""
    patches = PlanePatches(points.position_world, points.normal_world, points.reference, pixels)
    return kernels.centers(
        observations.point,
        observations.target,
        np.ascontiguousarray(world_from_camera),
        intrinsics_of(pinhole),
        patches,
    )


def _carried(camera: Camera, other: Camera, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """(N, 2): where in an image that was undistorted for `other` is what pixels (N, 2) of one for `camera` show."""
    x, y = pinhole.normalized(pixels)
    u, v = lens.distort(camera.lens, camera.distortion, x, y)
    raw = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=-1)
    x, y = lens.undistort(other.lens, other.distortion, *other.normalized(raw))
    return np.stack([x * pinhole.fx + pinhole.cx, y * pinhole.fy + pinhole.cy], axis=-1)
