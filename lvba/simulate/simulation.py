"""A recording with known truth: a scene, sensors moved through it, and rough poses."""

import warnings
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.dataset import BODY, CAMERA
from lvba.errors import InputError
from lvba.io import images, pcd
from lvba.progress import Progress, silent
from lvba.simulate import camera as cameras
from lvba.simulate import disturbed, drift, recording, scenes, texture
from lvba.simulate import imu as imus
from lvba.simulate import lidar as lidars
from lvba.simulate import truth as truths
from lvba.simulate.camera import Sensor
from lvba.simulate.disturbances import NONE, Disturbances
from lvba.simulate.lidar import Surroundings
from lvba.simulate.scenes import Scene
from lvba.simulate.texture import Texture
from lvba.simulate.truth import Rig, Truth
from lvba.simulate.view import View
from lvba.simulate.world import EmbreeCaster, RayCaster, World

DEFAULT_FRAMES = 100
_MEAN_GREY = 95.0
"""Grey value of radiance 0.45 at the middle exposure of a recording."""
_VIGNETTING = 0.35
_SHOT_NOISE = 0.02
_BLUR_S = 0.008
"""How long the shutter is open at relative exposure 1."""
_SCAN_RNG, _IMAGE_RNG, _LENS_RNG, _IMU_RNG = 1, 2, 4, 5
PINHOLE, FISHEYE = "pinhole", "fisheye"


@dataclass(frozen=True)
class _Simulation:
    """All that is needed to take scans and images."""

    seed: int
    lidar: str
    points_per_scan: int
    motion_blur: bool
    scene: Scene
    rig: Rig
    truth: Truth
    around: Surroundings
    view: View
    sensor: Sensor
    exposure: np.ndarray
    white_balance: np.ndarray | None
    disturb: Disturbances


@dataclass(frozen=True)
class Made:
    """A scene with its textures and true poses, the same for the same seed and counts."""

    scene: Scene
    rig: Rig
    truth: Truth
    caster: RayCaster
    texture: Texture
    optics: np.random.Generator
    """What draws camera and exposures."""


def make(
    scene: str,
    seed: int,
    difficulty: str,
    frames: int,
    scans: int,
    length: float | None,
    closing: tuple[float, float] | None,
    disturb: Disturbances = NONE,
    caster: Callable[[World], RayCaster] = EmbreeCaster,
) -> Made:
    """What is simulated, before anything is taken of it; arguments, as `length` (m), as of `simulate`."""
    level, on_top = drift.difficulty(difficulty), None if closing is None else drift.Closing(*closing)
    layout, extrinsics, moves, optics, paint = _streams(scene, seed)
    built = scenes.build(scene, layout, frames, length)
    rig = truths.random_rig(scene, extrinsics)
    truth = truths.build(built, rig, level, scans, frames, moves, on_top, disturb)
    return Made(
        scene=built,
        rig=rig,
        truth=truth,
        caster=caster(built.world),
        texture=texture.build(built.world, paint),
        optics=optics,
    )


