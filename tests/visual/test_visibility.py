from itertools import pairwise

import numba
import numpy as np
import pytest
from naive_points import judge as naive_judge
from naive_points import keep_spread as naive_keep_spread
from naive_points import nearest_points as naive_nearest_points
from naive_points import visibility_map as naive_visibility_map
from rectangle_world import (
    CAMERA,
    GATES,
    INTRINSICS,
    NOTHING,
    box,
    cast,
    plane_points,
    rained_on,
    random_pair,
    room_with_screen,
    scan,
)

from lvba.kernels import visibility as kernels
from lvba.kernels.visibility_depth import nearest_points
from lvba.visual import scene_points, visibility
from lvba.visual.image import LevelImages
from lvba.visual.scene_points import PointsConfig, ScenePoints, take
from lvba.visual.visibility import VisibilityConfig


def local_points(rec, cells=150):
    config = PointsConfig(cells=cells)
    level = LevelImages(rec.images, CAMERA, rec.noise)
    return scene_points.select(level, rec.cameras, rec.surfaces, config)


def global_map(rec):
    positions = rec.poses[:, :3, 3]
    near = visibility.cameras_near_scans(rec.times, positions, rec.times, positions)
    pp = rec.plane_points
    return visibility.build_map(pp.points_world, pp.scan_offsets, near, len(rec.images))


def find(rec, points, seen=None, images=None, **changes):
    level = LevelImages(rec.images if images is None else images, CAMERA, rec.noise)
    return visibility.find(level, rec.poses, points, seen, VisibilityConfig(**changes))


@pytest.mark.parametrize("moved", [False, True])
def test_judge_matches_its_twin(moved):
    rec = room_with_screen()
    points = take(local_points(rec), slice(None, None, 5))
    point, target = visibility.local_pairs(points.reference, len(rec.images), 7)
    images = np.repeat(rec.images, 2, axis=3)
    images[..., 1] = 255 - images[..., 1]
    images[3, 60:100, 60:120] = 255
    gates = GATES._replace(min_normal_cosine=0.45, min_scale=0.9, max_scale=1.08, min_ncc=0.75, noise=9.0)
    patches = visibility.kernel_patches(points)
    shift = np.random.default_rng(0).uniform(-1.5, 1.5, (len(point), 2)) if moved else np.zeros((0, 2))
    verdict, ncc = kernels.judge_pairs(
        images, rec.poses, INTRINSICS, patches, point, target, gates, NOTHING, shift
    )
    shifts = shift if moved else np.zeros((len(point), 2))
    expected = [
        naive_judge(images, rec.poses, INTRINSICS, points.position_world[p], points.normal_world[p],
                    points.reference[p], t, points.pixel[p], gates, by)
        for p, t, by in zip(point, target, shifts, strict=True)
    ]  # fmt: skip
    assert set(verdict) >= {0, 2, 3, 4, 6, 7}
    np.testing.assert_array_equal(verdict, [v for v, _ in expected])
    np.testing.assert_allclose(ncc, [n for _, n in expected], atol=1e-5)


def test_how_many_patches_look_alike_tells_right_images_from_wrong_ones():
    rec = room_with_screen()
    points = local_points(rec)
    of_right = find(rec, points, global_map(rec))[1]
    assert of_right.compared > 500
    assert of_right.alike > 0.9 * of_right.compared
    for wrong in (rec.images[::-1], rec.images[:, :, ::-1], np.roll(rec.images, 3, axis=0)):
        images = np.ascontiguousarray(wrong)
        level = LevelImages(images, CAMERA, rec.noise)
        mine = scene_points.select(level, rec.cameras, rec.surfaces, PointsConfig(cells=150))
        of_wrong = find(rec, mine, global_map(rec), images)[1]
        assert of_wrong.compared > 500
        assert of_wrong.alike < 0.25 * of_wrong.compared
    some = np.arange(len(points)) % 2 == 0
    seen_points, observations = find(rec, points)
    _, kept = scene_points.take_observed(seen_points, observations, some[: len(seen_points)])
    assert (kept.compared, kept.alike) == (of_right.compared, of_right.alike)


