from dataclasses import replace

import numba
import numpy as np
import pytest
from naive_points import select_points as naive_select_points
from rectangle_world import (
    CAMERA,
    Recording,
    cast,
    plane_points,
    planes_of,
    rained_on,
    rectangle,
    render,
    room_with_screen,
    scan,
)

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import patches, patches_support
from lvba.kernels.scene import Intrinsics
from lvba.lidar.plane import Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import scene_points
from lvba.visual.image import LevelImages, intrinsics_of
from lvba.visual.scene_points import PatchRules, PointsConfig

INTRINSICS = intrinsics_of(CAMERA)
FORWARD = geometry.from_rotation_translation(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""A camera at the origin that looks along world x, y to its left, z up."""


def select(rec, config=PointsConfig(), images=None, *, plane_points=None, **rules):  # noqa: B008
    """Points of a recording at full size."""
    level = LevelImages(rec.images if images is None else images, CAMERA, rec.noise)
    surfaces = replace(rec.surfaces, points=plane_points or rec.plane_points)
    return scene_points.select(level, rec.cameras, surfaces, config, PatchRules(**rules))


@pytest.mark.parametrize(("enough", "rain"), [(scene_points.ENOUGH_IN_BIN, 0.0), (2, 0.1)])
def test_selection_matches_its_twin(enough, rain):
    rec = room_with_screen()
    config = PointsConfig(cells=150)
    lidar = scene_points.kernel_points(rec.planes, rained_on(rec, rain))
    gates = scene_points.point_gates(CAMERA, PatchRules(), rec.noise)._replace(enough=enough)
    cell = scene_points.cell_size(CAMERA, config)
    scores = np.stack([scene_points.difference_of_gaussians(image) for image in rec.images])
    window = np.full(len(rec.times), 0.3)
    ranges = scene_points.near_ranges(rec.times, rec.times, rec.plane_points.scan_offsets, window, 9000)
    args = (
        lidar, ranges[:3], rec.images[:3], scores[:3], rec.poses[:3], INTRINSICS, cell, gates,
    )  # fmt: skip
    pixel, own, _ = patches.select_points(*args)
    expected = naive_select_points(*args)
    columns = -(-CAMERA.width // cell)
    for i in range(3):
        found = {
            (c // columns, c % columns): (*pixel[i, c].tolist(), int(own[i, c]))
            for c in np.flatnonzero(own[i] >= 0)
        }
        different = {k for k in found.keys() | expected[i].keys() if found.get(k) != expected[i].get(k)}
        assert len(found) > 60
        # float32 projection may round a pixel the other way
        assert len(different) <= 0.02 * len(found)


def test_points_lie_where_the_ray_of_their_pixel_meets_the_truth():
    rec = room_with_screen()
    points = select(rec)
    pose = rec.poses[points.reference]
    ray = np.einsum(
        "pij,pj->pi",
        pose[:, :3, :3],
        np.column_stack([(points.pixel - np.array(INTRINSICS[2:])) / INTRINSICS[:2], np.ones(len(points))]),
    )
    depth, hit = (
        np.array([cast(rec.world, p[:3, 3], r[None]) for p, r in zip(pose, ray, strict=True)]).squeeze().T
    )
    truth = pose[:, :3, 3] + depth[:, None] * ray
    wrong = hit != points.plane
    assert wrong.mean() < 0.005
    assert np.abs(points.position_world - truth)[~wrong].max() < 1e-9
    facing = np.einsum("pi,pi->p", points.normal_world, points.position_world - pose[:, :3, 3])
    assert (facing < 0).all()
    assert (np.diff(points.reference) >= 0).all()


def _whole_patch_on_one_rectangle(rec, points, half=4):
    """(P,) bool: do the rays of the patch's corners and centre hit the same rectangle?"""
    same = np.ones(len(points), bool)
    pose = rec.poses[points.reference]
    for du in (-half, 0, half):
        for dv in (-half, 0, half):
            pixel = points.pixel + np.array([du, dv])
            local = np.column_stack(
                [(pixel - np.array(INTRINSICS[2:])) / INTRINSICS[:2], np.ones(len(points))]
            )
            ray = np.einsum("pij,pj->pi", pose[:, :3, :3], local)
            for i in np.unique(points.reference):
                of = points.reference == i
                same[of] &= cast(rec.world, rec.poses[i, :3, 3], ray[of])[1] == points.plane[of]
    return same


def test_support_gate_keeps_patches_on_one_plane(monkeypatch):
    rec = room_with_screen()
    with_gate = _whole_patch_on_one_rectangle(rec, select(rec)).mean()
    for name, value in (("OFF_PLANE_PART", 1.0), ("MIN_SUPPORT", 1), ("EXTENT_SPACINGS", 0.0)):
        monkeypatch.setattr(scene_points, name, value)
    without = select(rec)
    assert with_gate > 0.98
    assert _whole_patch_on_one_rectangle(rec, without).mean() < with_gate - 0.05


def test_one_point_per_cell_and_the_best():
    rec = room_with_screen()
    config = PointsConfig(cells=100)
    points = select(rec, config)
    cell = scene_points.cell_size(CAMERA, config)
    code = points.reference * 10**6 + (points.pixel[:, 1] // cell) * 1000 + points.pixel[:, 0] // cell
    assert len(np.unique(code)) >= 0.95 * len(code), "snapping moves few points into the next cell"
    score = np.stack([scene_points.difference_of_gaussians(image) for image in rec.images])
    chosen = score[points.reference, points.pixel[:, 1], points.pixel[:, 0]]
    assert np.median(chosen) > 2 * np.median(score)


def test_cells_are_as_large_in_a_wider_picture():
    raw = replace(CAMERA, width=CAMERA.width // 2)
    over = scene_points.over(PointsConfig(cells=150), CAMERA, raw)
    assert over.cells == 300
    assert scene_points.cell_size(CAMERA, over) == scene_points.cell_size(raw, PointsConfig(cells=150))
    assert scene_points.over(PointsConfig(cells=150), CAMERA, None).cells == 150


def test_flat_images_give_no_points():
    rec = room_with_screen()
    flat = np.full_like(rec.images, 90)
    assert len(select(rec, images=flat)) == 0
    rng = np.random.default_rng(0)
    noisy = np.round(90 + 2.0 * rng.standard_normal(rec.images.shape)).astype(np.uint8)
    assert len(select(rec, images=noisy, min_score_sigma=6.0)) == 0


def test_view_angle_gate():
    rec = room_with_screen()
    points = select(rec, max_view_angle_deg=40.0)
    view = points.position_world - rec.poses[points.reference, :3, 3]
    cosine = np.abs(np.einsum("pi,pi->p", view, points.normal_world)) / np.linalg.norm(view, axis=1)
    assert len(points) > 50
    assert cosine.min() >= np.cos(np.radians(40))
    assert len(select(rec)) > len(points)


def test_masked_patches_are_refused():
    rec = room_with_screen()
    images = rec.images.copy()
    images[:, 40:80, 60:100] = 255
    images[:, 90:110, 120:160] = 0
    points = select(rec, images=images, min_usable=1.0)
    bad = (images[..., 0] >= 250) | (images[..., 0] <= 3)
    for p in range(len(points)):
        u, v = points.pixel[p]
        assert not bad[points.reference[p], v - 4 : v + 5, u - 4 : u + 5].any()
    near_edge = np.minimum(points.pixel, [CAMERA.width - 1, CAMERA.height - 1] - points.pixel)
    assert near_edge.min() >= 5


def _wall_behind_window():
    """A wall at 3 m with a frame 1 m in front of its right half; the LiDAR sees behind the frame."""
    wall = rectangle([3, -4, -3], [0, 8, 0], [0, 0, 6], 1)
    front = rectangle([2, -4, -3], [0, 4, 0], [0, 0, 6], 2)
    return [wall, front]


def test_points_behind_others_are_hidden():
    world = _wall_behind_window()
    rng = np.random.default_rng(0)
    image = render(world, CAMERA, FORWARD, samples=2, finest=0.15)[None]
    front, _ = scan(world, [0, 0, 0], 40000, 0.01, rng)
    behind, _ = scan(world[:1], [0, 0, 0], 40000, 0.01, rng)
    merged = plane_points([(np.concatenate([front, behind]), np.concatenate([
        np.round(front[:, 0] < 2.5).astype(int), np.zeros(len(behind), int)]))])  # fmt: skip
    rec = Recording(world, image, FORWARD[None], np.zeros(1), planes_of(world), merged, np.ones(1), 1.0)
    points = select(rec)
    right = points.position_world[:, 1] < -0.1
    assert right.sum() > 50
    assert (points.plane[right] == 1).all(), "the wall behind the front is hidden"
    assert (points.plane[points.position_world[:, 1] > 0.3] == 0).all()


def test_drops_of_rain_cost_few_points():
    rec = room_with_screen()
    dry, wet = select(rec), select(rec, plane_points=rained_on(rec, 0.05))
    assert len(wet) > 0.9 * len(dry), (len(wet), len(dry))
    assert _whole_patch_on_one_rectangle(rec, wet).mean() > 0.98


def test_a_slanted_plane_does_not_hide_itself():
    floor = [rectangle([0.5, -6, -1.2], [25, 0, 0], [0, 12, 0], 3)]
    rng = np.random.default_rng(0)
    image = render(floor, CAMERA, FORWARD, samples=3, finest=0.3)[None]
    points_world = np.column_stack(
        [rng.uniform(0.5, 25, 80000), rng.uniform(-6, 6, 80000), np.full(80000, -1.2)]
    )
    points_world[:, 2] += 0.01 * rng.standard_normal(80000)
    seen = plane_points([(points_world, np.zeros(80000, int))])
    rec = Recording(floor, image, FORWARD[None], np.zeros(1), planes_of(floor), seen, np.ones(1), 1.0)
    far = select(rec, max_view_angle_deg=85.0).position_world[:, 0]
    assert (far > 6).sum() > 20


def test_points_without_a_plane_are_no_candidates_but_count_as_off_the_plane():
    rec = room_with_screen()
    screen = rec.plane_points.plane == len(rec.world) - 1
    without = replace(rec.plane_points, plane=np.where(screen, -1, rec.plane_points.plane).astype(np.int32))
    points = select(rec, plane_points=without)
    assert len(points) > 200
    assert (points.plane != len(rec.world) - 1).all()
    assert _whole_patch_on_one_rectangle(rec, points).mean() > 0.98


@pytest.mark.parametrize("turned", [False, True], ids=["rings", "columns"])
@pytest.mark.parametrize("points", [4_000, 60_000])
def test_however_dense_a_ring_is_the_next_one_supports_its_patches(points, turned):
    """Before, the mean spacing of 60,000 points ended the search before the next ring, 2 degrees above."""
    wall = [rectangle([6, -6, -6], [0, 12, 0], [0, 0, 12], 3)]
    rings = np.radians(np.arange(-20, 21, 2.0))
    rng = np.random.default_rng(0)
    along = np.tile(np.linspace(-0.8, 0.8, points // len(rings)), len(rings))
    across = np.repeat(np.tan(rings), points // len(rings))
    y, z = (across, along) if turned else (along, across)
    points_world = 6.0 * np.column_stack([np.ones_like(y), y, z])
    points_world[:, 0] += 0.01 * rng.standard_normal(len(points_world))
    camera = Camera(640, 480, 420.0, 420.0, 319.5, 239.5)
    image = render(wall, camera, FORWARD, samples=2, finest=0.15)[None]
    seen = plane_points([(points_world, np.zeros(len(points_world), int))])
    surfaces = Surfaces(planes_of(wall), seen, np.zeros(1))
    cameras = Trajectory(np.zeros(1), FORWARD[None])
    assert len(scene_points.select(LevelImages(image, camera, 1.0), cameras, surfaces)) > 100


def test_few_points_widen_the_time_window(monkeypatch):
    rec = room_with_screen()
    offsets = rec.plane_points.scan_offsets
    # only the first two scans hold points
    sparse = replace(
        rec.plane_points, scan_offsets=np.append(offsets[:3], np.full(len(offsets) - 3, offsets[2]))
    )
    config = PointsConfig(time_window_s=0.25)
    monkeypatch.setattr(scene_points, "SUPPORT_IN_IMAGE", 0.0)
    monkeypatch.setattr(scene_points, "MIN_POINTS_IN_IMAGE", 0)
    narrow = select(rec, config, plane_points=sparse)
    monkeypatch.setattr(scene_points, "MIN_POINTS_IN_IMAGE", 500)
    wide = select(rec, config, plane_points=sparse)
    assert narrow.reference.max() < 4
    assert wide.reference.max() >= 6


def test_scans_too_sparse_for_patches_at_full_size_widen_the_time_window(monkeypatch):
    rec = room_with_screen()
    points = rec.plane_points
    kept = np.arange(0, len(points.plane), 16)
    sparse = replace(
        points,
        points_world=points.points_world[kept],
        plane=points.plane[kept],
        scan_offsets=np.searchsorted(kept, points.scan_offsets),
    )
    monkeypatch.setattr(scene_points, "MIN_POINTS_IN_IMAGE", 0)
    wide = select(rec, PointsConfig(time_window_s=0.25), plane_points=sparse)
    monkeypatch.setattr(scene_points, "SUPPORT_IN_IMAGE", 0.0)
    narrow = select(rec, PointsConfig(time_window_s=0.25), plane_points=sparse)
    assert len(wide) > 3 * len(narrow) > 0


def test_near_ranges_take_whole_scans_and_at_least_the_nearest():
    offsets = np.array([0, 10, 20, 30, 40])
    scan_times = np.array([0.0, 1.0, 2.0, 3.0])
    ranges = scene_points.near_ranges(np.array([1.1, 9.0]), scan_times, offsets, np.array([1.0, 0.5]), 8)
    np.testing.assert_array_equal(ranges, [[10, 30, 3], [30, 40, 2]])


def test_offset_sigma_grows_away_from_the_centre():
    planes = planes_of([rectangle([0, 0, 0], [2, 0, 0], [0, 1, 0])], 0.02)
    center = planes.center[0]
    sigma = scene_points.offset_sigma(
        planes, np.zeros(3, int), center + np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.3, 0]])
    )
    assert sigma[0] == pytest.approx(planes.sigma_offset[0])
    # a regression's prediction: sigma^2 (1 + x^2 / var x + y^2 / var y)
    assert sigma[1] == pytest.approx(planes.sigma_offset[0] * np.sqrt(1 + 0.25 / (4 / 12)))
    assert sigma[2] == pytest.approx(planes.sigma_offset[0] * np.sqrt(1 + 0.25 / (4 / 12) + 0.09 / (1 / 12)))


def test_dog_noise_constant():
    noise = np.random.default_rng(0).standard_normal((400, 400, 1)).astype(np.float32)
    rms = np.sqrt((scene_points.difference_of_gaussians(noise) ** 2).mean())
    assert rms == pytest.approx(scene_points.DOG_NOISE, rel=0.02)


def test_same_bytes_for_any_number_of_threads():
    rec = room_with_screen()
    results = []
    before = numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        points = select(rec)
        results.append([getattr(points, name).tobytes() for name in points.__dataclass_fields__])
    numba.set_num_threads(before)
    assert results[0] == results[1]


@pytest.mark.parametrize("bad", [{"cells": 0}, {"time_window_s": -1}])
def test_points_config_refuses(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        PointsConfig(**bad)


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-6, 1e-8])
def test_a_point_at_the_very_border_stays_inside_the_cells(gap):
    width, height, size = 640, 480, 4.0
    points = np.array([[width - 0.5 - gap, 3.0, 1.0], [3.0, height - 0.5 - gap, 1.0]])
    uvz, _ = patches_support.project_near(
        points, 0, 2, 1, np.eye(4), Intrinsics(1.0, 1.0, 0.0, 0.0), width, height, 0.1
    )
    assert (uvz[:, 0] + 0.5 < width).all()
    assert (uvz[:, 1] + 0.5 < height).all()
    assert patches_support.z_buffer(uvz, width, height, size)[0].max(initial=-1) == len(uvz) - 1