def simulate(
    scene: str,
    out: str | Path,
    *,
    frames: int | None = None,
    seed: int = 0,
    difficulty: str = "medium",
    lidar: str | None = None,
    vignetting: bool = False,
    motion_blur: bool = False,
    shot_noise: bool = False,
    width: int = 640,
    height: int = 480,
    points_per_scan: int = 30_000,
    scans: int | None = None,
    length: float | None = None,
    closing: tuple[float, float] | None = None,
    image_poses: str = CAMERA,
    disturb: Disturbances = NONE,
    lens: str = PINHOLE,
    imu: bool = False,
    caster: Callable[[World], RayCaster] = EmbreeCaster,
    progress: Progress = silent,
) -> None:
    """Writes a dataset folder of a simulated recording, with the truth in its folder `reference`.

    scene: one of `lvba.simulate.scenes.SCENES`; frames: images (100); scans: as many as images by default
    seed: of everything: geometry, textures, path, noise; the same seed writes the same bytes
    difficulty: easy, medium or hard, of the rough poses; lidar: spinning, non_repetitive or depth_camera;
        None: as `Disturbances.usual_lidar` has it
    points_per_scan: beams; some come back without echo
    length: m, of a street, corridor, flight over the plane, or way around a block or through a terrace
    closing: m and degrees, drift on top of the difficulty: by how much the rough ends of a loop miss each other
    image_poses: camera or body: what image_poses.txt holds; FAST-LIVO2 writes the body's
    disturb: what real sensors do, see `lvba.simulate.disturbances`
    lens: pinhole, of about 65 degrees with k1 k2 p1 p2, or fisheye, equidistant of about 160
    imu: write imu.csv, of an IMU at the body
    caster: what finds out what rays meet; `lvba.simulate.world.PlainCaster` does without Open3D
    Raises: InputError on an unknown name, a number out of range, a folder that holds another recording, or if Open3D
        is not installed.
    """
    frames = DEFAULT_FRAMES if frames is None else frames
    scans = frames if scans is None else scans
    lidar = disturb.usual_lidar if lidar is None else lidar
    counts = {"frames": frames, "scans": scans, "width": width, "height": height, "points": points_per_scan}
    _check(counts, lidar, seed, length)
    _check_choice("lens", lens, (PINHOLE, FISHEYE))
    _check_choice("image_poses", image_poses, (CAMERA, BODY))
    made = make(scene, seed, difficulty, frames, scans, length, closing, disturb, caster)
    optics = made.optics
    camera, exposure = cameras.random_camera(width, height, optics), cameras.exposures(frames, optics)
    if lens == FISHEYE:
        camera = cameras.fisheye_of(camera, np.random.default_rng([seed, _LENS_RNG]))
    extra = disturbed.things(made.scene, made.caster, disturb, seed)
    view = View.of(made.caster, made.texture, camera, extra.around.people, extra.shine)
    if disturb.auto_exposure:
        exposure = disturbed.exposures_of(view, made.truth.scene_from_camera, disturb)
    sensor = _sensor(exposure, shot_noise, vignetting, disturb)
    simulation = _Simulation(
        seed=seed,
        lidar=lidar,
        points_per_scan=points_per_scan,
        motion_blur=motion_blur,
        scene=made.scene,
        rig=made.rig,
        truth=made.truth,
        around=extra.around,
        view=view,
        sensor=sensor,
        exposure=exposure,
        white_balance=disturbed.white_balances(frames, disturb, seed),
        disturb=disturb,
    )
    asked: dict[str, Any] = {"scene": scene, "difficulty": difficulty, "length_m": length}
    asked |= _unusual(image_poses, closing, lens)
    measured = imus.measure(made.scene.motion, np.random.default_rng([seed, _IMU_RNG])) if imu else None
    if measured is not None:
        asked["imu"] = recording.imu_facts(measured, made.truth)
    if disturb.present:
        asked["disturbances"] = disturb.present
        asked["true_camera"] = {**asdict(camera), "distortion": list(camera.distortion)}
    facts = {**asked, **counts, **_facts(simulation)}
    root = recording.make_folders(out, facts)
    calibrated = disturbed.calibration(camera, disturb, seed)
    recording.write_texts(root, made.truth, made.rig, calibrated, exposure, image_poses)
    if measured is not None:
        recording.write_imu(root, measured, made.truth)
    with warnings.catch_warnings():
        # numba asks for a newer TBB than the one Open3D brings, and does without
        warnings.filterwarnings("ignore", message="The TBB threading layer requires")
        _write_all(root, simulation, progress)


def _unusual(image_poses: str, closing: tuple[float, float] | None, lens: str) -> dict[str, Any]:
    """What simulation.json says of choices where they are not the usual ones."""
    facts: dict[str, Any] = {}
    if image_poses != CAMERA:
        facts["image_poses"] = image_poses
    if closing is not None:
        facts["closing_m_deg"] = list(closing)
    if lens != PINHOLE:
        facts["lens"] = lens
    return facts


def _check_choice(name: str, given: str, known: tuple[str, str]) -> None:
    if given not in known:
        raise InputError(name, f"{given[:40]!r} is not known", f"take {known[0]} or {known[1]}")


def _sensor(exposure: np.ndarray, shot_noise: bool, vignetting: bool, disturb: Disturbances) -> Sensor:
    """What makes grey values of light, at exposures (I,)."""
    return Sensor(
        gain=_MEAN_GREY / 0.45 / float(np.exp(np.median(np.log(exposure)))),
        shot_noise=_SHOT_NOISE if shot_noise else 0.0,
        vignetting=disturb.vignetting or (_VIGNETTING if vignetting else 0.0),
        response=disturb.response or 1.0,
        srgb=disturb.srgb,
        filmic=disturb.filmic,
    )


def _check(counts: dict[str, int], lidar: str, seed: int, length: float | None) -> None:
    least = {"frames": 2, "scans": 2, "width": 32, "height": 32, "points": 64}
    for name, value in counts.items():
        if value < least[name]:
            raise InputError(name, f"{value} is too few", f"take {least[name]} or more")
    if lidar not in lidars.PATTERNS:
        raise InputError("lidar", f"{lidar[:40]!r} is not known", f"take one of {', '.join(lidars.PATTERNS)}")
    if seed < 0:
        raise InputError("seed", f"{seed} is negative", "take 0 or more")
    if length is not None and not 5 <= length <= 20_000:
        raise InputError("length", f"{length} m cannot be simulated", "take 5 to 20000")


def _streams(scene: str, seed: int) -> list[np.random.Generator]:
    """Independent generators: layout, extrinsics, motion and drift, optics, textures."""
    sequence = np.random.SeedSequence([seed, zlib.crc32(scene.encode())])
    return [np.random.default_rng(child) for child in sequence.spawn(5)]


