"""The z-buffers and samplers against their plain twins."""

import naive_products as naive
import numba
import numpy as np
import pytest

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels import colorize as colorize_kernels
from lvba.kernels import occlusion, splats
from lvba.kernels import zbuffer as kernels
from lvba.kernels.occlusion import FirstPoints
from lvba.kernels.scene import BlockPoints, Intrinsics
from lvba.products import cloud as clouds
from lvba.products import colorize
from lvba.products.views import Views

HEIGHT, WIDTH = 40, 56
TOLERANCE = occlusion.Tolerance(np.float32(6), np.float32(3))


@pytest.fixture(scope="module")
def scene():
    """A few thousand points round a handful of cameras, with stray points far away and behind."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-3, 3, (3000, 3))
    points[:5] *= 1000
    poses = geometry.exp(rng.normal(0, [0.6, 0.6, 0.6, 1, 1, 1], (6, 6)))
    pictures = rng.integers(0, 256, (6, HEIGHT, WIDTH, 3)).astype(np.uint8)
    camera = Camera(WIDTH, HEIGHT, 45.0, 47.0, 27.3, 19.1)
    views = Views(lambda i: pictures[i], camera, np.arange(6.0), poses, rng.normal(0, 0.3, 6))
    return points.astype(np.float32), views, pictures


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("guard", [0, 1])
def test_each_pixel_sees_the_point_in_its_middle_of_what_is_in_front(scene, radius, guard):
    points, views, _ = scene
    source = np.random.default_rng(0).integers(0, 6, len(points)).astype(np.int32)
    blocks = clouds.sort_into_blocks(points)
    ordered, sources = points[blocks.order], source[blocks.order]
    hidden = 0
    for i, pose in enumerate(views.poses):
        entries = splats.splat(
            blocks.holding(by_axis(ordered)), sources, pose, views.intrinsics, i, guard, radius, HEIGHT, WIDTH
        )  # fmt: skip
        depth, index = kernels.split(entries)
        expected = naive.splatted(ordered, sources, pose, views.intrinsics, i, guard, radius, HEIGHT, WIDTH)
        np.testing.assert_array_equal(index, expected[1])
        np.testing.assert_allclose(capped(depth), capped(expected[0]), atol=1e-4)
        assert (index >= 0).mean() > 0.01
        hidden += (index[0] != index[1]).sum()
    assert hidden > 100


def test_of_points_at_one_depth_the_first_wins():
    points = np.array([[0, 0, 2.0], [0, 0, 1.5], [0, 0, 1.5]], np.float32)
    entries = splats.splat(
        BlockPoints(by_axis(points), np.array([0, 3]), np.array([[0, 0, 2, 1]], np.float32)),
        np.zeros(3, np.int32), np.eye(4, dtype=np.float32), Intrinsics(*np.float32([10, 10, 2, 2])), 1, 0, 0, 5, 5,
    )  # fmt: skip
    depth, index = kernels.split(entries)
    assert index[0, 2, 2] == 1
    assert depth[0, 2, 2] == pytest.approx(1.5, abs=1e-4)
    assert (index >= 0).sum() == 2


@pytest.mark.parametrize("per_pixel", [0.3, 1, 10])
@pytest.mark.parametrize("slant", [[0.0, 0.3], [0.3, 0.0], [0.0, 0.0], [-0.4, -0.4]])
def test_a_slanted_surface_stays_where_it_is(slant, per_pixel):
    """Where the nearest point of a splat won, all that is seen was up to a pixel off, to where the surface is farther."""
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics(*np.float32([40, 40, 27.5, 19.5]))
    place = rng.uniform([-1, -1], [WIDTH, HEIGHT], (round(per_pixel * WIDTH * HEIGHT), 2))
    ray = (place - [27.5, 19.5]) / 40
    depth = 4 / (1 + ray @ slant)
    points = np.column_stack([ray, np.ones(len(ray))]) * depth[:, None]
    blocks = clouds.sort_into_blocks(points.astype(np.float32))
    cloud = blocks.holding(by_axis(points[blocks.order].astype(np.float32)))
    source, pose = np.zeros(len(points), np.int32), np.eye(4, dtype=np.float32)
    _, index = kernels.split(splats.splat(cloud, source, pose, intrinsics, 1, 0, 1, HEIGHT, WIDTH))
    row, column = np.nonzero(index[0] >= 0)
    inside = (row > 1) & (row < HEIGHT - 2) & (column > 1) & (column < WIDTH - 2)
    off = place[blocks.order][index[0, row, column]] - np.column_stack([column, row])
    np.testing.assert_allclose(off[inside].mean(0), 0, atol=0.06)


def capped(depth):
    """Depths up to what an entry holds, wherever in its pixel a point is."""
    return np.where(np.isfinite(depth), np.minimum(depth, 1900), depth)


def by_axis(points):
    return np.ascontiguousarray(points.T)


@pytest.mark.parametrize(("cell", "gaps"), [(3, True), (8, False)])
def test_cells_know_how_deep_they_see(scene, cell, gaps):
    points, views, _ = scene
    points = points[np.abs(points).max(1) < 10]
    blocks = clouds.sort_into_blocks(points)
    ordered, poses = points[blocks.order], views.poses
    cells = kernels.seen_depths(
        blocks.holding(by_axis(ordered)), poses, views.intrinsics, cell, HEIGHT, WIDTH
    )
    assert np.isinf(cells).any() == gaps
    for i in range(6):
        expected = naive.seen_depths(ordered, poses[i], views.intrinsics, cell, HEIGHT, WIDTH)
        np.testing.assert_allclose(cells[i], expected, rtol=1e-3)


@pytest.mark.parametrize("cell", [3, 8])
def test_what_lies_behind_the_points_of_an_image_is_hidden_without_them(scene, cell):
    points, views, _ = scene
    points = points[np.abs(points).max(1) < 10]
    source = np.random.default_rng(0).integers(0, 6, len(points)).astype(np.int32)
    blocks = clouds.sort_into_blocks(points)
    ordered, sources = points[blocks.order], source[blocks.order]
    taken = 0
    for i, pose in enumerate(views.poses):
        entries = splats.splat(
            blocks.holding(by_axis(ordered)), sources, pose, views.intrinsics, i, 0, 0, HEIGHT, WIDTH
        )
        left = entries.copy()
        kernels.take_out_hidden(left, cell, 0.02, 0.05)
        np.testing.assert_array_equal(left[0], entries[0])
        every, depth = kernels.split(entries)[0]
        limit = naive.cell_depths(every, cell, stray=0.15) * 1.02 + 0.05
        limit = limit.repeat(cell, 0).repeat(cell, 1)[:HEIGHT, :WIDTH]
        clear = (left[1] != kernels.EMPTY) | (entries[1] == kernels.EMPTY)
        with np.errstate(invalid="ignore"):
            sure = np.isinf(depth) | np.isinf(limit) | (np.abs(depth - limit) > 2e-3 * limit)
        np.testing.assert_array_equal(clear[sure], ((depth <= limit) | np.isinf(depth))[sure])
        taken += (~clear).sum()
    assert taken > 100


def _left_of_a_wall(front):
    """The part of a wall 8 m away, in the colors of another image, that is shown behind points of an image's own."""
    wall = np.column_stack([*np.random.default_rng(0).uniform(-8, 8, (2, 200_000)), np.full(200_000, 8.0)])
    points = np.concatenate([wall, front]).astype(np.float32)
    source = np.repeat([1, 0], [len(wall), len(front)]).astype(np.int32)
    camera = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
    views = Views(lambda _: None, camera, np.zeros(1), np.eye(4)[None], np.zeros(1))
    blocks = clouds.sort_into_blocks(points)
    ordered, sources = points[blocks.order], source[blocks.order]
    entries = splats.splat(
        blocks.holding(by_axis(ordered)), sources, views.poses[0], views.intrinsics, 0, 0, 1, 240, 320
    )
    kernels.take_out_hidden(entries, 16, 0.02, 0.05)
    depth = kernels.split(entries)[0][1]
    return np.mean(np.isfinite(depth) & (depth > 7.9))


