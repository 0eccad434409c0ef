from dataclasses import replace

import cv2
import numba
import numpy as np
import pytest
from naive_points import blank_masked as naive_blank_masked
from naive_points import compare as naive_compare
from naive_points import warp_by_plane
from rectangle_world import CAMERA, look, plane_points, planes_of, rectangle, render, room_with_screen, scan

from lvba.camera import Camera
from lvba.kernels import patches_mean
from lvba.kernels.scene import PlanePatches
from lvba.lidar.plane import Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import edge_means, exposure, exposure_graph, image, visibility
from lvba.visual.exposure import solve_ratios
from lvba.visual.exposure_graph import BLOCKS
from lvba.visual.image import Pyramid, intrinsics_of
from lvba.visual.ratios import Ratios


def _solve(rec, images=None, levels=2):
    pyramid = image.build_pyramid(rec.images if images is None else images, CAMERA, levels)
    return exposure.solve(pyramid, rec.cameras, rec.surfaces, None)


def _error(found, truth):
    error = found.log_exposure - np.log(truth)
    return error - error.mean()


def _graph(rng, images=12, per_edge=20, sigma=0.01, skip=()):
    truth = np.cumsum(0.2 * rng.standard_normal(images))
    first, second = np.array(
        [
            (i, j)
            for i in range(images)
            for j in range(images)
            if 0 < abs(i - j) <= 3 and not {i, j} & set(skip)
        ]
    ).T
    first, second = np.repeat(first, per_edge), np.repeat(second, per_edge)
    value = truth[second] - truth[first] + sigma * rng.standard_normal(len(first))
    block = rng.integers(0, BLOCKS, len(first))
    spread, level = np.full(len(first), sigma), np.full(len(first), np.log(100.0))
    ratios = Ratios(
        first.astype(np.int32),
        second.astype(np.int32),
        value,
        spread,
        block,
        block,
        level,
        np.arange(len(first)),
    )
    return truth, ratios


def test_graph_of_exact_ratios_gives_the_exact_exposures():
    truth, ratios = _graph(np.random.default_rng(0), sigma=1e-4)
    exact = replace(ratios, value=truth[ratios.second] - truth[ratios.first])
    found = solve_ratios(exact, len(truth))
    np.testing.assert_allclose(found.log_exposure, truth - truth[0], atol=1e-12)
    assert found.component.tolist() == [0] * len(truth)
    assert found.pairs == len(ratios.value)


@pytest.fixture
def no_floors(monkeypatch):
    monkeypatch.setattr(exposure, "EDGE_FLOOR", 1e-6)
    monkeypatch.setattr(exposure, "FEW_PATCHES", 0.0)


@pytest.mark.usefixtures("no_floors")
def test_sigma_predicts_the_error():
    nees = []
    for seed in range(40):
        truth, ratios = _graph(np.random.default_rng(seed), sigma=0.05)
        found = solve_ratios(ratios, len(truth))
        nees.append((_error(found, np.exp(truth)) / found.sigma) ** 2)
    assert 0.5 < np.mean(nees) < 1.5


@pytest.mark.usefixtures("no_floors")
def test_sigma_grows_where_patches_err_together():
    rng = np.random.default_rng(1)
    nees = []
    for _ in range(20):
        truth, ratios = _graph(rng, sigma=0.01)
        # each part of the surface looks brighter or darker to each image, to all pairs alike
        shift = 0.01 * rng.standard_normal((len(truth), BLOCKS))
        value = ratios.value + shift[ratios.second, ratios.block] - shift[ratios.first, ratios.block]
        found = solve_ratios(replace(ratios, value=value), len(truth))
        nees.append((_error(found, np.exp(truth)) / found.sigma) ** 2)
    assert 0.4 < np.mean(nees) < 2.5


@pytest.mark.usefixtures("no_floors")
def test_sigma_grows_where_stretches_of_surface_err_together():
    """Small blocks, each of patches from all stretches, show nothing of it."""
    rng = np.random.default_rng(7)
    nees, small = [], []
    for _ in range(20):
        truth, ratios = _graph(rng, sigma=0.01)
        stretch = rng.integers(0, BLOCKS, len(ratios.value))
        shift = 0.01 * rng.standard_normal((len(truth), BLOCKS))
        value = ratios.value + shift[ratios.second, stretch] - shift[ratios.first, stretch]
        for sizes, of in ((ratios.block, small), (stretch, nees)):
            estimate = solve_ratios(replace(ratios, value=value, stretch=sizes), len(truth))
            of.append((_error(estimate, np.exp(truth)) / estimate.sigma) ** 2)
    assert 0.4 < np.mean(nees) < 2.5
    assert np.mean(small) > 1.2 * np.mean(nees)