@pytest.mark.parametrize("limit", [1, 3, 4])
def test_keep_spread_matches_its_twin(limit):
    group = np.repeat([0, 1, 4, 5], [1, 4, 9, 3]).astype(np.int32)
    np.testing.assert_array_equal(kernels.keep_spread(group, limit), naive_keep_spread(group, limit))


def test_global_map_matches_its_twin(monkeypatch):
    rec = room_with_screen()
    monkeypatch.setattr(visibility, "NEAR_TIME_S", 0.25)
    monkeypatch.setattr(visibility, "NEAR_SPACE_M", 0.15)
    seen = global_map(rec)
    positions = rec.poses[:, :3, 3]
    near = visibility.cameras_near_scans(rec.times, positions, rec.times, positions)
    expected = naive_visibility_map(rec.plane_points.points_world, rec.plane_points.scan_offsets, near, 0.5)
    assert len(seen.keys) == len(expected)
    centers = (np.array(list(expected)) + 0.5) * 0.5
    rows = seen.rows(centers)
    assert (rows >= 0).all()
    for row, cameras in zip(rows, expected.values(), strict=True):
        assert seen.cameras[seen.offsets[row] : seen.offsets[row + 1]].tolist() == sorted(cameras)
    assert seen.rows(np.array([[100.0, 0, 0]]))[0] == -1


def test_cameras_near_scans_in_time_and_space(monkeypatch):
    monkeypatch.setattr(visibility, "NEAR_TIME_M", 2.0)
    image_times = np.array([0.0, 0.4, 10.0, 20.0])
    cameras = np.array([[0, 0, 0], [3.0, 0, 0], [0.1, 0, 0], [1.0, 0, 0]])
    offsets, found = visibility.cameras_near_scans(
        np.array([0.0, 5.0, 0.39]),
        np.array([[0, 0, 0], [0, 0, 0], [9.0, 0, 0]]),
        image_times,
        cameras,
    )
    # in time but 3 m off; at the place long after; in time and nearest although far
    assert [found[a:b].tolist() for a, b in pairwise(offsets)] == [[0, 2], [0, 2], [1]]


def test_walls_hide_in_the_global_map():
    rng = np.random.default_rng(0)
    rooms = [*box([-4, -2, -1], [0, 2, 1]), *box([0.1, -2, -1], [4, 2, 1])]
    positions = np.array([[-2.0, 0, 0], [2.0, 0, 0]])
    scans = plane_points([scan(rooms, p, 8000, 0.01, rng) for p in positions])
    near = visibility.cameras_near_scans(np.array([0.0, 9.0]), positions, np.array([0.0, 9.0]), positions)
    seen = visibility.build_map(scans.points_world, scans.scan_offsets, near, 2)
    rows = seen.rows(np.array([[-3.99, 0.3, 0.2], [3.99, 0.3, 0.2]]))
    assert [seen.cameras[seen.offsets[r] : seen.offsets[r + 1]].tolist() for r in rows] == [[0], [1]]


def _points(position, normal, reference):
    n = len(reference)
    return ScenePoints(
        np.asarray(position, float), np.asarray(normal, float), np.ones(n), np.zeros(n), np.asarray(reference, np.int32),
        np.zeros((n, 2), np.int32), np.zeros(n, np.int32), np.zeros(n, bool),
    )  # fmt: skip