def test_stray_points_hide_nothing_beside_them_and_lines_of_a_wall_do():
    """As of a vehicle that drove where the camera looks, a point each 0.1 m; and of a LiDAR's lines on a wall."""
    x, y = np.meshgrid(np.arange(-1.5, 1.5, 0.1), np.arange(-1.2, 1.2, 0.1))
    stray = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)])
    x, y = np.meshgrid(np.arange(-1.5, 1.5, 0.01), np.arange(-1.2, 1.2, 0.1))
    lines = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)])
    assert _left_of_a_wall(stray) > 0.8
    assert _left_of_a_wall(lines) < 0.05


def test_a_floor_seen_at_a_grazing_angle_does_not_hide_itself():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-20, 20, 400000), np.full(400000, 1.5), rng.uniform(1, 40, 400000)])
    post = np.column_stack([rng.uniform(0.4, 0.6, 4000), rng.uniform(-1, 1.5, 4000), np.full(4000, 5.0)])
    points = np.concatenate([floor, post]).astype(np.float32)
    camera, picture = Camera(320, 240, 250.0, 250.0, 159.5, 119.5), np.full((240, 320, 3), 100, np.uint8)
    views = Views(lambda i: picture, camera, np.zeros(1), np.eye(4)[None], np.zeros(1))
    grazing = colorize.ColorizeConfig(max_angle_deg=89)
    seen = colorize.blended(points, views, grazing).views > 0
    pixel = points[:, :2] / points[:, 2:] * 250 + [159.5, 119.5]
    inside = ((pixel > 8) & (pixel < [311, 231])).all(1)
    post_pixel = 0.5 / 5 * 250 + 159.5
    behind = inside & (np.abs(pixel[:, 0] - post_pixel) < 2) & (points[:, 2] > 6)
    free = inside & (np.abs(pixel[:, 0] - post_pixel) > 16) & (points[:, 2] < 25)
    assert behind.sum() > 100
    assert seen[behind].mean() < 0.01
    assert seen[free].mean() > 0.99