def test_sigma_stays_sound_where_one_block_joins_two_groups_of_images():
    rng = np.random.default_rng(8)
    truth, ratios = _graph(rng, sigma=0.01)
    across = (np.minimum(ratios.first, ratios.second) < 6) & (np.maximum(ratios.first, ratios.second) >= 6)
    alone = replace(ratios, stretch=np.where(across, 0, 1 + ratios.block % (BLOCKS - 1)))
    joined, parted = (solve_ratios(each, len(truth)).sigma for each in (ratios, alone))
    assert parted.mean() < 2 * joined.mean()


def _tied_by_few(rng, patches=2, targets=5, sigma=0.01):
    """The graph of `_graph`, and one image more whose patches, few, are each compared with several images."""
    truth, ratios = _graph(rng, sigma=sigma)
    new, count = len(truth), patches * targets
    truth = np.append(truth, 0.3)
    patch = np.repeat(np.arange(patches), targets)
    second = np.tile(np.arange(new - targets, new), patches)
    # half of the variance is that of the view in the image itself
    own, other = rng.standard_normal(patches)[patch], rng.standard_normal(count)
    value = truth[second] - truth[new] + sigma * (other - own) / np.sqrt(2)
    more = {
        "first": np.full(count, new, np.int32),
        "second": second.astype(np.int32),
        "value": value,
        "sigma": np.full(count, sigma),
        "block": patch,
        "stretch": patch,
        "level": np.full(count, np.log(100.0)),
        "patch": ratios.patch.max() + 1 + patch,
    }
    return truth, replace(
        ratios, **{name: np.concatenate([getattr(ratios, name), each]) for name, each in more.items()}
    )


@pytest.mark.usefixtures("no_floors")
def test_sigma_knows_that_one_patch_is_compared_with_several_images():
    rng = np.random.default_rng(11)
    shared, apart = [], []
    for _ in range(60):
        truth, ratios = _tied_by_few(rng)
        for patch, of in ((ratios.patch, shared), (np.arange(len(ratios.patch)), apart)):
            found = solve_ratios(replace(ratios, patch=patch), len(truth))
            of.append((_error(found, np.exp(truth))[-1] / found.sigma[-1]) ** 2)
    assert 0.5 < np.mean(shared) < 2.5
    assert np.mean(apart) > 1.8 * np.mean(shared)


@pytest.mark.usefixtures("no_floors")
def test_sigma_holds_where_all_patches_of_a_pair_of_images_err_alike():
    rng, nees = np.random.default_rng(12), []
    for _ in range(20):
        truth, ratios = _graph(rng, sigma=0.01)
        low, high = np.minimum(ratios.first, ratios.second), np.maximum(ratios.first, ratios.second)
        common = 0.02 * rng.standard_normal((len(truth), len(truth)))[low, high]
        value = ratios.value + np.where(ratios.first == low, common, -common)
        found = solve_ratios(replace(ratios, value=value), len(truth))
        nees.append((_error(found, np.exp(truth)) / found.sigma) ** 2)
    assert 0.4 < np.mean(nees) < 2.5


