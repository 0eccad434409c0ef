"""Each setting of a run changes what the stage that it steers makes of a small scene."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import box_world
import numpy as np
import plane_world
import pytest
import textured_room

from lvba import config, pipeline
from lvba.blocks import split
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.lidar import bundle_adjustment
from lvba.pipeline import Config
from lvba.plan import digest, identity
from lvba.products import evaluate, map_file
from lvba.products.map_quality import EntropyChange
from lvba.steps import acceptance, scan_gate
from lvba.steps.fusion import solve_fusion
from lvba.steps.lidar import solve_lidar
from lvba.steps.outcomes import LidarStage, VisualLevel
from lvba.steps.visual import find_planes, solve_finest, visual_levels
from lvba.trajectory import Trajectory
from lvba.visual import image, keyframes, refine, vignetting
from lvba.visual.vignetting import Vignetting


@cache
def ring(scans=120):
    """A recording twice round a ring, without files: what plans and parts are made from."""
    angle = 4 * np.pi * np.arange(scans) / scans
    poses = np.broadcast_to(np.eye(4), (scans, 4, 4)).copy()
    poses[:, 0, 3], poses[:, 1, 3] = 12 * np.cos(angle), 12 * np.sin(angle)
    return Dataset(
        root="ring",
        scan_paths=tuple(f"{k}.pcd" for k in range(scans)),
        scans=Trajectory(0.5 * np.arange(scans), poses),
        image_paths=tuple(f"{k}.png" for k in range(scans)),
        images=Trajectory(0.5 * np.arange(scans), poses.copy()),
        cameras=(RigCamera(Camera(640, 480, 500.0, 500.0, 320.0, 240.0), np.eye(4)),),
        digest="d",
    )


LOAD = split.Load(30_000, 640 * 480)


def parts(settings):
    return split.parts(ring(), settings.split, LOAD)


def steps(settings):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.survey, "load_of", lambda _: LOAD)
        return [step.name for step in pipeline.refine(ring(), settings).steps.values()]


@cache
def yard():
    scans, _, rough = plane_world.recording("courtyard", scans=4, points=2000, seed=3)
    return scans, rough


def lidar(settings):
    found = bundle_adjustment.refine(*yard(), config=settings.lidar)
    return found.world_from_scan, found.covariance, len(found.planes)


def dense(settings):
    """A wall with a point every centimeter: cells may be finer than by default."""
    y, z = np.meshgrid(np.arange(0, 2, 0.01), np.arange(0, 2, 0.01))
    x = 2 + 0.01 * np.random.default_rng(0).normal(size=y.size)
    wall = np.stack([x, y.ravel(), z.ravel()], axis=1).astype(np.float32)
    poses = np.broadcast_to(np.eye(4), (2, 4, 4))
    return bundle_adjustment.find_planes([wall, wall], poses, config=settings.lidar)[0].center


@cache
def room():
    """Half of the images, a quarter of their pixels: one level, and its points."""
    problem, *_ = textured_room.make()
    pyramid = problem["pyramid"]
    small = replace(
        pyramid,
        levels=pyramid.levels[1:],
        camera=pyramid.camera.at_level(1),
        noise=pyramid.noise[1:],
    )
    return refine.Inputs(**(problem | {"pyramid": small}))


def cameras(settings):
    found = refine.refine_level(room(), None, settings.visual)
    return found.state.cameras.world_from_camera, found.state.calibration.scan_from_camera


def focal(settings):
    right = room().pyramid.camera
    wrong = replace(right, fx=1.01 * right.fx, fy=1.01 * right.fy)
    given = replace(room(), camera=wrong, pyramid=replace(room().pyramid, camera=wrong))
    return refine.refine_level(given, None, settings.visual).state.calibration.focal


def dark_corners(settings):
    pyramid = room().pyramid
    light = vignetting.light_of_pixels(Vignetting((-0.5, -0.1, 0.0)), pyramid.camera, pyramid.camera)
    dark = np.rint(pyramid.levels[0] * light[..., None]).astype(np.uint8)
    pyramid = replace(pyramid, levels=(dark, *pyramid.levels[1:]))
    given = replace(room(), camera=pyramid.camera, pyramid=pyramid)
    return refine.refine_finest(given, None, settings.visual).radiometry.numbers


def chosen(settings):
    moving = np.broadcast_to(np.eye(4), (40, 4, 4)).copy()
    moving[:, 0, 3] = 0.05 * np.arange(40)
    turns = np.radians(1.5) * np.arange(40)
    moving[:, 0, 0] = moving[:, 1, 1] = np.cos(turns)
    moving[:, 1, 0], moving[:, 0, 1] = np.sin(turns), -np.sin(turns)
    return keyframes.select(0.05 * np.arange(40), moving, 5.0, settings.visual.keyframes)


def loaded(settings):
    raw = np.zeros((24, 32, 3), np.uint8)
    return image.load_undistorted(
        lambda _: raw, 1, Camera(32, 24, 20.0, 20.0, 16.0, 12.0), settings.visual.images
    ).shape


def scans_as_they_are(settings):
    nothing = replace(ring(), scan_paths=(), scans=Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    try:
        whole = SimpleNamespace(scan_numbers=range(0))
        return solve_lidar(nothing, whole, [], settings.lidar, settings.refine_scans).problem
    except (ValueError, IndexError) as error:
        return type(error).__name__


def cameras_as_they_are(settings):
    frames = SimpleNamespace(scans=slice(None), images=np.arange(0))
    nothing = SimpleNamespace(world_from_scan=np.zeros((0, 4, 4)))
    survey = SimpleNamespace(keyframes=np.arange(0))
    planes = find_planes(ring(), frames, [], None, nothing, survey, settings.refine_cameras)
    return solve_finest(ring(), None, [], None, planes, VisualLevel(None), settings.visual).problem


def fused(settings):
    scans = SimpleNamespace(verdict=SimpleNamespace(accepted=False))
    return solve_fusion(ring(), LidarStage(None, "none"), scans, None, settings.fusion).problem


def gate(settings):
    changes = [
        EntropyChange(-3.0, -3.0 - gain, gain, error)
        for gain, error in ((0.03, 0.01), (0.03, 0.014), (-0.1, 0.01))
    ]
    figures = [acceptance.entropy_figure(change, settings.gate) for change in changes]
    return [scan_gate.judge_scans(figure, (), settings.gate).accepted for figure in figures]


@cache
def world():
    return box_world.make()


def colored(settings):
    found = map_file.build(world().cloud(), world().views(), settings.map)
    return found.points_world, found.rgb, found.views


def scores(settings):
    state = evaluate.State(world().cloud(), world().views())
    found = evaluate.evaluate({"true": state}, settings.evaluate)["true"]
    return found.psnr, found.map_entropy, found.images


IN_PARTS = ("split.by=count", "split.size=30")
CASES = {
    "refine_scans": (scans_as_they_are, "false"),
    "refine_cameras": (cameras_as_they_are, "false"),
    "remove_moving_points": (steps, "false"),
    "split.by": (parts, "time", "split.by=count", "split.size=25"),
    "split.size": (parts, "40", "split.by=count", "split.size=25"),
    "split.overlap": (parts, "12", "split.by=count", "split.size=40"),
    "split.memory_gb": (parts, "0.7"),
    "split.starts": (parts, "[20.0]"),
    "merge.loops": (steps, "false", *IN_PARTS),
    "merge.coarse_rounds": (steps, "1", *IN_PARTS),
    "merge.scan_rounds": (steps, "1", *IN_PARTS),
    "merge.image_rounds": (steps, "1", *IN_PARTS),
    "lidar.prior_translation": (lidar, "0.01"),
    "lidar.prior_rotation": (lidar, "0.002"),
    "lidar.dense_points": (dense, "0"),
    "lidar.rounds": (lidar, "1"),
    "visual.levels": (lambda settings: visual_levels(ring(), settings.visual), "2"),
    "visual.patch": (cameras, "7"),
    "visual.iterations": (cameras, "1"),
    "visual.calibrate": (focal, "false"),
    "visual.vignetting": (dark_corners, "false"),
    "visual.images.channels": (loaded, "3"),
    "visual.keyframes.interval_s": (chosen, "0.1"),
    "visual.keyframes.translation_ratio": (chosen, "0.02", "visual.keyframes.interval_s=9"),
    "visual.keyframes.rotation_deg": (
        chosen, "3", "visual.keyframes.interval_s=9", "visual.keyframes.translation_ratio=1",
    ),
    "visual.points.cells": (cameras, "200"),
    "visual.points.time_window_s": (cameras, "0.1"),
    "visual.visibility.window": (cameras, "2"),
    "visual.visibility.max_local": (cameras, "2"),
    "visual.visibility.max_global": (cameras, "1"),
    "visual.prior.extrinsic_position_m": (cameras, "0.001"),
    "visual.prior.extrinsic_rotation_deg": (cameras, "0.01"),
    "visual.prior.time_offset_s": (cameras, "0.001"),
    "fusion.enabled": (fused, "false"),
    "gate.enabled": (gate, "false"),
    "gate.min_entropy_gain": (gate, "0.05"),
    "gate.confidence": (gate, "4"),
    "map.colors": (colored, "paper"),
    "map.blend.max_views": (colored, "1"),
    "map.blend.max_angle_deg": (colored, "30"),
    "map.voxel_m": (colored, "0.3"),
    "map.keep_uncolored": (colored, "false"),
    "evaluate.render.splat_px": (scores, "1"),
    "evaluate.entropy.radius_m": (scores, "0.5"),
    "evaluate.max_images": (scores, "2"),
}  # fmt: skip
"""By name: what the stage makes, another value than the default, and the settings at which the two are compared."""


def test_every_setting_has_a_case():
    assert list(CASES) == config.names(Config)


@cache
def made(stage, options):
    return digest(identity(stage(config.override(Config(), options))))


@pytest.mark.parametrize("name", CASES)
def test_setting_changes_what_its_stage_makes(name):
    stage, value, *base = CASES[name]
    before, after = made(stage, tuple(base)), made(stage, (*base, f"{name}={value}"))
    assert before != after