def test_one_view_samples_match_plain_bilinear_interpolation(scene):
    points, views, pictures = scene
    pose = views.poses[2]
    valid = np.random.default_rng(1).random((HEIGHT, WIDTH)) > 0.1
    radiance, seen = np.zeros((len(points), 3), np.float32), np.zeros(len(points), bool)
    colorize_kernels.sample_image(points, pose, views.intrinsics, pictures[2], valid, radiance, seen)
    u, v, z = naive.project(points, pose, views.intrinsics)
    inside = (z >= 0.05) & (u >= 0) & (v >= 0) & (u <= WIDTH - 1) & (v <= HEIGHT - 1)
    expected = inside.copy()
    for i in np.flatnonzero(inside):
        expected[i] = valid[int(v[i] + np.float32(0.5)), int(u[i] + np.float32(0.5))]
    np.testing.assert_array_equal(seen, expected)
    assert seen.sum() > 100
    for i in np.flatnonzero(seen):
        np.testing.assert_allclose(radiance[i], naive.bilinear(pictures[2], u[i], v[i])[0], atol=0.01)


def test_best_views_match_a_plain_sort(scene):
    points, views, pictures = scene
    rng = np.random.default_rng(2)
    surface = some_surfaces(len(points), rng)
    pictures = pictures // 2 + 60
    pictures[:, :, 10:20] = 255
    valid = rng.random((HEIGHT, WIDTH)) > 0.1
    usable = colorize_kernels.UsableGray(np.float32(5), np.float32(250))
    blocks = clouds.sort_into_blocks(points)
    ordered, surface, poses = points[blocks.order], surface[blocks.order], views.poses
    slots = (len(points), 2)
    ranks, images, colors = (
        np.zeros(slots, np.float32),
        np.full(slots, -1, np.int32),
        np.zeros((*slots, 3), np.uint8),
    )
    cloud = blocks.holding(by_axis(ordered))
    seen_first = occlusion.first_points(cloud, surface, TOLERANCE, poses, views.intrinsics, 4, HEIGHT, WIDTH)
    for batch in (slice(0, 4), slice(4, 6)):
        part = FirstPoints(seen_first.point[batch], seen_first.front[batch], 4)
        colorize_kernels.collect_views(
            cloud, surface, TOLERANCE, poses[batch], views.intrinsics, pictures[batch],
            np.arange(6, dtype=np.int32)[batch], valid, part, usable,
            colorize_kernels.Samples(ranks, colors, images),
        )  # fmt: skip
    lengths = []
    for k in range(len(points)):
        expected = naive.best_views(
            ordered[k],
            surface[k],
            TOLERANCE,
            poses,
            views.intrinsics,
            pictures,
            valid,
            seen_first,
            usable,
            2,
        )
        lengths.append(len(expected))
        assert np.count_nonzero(ranks[k]) == len(expected)
        best_first = np.argsort(-ranks[k], kind="stable")
        for slot, (rank, color, image) in zip(best_first, expected):
            assert images[k, slot] == image
            np.testing.assert_allclose(ranks[k, slot], rank, rtol=1e-3)
            np.testing.assert_allclose(colors[k, slot], color, atol=0.52)
    assert set(lengths) == {0, 1, 2}