def test_area_score_is_pixels_per_square_metre():
    rng = np.random.default_rng(0)
    pose, _, position, normal = random_pair(rng)
    first = np.cross(normal, [1, 0, 0])
    first /= np.linalg.norm(first)
    e = 1e-4
    corners = [position, position + e * first, position + e * np.cross(normal, first)]
    local = np.array([pose[:3, :3].T @ (c - pose[:3, 3]) for c in corners])
    pixels = np.column_stack([CAMERA.fx * local[:, 0] / local[:, 2], CAMERA.fy * local[:, 1] / local[:, 2]])
    area = abs(np.linalg.det([pixels[1] - pixels[0], pixels[2] - pixels[0]])) / e**2
    score = visibility.view_scores(_points([position], [normal], [0]), CAMERA, pose[None])
    assert score[0] == pytest.approx(area, rel=1e-3)


def test_best_view_of_a_voxel_is_near_and_frontal_and_both_forms_can_differ():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[0, 0, 0], [0, 0, 2.0], [0, 0, -2.0]]
    near = _points([[0, 0, 4.0]] * 3, [[0, 0, -1.0]] * 3, [0, 1, 2])
    for form in ("area", "as printed"):
        score = visibility.view_scores(near, CAMERA, poses, form)
        assert visibility.choose_global(near, np.zeros(3, int), score).tolist() == [False, True, False]
    # slanted but near against frontal but far
    slanted = np.array([np.sqrt(1 - 0.3**2), 0, -0.3])
    pair = _points([[0, 0, 4.0], [0, 0, 4.0]], [slanted, [0, 0, -1.0]], [1, 2])
    forms = {f: visibility.view_scores(pair, CAMERA, poses, f) for f in ("area", "as printed")}
    assert forms["area"][0] > forms["area"][1]
    assert forms["as printed"][0] < forms["as printed"][1]


def test_choose_global_takes_one_per_voxel_and_none_without():
    rows = np.array([3, 3, -1, 5, 5, 5])
    score = np.array([1.0, 2.0, 9.0, 4.0, 4.0, 1.0])
    chosen = visibility.choose_global(_points(np.zeros((6, 3)), np.zeros((6, 3)), np.zeros(6)), rows, score)
    assert chosen.tolist() == [False, True, False, True, False, False]


def test_union_is_sorted_without_duplicates_and_marks_what_only_the_map_found():
    rec = room_with_screen()
    points, seen = local_points(rec), global_map(rec)
    kept, pairs = find(rec, points, seen, window=2)
    code = pairs.point.astype(np.int64) * 1000 + pairs.target
    assert (np.diff(code) > 0).all(), "sorted by (point, target), no pair twice"
    assert (pairs.target != kept.reference[pairs.point]).all()
    assert len(np.unique(pairs.point)) == len(kept), "every point has a target"
    far = np.abs(pairs.target - kept.reference[pairs.point]) > 2
    np.testing.assert_array_equal(far, pairs.is_global)
    assert kept.is_global[pairs.point[pairs.is_global]].all()
    assert pairs.is_global.sum() > 50
    assert len(pairs.point) == len(pairs.target) == len(pairs)


def test_points_that_are_not_the_best_of_their_voxel_try_some_far_cameras_and_together_all():
    offsets, cameras = np.array([0, 40, 43]), np.r_[np.arange(40), [0, 7, 30]].astype(np.int32)
    seen = visibility.VisibilityMap(np.array([1, 2]), offsets, cameras, 0.5)
    reference = np.full(300, 10, np.int32)
    rows = np.r_[np.zeros(200, int), np.ones(50, int), np.full(50, -1)]
    wanted = np.arange(300) % 2 == 0
    point, target = visibility.far_pairs(wanted, rows, reference, seen, window=3)
    assert (np.diff(point.astype(np.int64) * 100 + target) > 0).all(), "sorted, no pair twice"
    assert wanted[point].all()
    assert rows[point].min() == 0, "none where the map has no voxel"
    assert (np.abs(target - 10) > 3).all()
    in_first = rows[point] == 0
    assert np.bincount(point[in_first]).max() <= 16
    assert np.bincount(point[in_first])[np.flatnonzero(wanted[:200])].min() >= 12
    np.testing.assert_array_equal(np.unique(target[in_first]), np.r_[:7, 14:40])
    in_second = point[~in_first]
    assert np.unique(target[~in_first]).tolist() == [0, 30], "all of few, but for those near the reference"
    assert np.bincount(in_second)[np.flatnonzero(wanted & (rows == 1))].tolist() == [2] * 25