def _bridged(truth, patches, off):
    """Two halves of images that few patches tie, each in a block of its own, and off by so much."""
    rng = np.random.default_rng(15)
    _, ratios = _graph(rng, images=len(truth))
    half = len(truth) // 2
    low, high = np.minimum(ratios.first, ratios.second), np.maximum(ratios.first, ratios.second)
    across = (low < half) & (high >= half)
    bridge = np.flatnonzero(across)[:: np.count_nonzero(across) // 16]
    value = truth[ratios.second] - truth[ratios.first] + 0.01 * rng.standard_normal(len(across))
    value[bridge] += np.where(ratios.first[bridge] < half, off, -off)
    block = ratios.block.copy()
    block[bridge] = np.arange(len(bridge)) % patches
    kept = np.sort(np.concatenate([np.flatnonzero(~across), bridge]))
    names = ("first", "second", "sigma", "stretch", "level", "patch")
    some = {name: getattr(ratios, name)[kept] for name in names}
    return solve_ratios(Ratios(**some, value=value[kept], block=block[kept]), len(truth))


@pytest.mark.parametrize("patches", [1, 2])
def test_one_patch_alone_ties_no_images(patches):
    """It may be of another surface in some of them: images beyond it are known to nothing, whatever it says."""
    truth = np.cumsum(0.2 * np.random.default_rng(16).standard_normal(13))
    found = _bridged(truth, patches, 0.5)
    assert (found.component == 0).all()
    assert np.isfinite(found.sigma[6:]).all()
    assert np.isinf(found.sigma[:6]).all() == (patches == 1)
    for part in (slice(0, 6), slice(6, 13)):
        assert np.abs(np.diff(found.log_exposure[part]) - np.diff(truth[part])).max() < 0.02


@pytest.mark.parametrize(("off", "believed"), [(0.0, True), (0.5, False)])
def test_one_patch_is_believed_if_exposures_change_as_it_says(off, believed):
    truth = np.cumsum(0.05 * np.random.default_rng(17).standard_normal(40))
    found = _bridged(truth, 1, off)
    step = found.log_exposure[20] - found.log_exposure[19]
    assert step == pytest.approx(truth[20] - truth[19] if believed else 0.0, abs=0.02)
    assert np.abs(np.diff(found.log_exposure[20:]) - np.diff(truth[20:])).max() < 0.02


@pytest.mark.usefixtures("no_floors")
def test_an_image_whose_ties_contradict_each_other_is_uncertain():
    truth, ratios = _tied_by_few(np.random.default_rng(13), patches=2, targets=4)
    agreeing = solve_ratios(ratios, len(truth))
    value = ratios.value.copy()
    value[-8:] += 0.2 * np.tile([0.0, 0.0, 1.0, 1.0], 2)
    found = solve_ratios(replace(ratios, value=value), len(truth))
    assert agreeing.contradiction.max() < 2
    assert found.contradiction[-1] > 5
    assert found.sigma[-1] > 2 * agreeing.sigma[-1]
    assert np.delete(found.contradiction, -1).max() < 0.5 * found.contradiction[-1]


def test_a_pair_of_images_is_as_uncertain_as_its_patches_scatter():
    rng = np.random.default_rng(14)
    edge, sigma = np.repeat(np.arange(10), 12), np.full(120, 0.01)
    value = 0.01 * rng.standard_normal(120)
    value[edge == 3] *= 30
    _, found, _ = edge_means.edge_means(edge, value, sigma, 10)
    assert found[3] > 5 * np.delete(found, 3).max()


def test_wrong_patches_and_wrong_pairs_of_images_do_little():
    rng = np.random.default_rng(2)
    truth, ratios = _graph(rng)
    value = ratios.value.copy()
    value[rng.random(len(value)) < 0.15] -= 0.5
    whole_edge = (ratios.first == 2) & (ratios.second == 4) | (ratios.first == 4) & (ratios.second == 2)
    value[whole_edge & (ratios.first == 2)] += 0.3
    value[whole_edge & (ratios.first == 4)] -= 0.3
    found = solve_ratios(replace(ratios, value=value), len(truth))
    assert np.abs(_error(found, np.exp(truth))).max() < 0.01


def test_two_components_and_a_lone_image():
    rng = np.random.default_rng(3)
    truth, ratios = _graph(rng, images=13, skip=(5, 6))
    across = (np.minimum(ratios.first, ratios.second) < 5) & (np.maximum(ratios.first, ratios.second) > 6)
    kept = Ratios(
        *(
            getattr(ratios, name)[~across]
            for name in ("first", "second", "value", "sigma", "block", "stretch", "level", "patch")
        )
    )
    found = solve_ratios(kept, 13)
    assert found.component.tolist() == [0] * 5 + [1, 2] + [3] * 6
    # nothing tells how the first images compare with the last, which are more
    assert np.isinf(found.sigma[:7]).all()
    assert np.isfinite(found.sigma[7:]).all()
    for part in (slice(0, 5), slice(7, 13)):
        assert np.abs(np.diff(found.log_exposure[part]) - np.diff(truth[part])).max() < 0.02
    # no measurement, no jump
    assert found.log_exposure[5] == found.log_exposure[6] == found.log_exposure[7] == found.log_exposure[4]


def test_nothing_to_compare():
    none = np.empty(0)
    found = solve_ratios(
        Ratios(
            none.astype(np.int32),
            none.astype(np.int32),
            none,
            none,
            none.astype(int),
            none.astype(int),
            none,
            none.astype(int),
        ),
        3,
    )
    assert found.log_exposure.tolist() == [0, 0, 0]
    assert np.isinf(found.sigma).all()
    assert found.pairs == 0


def test_medians_match_numpy():
    rng = np.random.default_rng(0)
    group, value = rng.integers(0, 7, 200), rng.standard_normal(200)
    expected = [np.median(value[group == g]) for g in range(7)]
    np.testing.assert_allclose(edge_means.medians(group, value, 7), expected)


def test_blocks_make_up_their_edges():
    rng = np.random.default_rng(0)
    edge, block = rng.integers(0, 3, 90), rng.integers(0, BLOCKS, 90)
    value, weight = rng.standard_normal(90), rng.uniform(0.5, 2, 90)
    edge[0], edge[1:][edge[1:] == 2] = 2, 1
    mean = np.array([np.average(value[edge == e], weights=weight[edge == e]) for e in range(3)])
    share, pull = edge_means.pieces_of_means(edge, value, weight, block, mean)
    for e in range(2):
        for b in range(BLOCKS):
            rest = (edge == e) & (block != b)
            without = mean[e] - pull[e, b] / (1 - share[e, b])
            assert without == pytest.approx(np.average(value[rest], weights=weight[rest]))
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    assert np.abs(pull[2]).max() < 1e-12


def test_exposures_of_a_room():
    rec = room_with_screen()
    found = _solve(rec)
    error = _error(found, rec.exposure)
    assert np.sqrt((error**2).mean()) < 0.003
    assert (found.component == 0).all()
    assert 0.2 < np.mean((error / found.sigma) ** 2) < 4


def test_clipped_light_does_not_darken_the_brighter_image(monkeypatch):
    rec = room_with_screen()
    gain = np.where(np.arange(len(rec.images)) % 2, 1.7, 1.0)
    rng = np.random.default_rng(0)
    bright = np.clip(
        rec.images * gain[:, None, None, None] + rng.uniform(-0.5, 0.5, rec.images.shape), 0, 255
    )
    clipped = np.round(bright).astype(np.uint8)
    assert (clipped[1::2] >= 250).mean() > 0.05
    found = _solve(rec, clipped)
    error = _error(found, rec.exposure * gain)
    assert abs(error[1::2].mean() - error[::2].mean()) < 0.004
    # without keeping away from clipped spots the same images are off
    monkeypatch.setattr(exposure, "MASK_REACH", 0)
    monkeypatch.setattr(exposure, "BRIGHT", 250.0)
    near = _error(_solve(rec, clipped), rec.exposure * gain)
    assert abs(near[1::2].mean() - near[::2].mean()) > abs(error[1::2].mean() - error[::2].mean())


def _approach(seed):
    """A wall with fine texture seen from nearer and nearer, every view blurred by its pixels."""
    rng = np.random.default_rng(seed)
    wall = [rectangle([6, -6, -4], [0, 12, 0], [0, 0, 8], seed)]
    poses = np.array([look([0.5 * i, 0, 0], [6, 0.2, 0]) for i in range(6)])
    images = np.stack(
        [render(wall, CAMERA, p, 0.8, 1.0, rng, samples=3, finest=0.05, waves=10) for p in poses]
    )
    scans = plane_points([scan(wall, p[:3, 3], 8000, 0.01, rng) for p in poses])
    return images, poses, scans, planes_of(wall, 0.01)


def test_walking_ahead_does_not_add_up():
    slopes = []
    for seed in range(2):
        images, poses, scans, planes = _approach(seed)
        times = 0.2 * np.arange(len(poses))
        pyramid = image.build_pyramid(images, CAMERA, 2)
        found = exposure.solve(pyramid, Trajectory(times, poses), Surfaces(planes, scans, times), None)
        assert (found.component == 0).all()
        slopes.append(found.log_exposure[-1] - found.log_exposure[0])
    assert abs(np.mean(slopes)) < 0.003
    assert np.max(np.abs(slopes)) < 0.01


def test_hidden_patches_are_not_compared():
    rec = room_with_screen(sideways=True)
    pyramid = image.build_pyramid(rec.images, CAMERA, 2)
    args = (pyramid, rec.cameras, rec.surfaces, None)
    with_depth = exposure.solve(*args)
    without = exposure.solve(*args, depth=visibility.NOTHING_HIDES)
    assert with_depth.pairs < without.pairs
    assert np.sqrt((_error(with_depth, rec.exposure) ** 2).mean()) < 0.003


def test_a_part_of_the_patches_gives_exposures_to_begin_a_finer_level_from():
    rec = room_with_screen()
    pyramid = image.build_pyramid(rec.images, CAMERA, 2)
    few, every = (
        exposure.solve(pyramid, rec.cameras, rec.surfaces, None, cells=cells)
        for cells in (12, exposure.CELLS)
    )
    assert few.pairs < 0.5 * every.pairs
    assert np.sqrt((_error(few, rec.exposure) ** 2).mean()) < 0.005


def test_placing_does_not_look_at_the_images():
    rec = room_with_screen()
    args = (CAMERA.at_level(1), rec.cameras, rec.surfaces)
    half = image.build_pyramid(rec.images, CAMERA, 2).levels[1]
    first = exposure.place(half, *args)
    second = exposure.place(np.clip(255 - half, 1, 249).astype(np.uint8), *args)
    np.testing.assert_array_equal(first.pixel, second.pixel)
    assert len(first) > 100


@pytest.mark.parametrize("dilation", [0, 1])
@pytest.mark.parametrize("channels", [1, 3])
def test_measuring_matches_its_twin(dilation, channels):
    rec = room_with_screen()
    images = np.repeat(rec.images[:4], channels, axis=3)
    images[1, 70:80, 90:110] = 255
    images = naive_blank_masked(images, dilation, 3, 250)
    finer = np.repeat(np.repeat(images, 2, axis=1), 2, axis=2)
    coarser = np.ascontiguousarray(images[:, ::2, ::2])
    camera, rng = CAMERA, np.random.default_rng(0)
    pixel = np.column_stack([rng.integers(20, 180, 40), rng.integers(20, 130, 40)]).astype(np.int32)
    reference = rng.integers(0, 4, 40).astype(np.int32)
    position = rec.poses[reference, :3, 3] + 3 * rec.poses[reference, :3, 2]
    normal = -rec.poses[reference, :3, 2]
    target = ((reference + rng.integers(1, 4, 40)) % 4).astype(np.int32)
    poses = rec.poses[:4].copy()
    poses[3, :3, 3] += 1.6 * poses[3, :3, 2]  # one much nearer, so that other levels are read
    gates = exposure.mean_gates()._replace(
        min_normal_cosine=0.2, min_scale=0.3, max_scale=4.0, min_usable=0.5
    )
    intrinsics = intrinsics_of(camera)
    found = patches_mean.measure_pairs(
        finer, images, coarser, poses, intrinsics, PlanePatches(position, normal, reference, pixel),
        np.arange(40, dtype=np.int32), target, 7, gates, visibility.NOTHING_HIDES.at(camera),
    )  # fmt: skip
    used = 0
    for k in range(40):
        r, t = poses[reference[k]], poses[target[k]]

        def moved(du, dv, k=k, r=r, t=t):
            return warp_by_plane(pixel[k, 0] + du, pixel[k, 1] + dv, r, t, position[k], normal[k], intrinsics)

        e = 1e-4
        jacobian = np.array(
            [np.subtract(moved(e, 0)[:2], moved(-e, 0)[:2]), np.subtract(moved(0, e)[:2], moved(0, -e)[:2])]
        )
        jacobian = jacobian.T / (2 * e)
        scale = np.sqrt(abs(np.linalg.det(jacobian)))
        shrink, source = (
            (0.5, coarser) if scale > 2**0.5 else (2.0, finer) if scale < 0.5**0.5 else (1.0, images)
        )
        expected = naive_compare(
            images[reference[k]], source[target[k]], pixel[k], moved, shrink, jacobian, 7, 0.5
        )
        if found[k, 0] < 0:
            continue
        used += 1
        np.testing.assert_allclose(found[k], expected, rtol=1e-6, atol=1e-6)
    assert used > 15


def test_a_farther_view_of_rough_texture_is_not_brighter():
    """Exact pictures of one plane from 1 and 1.4 m: pixels are means over 10 x 10 and 14 x 14 texels."""
    rng, side = np.random.default_rng(5), 300
    texels = np.exp(0.45 * 32 * cv2.GaussianBlur(rng.standard_normal((10 * side, 10 * side)), (0, 0), 9))
    texels *= 40 / texels.mean()
    near = texels.reshape(side, 10, side, 10).mean(axis=(1, 3))
    far, first, count = np.zeros((side, side)), side // 7 + 2, 5 * side // 7 - 4
    start = 14 * first - 2 * side
    part = texels[start : start + 14 * count, start : start + 14 * count]
    far[first : first + count, first : first + count] = part.reshape(count, 14, count, 14).mean(axis=(1, 3))
    rounded = [np.floor(each + rng.random(each.shape)) for each in (near, far)]
    images = np.minimum(np.stack(rounded), 255).astype(np.uint8)[..., None]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 2, 3] = -0.4
    camera = Camera(side, side, float(side), float(side), (side - 1) / 2, (side - 1) / 2)
    column, row = (each.ravel() for each in np.meshgrid(*2 * [np.arange(15, side - 15, 3)]))
    pixel = np.stack([column, row], axis=1).astype(np.int32)
    position = np.column_stack([(pixel - (side - 1) / 2) / side, np.ones(len(pixel))])
    patches = PlanePatches(
        position, np.tile([0.0, 0.0, -1.0], (len(pixel), 1)), np.zeros(len(pixel), np.int32), pixel
    )
    means = patches_mean.measure_pairs(
        images, images, images, poses, intrinsics_of(camera), patches,
        np.arange(len(pixel), dtype=np.int32), np.ones(len(pixel), np.int32), 11, exposure.mean_gates(),
        visibility.NOTHING_HIDES.at(camera),
    )  # fmt: skip
    good = means[:, 0] > 0
    ratio = np.log(means[good, 1] / means[good, 0])
    assert good.mean() > 0.8
    assert abs(ratio.mean()) < 0.0003