def some_surfaces(count, rng):
    """(M, 8): normals in all directions, a third of them unknown, of another third the side."""
    normal, sensor = rng.normal(size=(2, count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beam = sensor / np.abs((sensor * normal).sum(1, keepdims=True))
    surface = np.column_stack(
        [normal, beam, rng.uniform(0.005, 0.05, count), rng.uniform(0, 0.04, count)]
    ).astype(np.float32)
    surface[::3, :6] = 0
    surface[1::3, 3:6] = 0
    return surface


def test_cells_know_what_they_see_first(scene):
    points, views, _ = scene
    points = points[np.abs(points).max(1) < 10]
    surface = some_surfaces(len(points), np.random.default_rng(5))
    blocks = clouds.sort_into_blocks(points)
    ordered, surface = points[blocks.order], surface[blocks.order]
    found, front, _ = occlusion.first_points(
        blocks.holding(by_axis(ordered)), surface, TOLERANCE, views.poses, views.intrinsics, 4, HEIGHT, WIDTH
    )  # fmt: skip
    assert np.isfinite(found[..., occlusion.FIRST_DEPTH]).any()
    for i, pose in enumerate(views.poses):
        expected, nearest = naive.first_points(
            ordered, surface, TOLERANCE, pose, views.intrinsics, 4, HEIGHT, WIDTH
        )
        np.testing.assert_allclose(found[i], expected, atol=1e-5)
        filled = np.isfinite(found[i].reshape(-1, 8)[front[i], occlusion.FIRST_DEPTH])
        np.testing.assert_array_equal(front[i][filled], nearest[filled])


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_robust_mean_matches_its_twin_and_resists_an_outlier(count):
    rng = np.random.default_rng(count)
    samples = rng.normal(100, 3, (count, 3)).astype(np.float32)
    if count > 2:
        samples[1] = 255
    weights = rng.uniform(0.8, 1, count).astype(np.float32)
    out = np.zeros(3, np.float32)
    scratch = np.empty((3, count), np.float32)
    columns = np.ascontiguousarray(samples.T)
    spread = colorize_kernels.robust_mean(columns, weights, count, np.float32(2), scratch, out)
    expected, expected_spread = naive.robust_mean(samples.astype(float), weights.astype(float), 2.0)
    np.testing.assert_allclose(out, expected, rtol=1e-4)
    np.testing.assert_allclose(spread, expected_spread, rtol=1e-3, atol=1e-3)
    if count > 3:
        assert np.abs(out - 100).max() < 6


def test_thinning_keeps_the_point_nearest_to_each_voxel_center(scene):
    points = np.concatenate([scene[0], scene[0][:500] + np.float32(0.001)])
    np.testing.assert_array_equal(clouds.thin(points, 0.5), naive.thin(points, 0.5))
    assert len(clouds.thin(points, 0)) == len(points)
    kept = clouds.thin_to(points, 50)
    assert 10 < len(kept) <= 50
    assert len(np.unique(kept)) == len(kept)
    np.testing.assert_array_equal(clouds.thin_to(points, len(points)), np.arange(len(points)))


def test_blocks_hold_every_point_once_and_inside_their_sphere(scene):
    points = scene[0]
    blocks = clouds.sort_into_blocks(points)
    np.testing.assert_array_equal(np.sort(blocks.order), np.arange(len(points)))
    for b in range(len(blocks.spheres)):
        inside = points[blocks.order[blocks.start[b] : blocks.start[b + 1]]]
        assert len(inside)
        assert (
            np.linalg.norm(inside - blocks.spheres[b, :3], axis=1).max()
            <= blocks.spheres[b, 3] * 1.001 + 1e-6
        )


def test_results_do_not_depend_on_the_number_of_threads(scene):
    points, views, _ = scene
    before = numba.get_num_threads()
    results = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        try:
            results.append(colorize.blended(points, views, colorize.ColorizeConfig(max_views=2)))
        finally:
            numba.set_num_threads(before)
    for name in ("radiance", "views", "spread"):
        assert getattr(results[0], name).tobytes() == getattr(results[1], name).tobytes()
    assert results[0].views.any()
