"""Exposures from the ratios of all pairs of images, and how well they are known."""

from dataclasses import replace

import exposure_errors
import numpy as np
import pytest

from lvba.visual import edge_means, exposure, exposure_graph
from lvba.visual.exposure import solve_ratios
from lvba.visual.exposure_graph import BLOCKS
from lvba.visual.ratios import Ratios


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
        nees.append((exposure_errors.error(found, np.exp(truth)) / found.sigma) ** 2)
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
        nees.append((exposure_errors.error(found, np.exp(truth)) / found.sigma) ** 2)
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
            of.append((exposure_errors.error(estimate, np.exp(truth)) / estimate.sigma) ** 2)
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
            of.append((exposure_errors.error(found, np.exp(truth))[-1] / found.sigma[-1]) ** 2)
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
        nees.append((exposure_errors.error(found, np.exp(truth)) / found.sigma) ** 2)
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
    return solve_ratios(replace(ratios, value=value, block=block).take(kept), len(truth))


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
    assert np.abs(exposure_errors.error(found, np.exp(truth))).max() < 0.01


def test_two_components_and_a_lone_image():
    rng = np.random.default_rng(3)
    truth, ratios = _graph(rng, images=13, skip=(5, 6))
    across = (np.minimum(ratios.first, ratios.second) < 5) & (np.maximum(ratios.first, ratios.second) > 6)
    found = solve_ratios(ratios.take(~across), 13)
    assert found.component.tolist() == [0] * 5 + [1, 2] + [3] * 6
    # nothing tells how the first images compare with the last, which are more
    assert np.isinf(found.sigma[:7]).all()
    assert np.isfinite(found.sigma[7:]).all()
    for part in (slice(0, 5), slice(7, 13)):
        assert np.abs(np.diff(found.log_exposure[part]) - np.diff(truth[part])).max() < 0.02
    # no measurement, no jump
    assert found.log_exposure[5] == found.log_exposure[6] == found.log_exposure[7] == found.log_exposure[4]


def test_nothing_to_compare():
    _, ratios = _graph(np.random.default_rng(0))
    found = solve_ratios(ratios.take(np.zeros(0, int)), 3)
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