def test_far_views_of_all_points_tie_a_small_place():
    rec = room_with_screen()
    points, seen = local_points(rec, 400), global_map(rec)
    kept, pairs = find(rec, points, seen, window=2)
    rows = seen.rows(points.position_world)
    voxels = len(np.unique(rows[rows >= 0]))
    with_far = len(np.unique(pairs.point[pairs.is_global]))
    assert with_far > 2 * voxels
    far = np.bincount(pairs.point[pairs.is_global], minlength=len(kept))
    assert far.max() > 3
    assert np.sort(far)[-voxels - 1] <= 3, "of points that are not the best of their voxel, half as many"


def test_without_global_points_only_the_window_is_left():
    rec = room_with_screen()
    points, seen = local_points(rec), global_map(rec)
    kept, local = find(rec, points, None)
    _, both = find(rec, points, seen)
    np.testing.assert_array_equal(local.target, both.target[~both.is_global])
    assert both.is_global.any()
    assert not local.is_global.any()
    assert not kept.is_global.any()


def test_limits_per_point_hold():
    rec = room_with_screen()
    points, seen = local_points(rec), global_map(rec)
    kept, pairs = find(rec, points, seen, window=2, max_local=3, max_global=2)
    local = np.bincount(pairs.point[~pairs.is_global], minlength=len(kept))
    far = np.bincount(pairs.point[pairs.is_global], minlength=len(kept))
    assert local.max() == 3
    assert far.max() == 2


def test_targets_truly_see_their_points():
    rec = room_with_screen()
    kept, pairs = find(rec, local_points(rec, 400), global_map(rec))
    position = kept.position_world[pairs.point]
    origin = rec.poses[pairs.target, :3, 3]
    seen = np.ones(len(pairs), bool)
    for t in np.unique(pairs.target):
        of = pairs.target == t
        seen[of] = cast(rec.world, origin[of][0], position[of] - origin[of])[0] > 0.999
    assert len(pairs) > 2000
    assert seen.mean() > 0.995


def test_occluded_targets_are_refused():
    rec = room_with_screen(sideways=True)
    points, point, target, visible = _pair_truth(rec)
    kept, pairs = find(rec, points, window=7, max_local=20)
    # pairs of the points before those without any were dropped
    old = np.flatnonzero(np.isin(np.arange(len(points)), _index_in(points, kept)))
    passed = np.isin(point * 1000 + target, old[pairs.point] * 1000 + pairs.target)
    assert (~visible).sum() > 50
    assert passed[visible].mean() > 0.5
    assert passed[~visible].mean() < 0.1


def _pair_truth(rec, window=7):
    """Points, candidate pairs, and whether the target truly sees the point."""
    points = local_points(rec, 600)
    point, target = visibility.local_pairs(points.reference, len(rec.images), window)
    visible = np.empty(len(point), bool)
    for t in range(len(rec.images)):
        of, origin = target == t, rec.poses[t, :3, 3]
        visible[of] = cast(rec.world, origin, points.position_world[point[of]] - origin)[0] > 0.999
    return points, point, target, visible


def _verdict_of_geometry(rec, points, point, target, depth):
    """What the gates say of pairs that no look at the images refuses."""
    gates = GATES._replace(
        min_scale=0.1, max_scale=10.0, min_ncc=-2.0, dark=-1.0, bright=300.0, min_usable=0.0
    )
    verdict, _ = kernels.judge_pairs(
        rec.images, rec.poses, INTRINSICS, visibility.kernel_patches(points), point, target, gates, depth.at(CAMERA),
        np.zeros((0, 2)),
    )  # fmt: skip
    return verdict