def test_same_bytes_for_any_number_of_threads():
    rec, results, before = room_with_screen(), [], numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        found = _solve(rec)
        results.append((found.log_exposure.tobytes(), found.sigma.tobytes()))
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_pyramid_too_short_is_extended():
    rec = room_with_screen()
    full = image.build_pyramid(rec.images, CAMERA, 3)
    short = Pyramid(full.levels[:1], CAMERA, full.noise[:1])
    args = (rec.cameras, rec.surfaces, None)
    np.testing.assert_array_equal(
        exposure.solve(short, *args).log_exposure, exposure.solve(full, *args).log_exposure
    )


def test_influence_of_edges_is_that_of_the_dense_inverse(monkeypatch):
    monkeypatch.setattr(exposure_graph, "_COLUMNS", 3)
    first, second = np.array([0, 0, 1, 2, 5, 5, 6, 7]), np.array([1, 2, 3, 3, 6, 7, 8, 8])
    component = np.array([0, 0, 0, 0, 1, 2, 2, 2, 2], np.int32)
    weight = np.random.default_rng(2).uniform(1.0, 9.0, len(first))
    graph = exposure_graph._Graph(first, second, component, component)
    dense = graph._centered(graph.factor(weight).values(np.eye(len(first))))
    found = np.concatenate([by_edges for _, by_edges in graph.factor(weight).by_edges()], axis=1)
    np.testing.assert_allclose(found, dense.T, rtol=1e-12, atol=1e-15)
    assert not found[:, 4].any()
    groups = replace(graph, group=np.array([0, 0, 1, 1, 2, 3, 3, 4, 4]))
    dense = groups._centered(groups.factor(weight).values(np.eye(len(first))))
    found = np.concatenate([by_edges for _, by_edges in groups.factor(weight).by_edges()], axis=1)
    np.testing.assert_allclose(found, dense.T, rtol=1e-12, atol=1e-15)


def test_the_misclosure_of_a_ring_is_spread():
    """One pair of images closes it, off by two of its standard deviations; the others agree much better than that."""
    count, sigma = 40, 0.01
    first, second = np.array(
        [(i, i + step) for step in range(1, 6) for i in range(count - step)] + [(0, count - 1)]
    ).T
    graph = exposure_graph._Graph(first, second, *np.zeros((2, count), np.int32))
    difference = np.zeros(len(first))
    difference[-1] = 2 * sigma
    value, _ = graph.solve_robustly(difference, np.full(len(first), sigma))
    ends = value[-1] - value[0]
    assert 0.2 < ends / difference[-1] < 0.8