def _facts(simulation: _Simulation) -> dict[str, Any]:
    """What was put in, for simulation.json."""
    rig, truth, sensor = simulation.rig, simulation.truth, simulation.sensor
    error = rig.camera_from_body @ geometry.inverse(truth.rough_camera_from_body)
    return {
        "seed": simulation.seed,
        "lidar": simulation.lidar,
        "images_taken_after_stamp_s": truth.time_offset,
        "extrinsic_error": {
            "rotation_deg": float(geometry.rotation_angle_deg(error)),
            "translation_m": float(np.linalg.norm(error[:3, 3])),
        },
        "true_camera_from_body": rig.camera_from_body.tolist(),
        "rough_camera_from_body": truth.rough_camera_from_body.tolist(),
        "body_from_lidar": rig.body_from_lidar.tolist(),
        "range_noise_m": lidars.RANGE_NOISE_M,
        "image_noise": sensor.noise,
        "shot_noise": sensor.shot_noise,
        "vignetting": sensor.vignetting,
        "motion_blur_s": _BLUR_S if simulation.motion_blur else 0.0,
    }


Job = Callable[[], None]
"""Finishes and writes one file; may run in any thread."""


def _write_all(root: Path, simulation: _Simulation, progress: Progress) -> None:
    """Casts rays here, where all threads help with one frame, and leaves noise, compression and disk to others."""
    waiting: list[Future[None]] = []
    with ThreadPoolExecutor(2) as pool:
        for name, jobs, count in (
            ("scans", _scans(root, simulation), len(simulation.truth.scans)),
            ("images", _images(root, simulation), len(simulation.truth.images)),
        ):
            for done, job in enumerate(jobs, 1):
                waiting.append(pool.submit(job))
                if len(waiting) > 4:
                    waiting.pop(0).result()
                progress(name, done, count)
        for future in waiting:
            future.result()


def _scans(root: Path, simulation: _Simulation) -> Iterator[Job]:
    """One job for each scan."""
    truth, body_from_lidar, disturb = simulation.truth, simulation.rig.body_from_lidar, simulation.disturb
    for index, (stamp, moment, scene_from_body) in enumerate(
        zip(truth.scans.times, truth.scan_moments, truth.scene_from_body, strict=True)
    ):
        rng = np.random.default_rng([simulation.seed, _SCAN_RNG, index])
        directions = lidars.PATTERNS[simulation.lidar](simulation.points_per_scan, rng)
        path = root / recording.SCANS / f"{stamp:.6f}.pcd"
        if disturb.depth_readout:
            rows = moment + lidars.row_times(directions, disturb.depth_readout)
            scene_from_lidar = simulation.scene.motion.poses(rows) @ body_from_lidar
            points, intensity, _ = lidars.scan(
                simulation.around, scene_from_lidar, directions, rng, disturb, moment
            )
            points_body = geometry.transform_points(body_from_lidar, points)
            yield partial(pcd.write_pcd, path, points_body, intensity)
            continue
        if not disturb.motion_left:
            points, intensity, _ = lidars.scan(
                simulation.around, scene_from_body @ body_from_lidar, directions, rng, disturb, moment
            )
            points_body = geometry.transform_points(body_from_lidar, points)
            yield partial(pcd.write_pcd, path, points_body, intensity)
            continue
        times = lidars.beam_times(simulation.lidar, len(directions))
        motion = simulation.scene.motion
        scene_from_lidar = motion.poses(moment + times) @ body_from_lidar
        points, intensity, beams = lidars.scan(
            simulation.around, scene_from_lidar, directions, rng, disturb, moment
        )
        left = disturbed.deskewed(motion, moment, times[beams], disturb.motion_left) @ body_from_lidar
        points_body = np.einsum("nij,nj->ni", left[:, :3, :3], points) + left[:, :3, 3]
        yield partial(pcd.write_pcd, path, points_body, intensity, stamp + times[beams])


def _images(root: Path, simulation: _Simulation) -> Iterator[Job]:
    """One job for each image."""
    truth, body_from_camera = simulation.truth, geometry.inverse(simulation.rig.camera_from_body)
    for index, stamp in enumerate(truth.images.times):
        exposure, poses = float(simulation.exposure[index]), truth.scene_from_camera[index]
        moment, readout = float(truth.image_moments[index]), simulation.disturb.rolling_shutter
        if simulation.motion_blur or readout:
            length = _BLUR_S * exposure if simulation.motion_blur else 0.0
            moments = cameras.blur_times(moment, length) if length else np.array([moment])
            poses = simulation.scene.motion.poses(moments) @ body_from_camera
            if readout:
                rows = disturbed.row_times(simulation.view.camera.height, readout)
                every = simulation.scene.motion.poses((moments[:, None] + rows).ravel()) @ body_from_camera
                poses = every.reshape(len(moments), len(rows), 4, 4)
        rng = np.random.default_rng([simulation.seed, _IMAGE_RNG, index])
        path = root / recording.IMAGES / f"{stamp:.6f}.png"
        balance = None if simulation.white_balance is None else simulation.white_balance[index]
        radiance = simulation.view.radiance(poses, moment)
        yield partial(_take, path, radiance, simulation.sensor, exposure, rng, balance)


def _take(
    path: Path,
    radiance: np.ndarray,
    sensor: Sensor,
    exposure: float,
    rng: np.random.Generator,
    white_balance: np.ndarray | None,
) -> None:
    images.write_image(path, sensor.picture(radiance, exposure, rng, white_balance))