def test_depth_buffers_match_their_twin():
    rec = room_with_screen(sideways=True)
    ranges = scene_points.near_ranges(
        rec.times, rec.times, rec.plane_points.scan_offsets, np.full(8, 0.3), 9000
    )
    args = (
        rained_on(rec, 0.1).points_world,
        ranges,
        rec.poses,
        INTRINSICS,
        CAMERA.width,
        CAMERA.height,
        3.7,
        0.1,
    )
    found = nearest_points(*args)
    for i, expected in enumerate(naive_nearest_points(*args)):
        cells = {(int(r), int(c)): int(found[i, r, c]) for r, c in np.argwhere(found[i] >= 0)}
        assert cells == expected
        assert len(cells) > 400


def test_depth_buffers_refuse_hidden_targets_without_looking_at_the_images():
    rec = room_with_screen(sideways=True)
    points, point, target, visible = _pair_truth(rec)
    depth = visibility.depth_buffers(CAMERA, rec.poses, rec.times, rec.plane_points, rec.times)
    half_camera = CAMERA.at_level(1)
    half = visibility.depth_buffers(half_camera, rec.poses, rec.times, rec.plane_points, rec.times)
    verdict = _verdict_of_geometry(rec, points, point, target, depth)
    judged = np.isin(verdict, [kernels.PASSED, kernels.HIDDEN])
    hidden = verdict == kernels.HIDDEN
    assert (judged & ~visible).sum() > 50
    assert hidden[judged & ~visible].mean() > 0.95
    assert hidden[judged & visible].mean() < 0.08, "patches at the screen's border count as hidden"
    assert half.cell == pytest.approx(depth.cell, rel=0.1), "the same at every level"


def test_drops_of_rain_hide_few_patches():
    rec = room_with_screen(sideways=True)
    points, point, target, visible = _pair_truth(rec)
    depth = visibility.depth_buffers(CAMERA, rec.poses, rec.times, rained_on(rec, 0.05), rec.times)
    verdict = _verdict_of_geometry(rec, points, point, target, depth)
    judged, hidden = np.isin(verdict, [kernels.PASSED, kernels.HIDDEN]), verdict == kernels.HIDDEN
    assert hidden[judged & ~visible].mean() > 0.95
    assert hidden[judged & visible].mean() < 0.12, "where each drop counted, a third of them"


def _index_in(points, kept):
    """Indices of the kept points among all."""
    code = {
        (r, *p): k for k, (r, p) in enumerate(zip(points.reference, map(tuple, points.pixel), strict=True))
    }
    return [code[(r, *p)] for r, p in zip(kept.reference, map(tuple, kept.pixel), strict=True)]


def test_same_bytes_for_any_number_of_threads():
    rec = room_with_screen()
    points, results, before = local_points(rec), [], numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        seen = global_map(rec)
        kept, pairs = find(rec, points, seen)
        arrays = (
            seen.keys,
            seen.offsets,
            seen.cameras,
            kept.position_world,
            pairs.point,
            pairs.target,
            pairs.is_global,
        )
        results.append([array.tobytes() for array in arrays])
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_nothing_in_nothing_out():
    rec = room_with_screen()
    none = take(local_points(rec), slice(0, 0))
    kept, pairs = find(rec, none, global_map(rec))
    assert len(kept) == len(pairs) == 0
    nobody = (np.zeros(1, np.int64), np.empty(0, np.int32))
    empty = visibility.build_map(np.empty((0, 3), np.float32), np.zeros(1, np.int64), nobody, 3)
    assert empty.rows(np.zeros((2, 3))).tolist() == [-1, -1]


@pytest.mark.parametrize("bad", [{"window": 0}, {"max_local": 0}, {"max_global": 1001}])
def test_visibility_config_refuses(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        VisibilityConfig(**bad)
