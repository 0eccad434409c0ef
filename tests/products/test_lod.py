"""The octree with levels of detail: its kernels against plain twins, and its files against what viewers rely on."""

import json
import weakref

import naive_octree
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lvba.io import ply, potree
from lvba.kernels import flatness
from lvba.kernels import octree as kernels
from lvba.products import lod
from lvba.products.lod import LodConfig

SMALL = LodConfig(leaf_points=20, chunk_points=400)


def write_map(path, points, seed=0):
    """A map whose every column tells the points apart."""
    rng = np.random.default_rng(seed)
    columns = dict(zip("xyz", np.asarray(points, np.float32).T.copy()))
    columns |= {
        name: rng.integers(0, 256, len(points), np.uint8) for name in ("red", "green", "blue", "views")
    }
    columns["scan"] = np.arange(len(points)).astype(np.uint16)
    columns["plane_error"] = rng.normal(size=len(points)).astype(np.float32)
    ply.write_ply(path, columns)
    return columns


def room(count, seed=1):
    """Points on the floor and two walls of a room, denser in one corner, and one far away."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (count, 3)) ** 2 * [8, 6, 3]
    points[np.arange(count), rng.integers(0, 3, count)] = 0
    points[-1] = [12, -4, 5]
    return points + np.array([100, 200, -3])


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_levels_are_those_of_the_plain_twin(data):
    bits = data.draw(st.sampled_from([8, 21, 25]))
    count = data.draw(st.integers(0, 200))
    seed = data.draw(st.integers(0, 1000))
    scale = data.draw(st.sampled_from([1.0, 0.3, 0.01]))  # close points go deep
    points = (np.random.default_rng(seed).uniform(0, scale, (count, 3)) * (1 << bits)).astype(np.int32)
    first = data.draw(st.sampled_from([0, 2]))
    leaf = data.draw(st.integers(1, 30))
    key = kernels.keys(points, bits)
    order = np.argsort(key, kind="stable")
    found = np.empty(count, int)
    found[order] = kernels.levels(key[order], first, leaf)
    assert found.tolist() == naive_octree.levels(points.tolist(), bits, first, leaf)


def test_keys_are_the_bits_of_x_y_z_in_turn():
    points = np.random.default_rng(0).integers(0, 1 << 21, (100, 3)).astype(np.int32)
    expected = [naive_octree.interleaved(point, 21) for point in points.tolist()]
    assert kernels.keys(points, 21).tolist() == expected
    assert (kernels.keys(points * 16, 25) == kernels.keys(points, 21)).all()


def test_every_point_of_the_map_is_in_one_node_with_all_its_columns(tmp_path):
    columns = write_map(tmp_path / "map.ply", room(3000))
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", SMALL)
    metadata = json.loads((tmp_path / "cloud" / "metadata.json").read_text())
    rows = np.concatenate([rows for _, rows in potree.read_nodes(tmp_path / "cloud")])
    rows = rows[np.argsort(rows["scan"])]
    assert (rows["scan"] == columns["scan"]).all()
    world = rows["position"] * np.array(metadata["scale"]) + metadata["offset"]
    np.testing.assert_allclose(
        world, np.stack([columns[a] for a in "xyz"], 1), atol=0.51 * metadata["scale"][0]
    )
    assert (rows["rgb"] // 257 == np.stack([columns[c] for c in ("red", "green", "blue")], 1)).all()
    assert (rows["plane_error"] == columns["plane_error"]).all()
    ranges = {a["name"]: (a["min"], a["max"]) for a in metadata["attributes"]}
    assert ranges["views"] == ([columns["views"].min()], [columns["views"].max()])
    assert ranges["position"][1] == pytest.approx([columns[a].max() for a in "xyz"])
    assert metadata["points"] == len(rows)
    assert sorted(path.name for path in (tmp_path / "cloud").iterdir()) == [
        "hierarchy.bin",
        "metadata.json",
        "octree.bin",
    ]


def test_nodes_lie_in_their_cubes_and_each_level_is_spaced(tmp_path):
    write_map(tmp_path / "map.ply", room(3000))
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", SMALL)
    metadata = json.loads((tmp_path / "cloud" / "metadata.json").read_text())
    size = metadata["boundingBox"]["max"][0] - metadata["boundingBox"]["min"][0]
    assert metadata["spacing"] == pytest.approx(size / 128)
    names = set()
    for name, rows in potree.read_nodes(tmp_path / "cloud"):
        assert name == "r" or name[:-1] in names  # breadth first: above comes before
        names.add(name)
        low, edge = np.zeros(3), size
        for digit in name[1:]:
            edge /= 2
            low += edge * np.array([int(digit) >> 2 & 1, int(digit) >> 1 & 1, int(digit) & 1])
        inside = rows["position"] * metadata["scale"][0] - low
        assert inside.min() >= -1e-9
        assert inside.max() <= edge * (1 + 1e-9)
        cells = np.unique((inside / (edge / 128)).astype(int), axis=0)
        assert len(cells) == len(rows) or len(rows) <= SMALL.leaf_points
    assert len(names) > 10


def test_chunks_do_not_change_the_nodes(tmp_path):
    write_map(tmp_path / "map.ply", room(20_000))
    found = []
    for name, chunk in (("one", 30_000), ("many", 2000)):
        lod.write(tmp_path / "map.ply", tmp_path / name, LodConfig(leaf_points=50, chunk_points=chunk))
        found.append({node: rows.tobytes() for node, rows in potree.read_nodes(tmp_path / name)})
    assert found[0] == found[1]


def test_chunks_are_forgotten_once_they_are_written(tmp_path, monkeypatch):
    write_map(tmp_path / "map.ply", room(40_000))
    by_node, kept, most = lod._by_node, [], []

    def watched(*arguments):
        found = by_node(*arguments)
        most.append(sum(each() is not None for each in kept))
        kept.append(weakref.ref(found[2]))
        return found

    monkeypatch.setattr(lod, "_by_node", watched)
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", LodConfig(leaf_points=500, chunk_points=2_000))
    assert len(most) > 10
    assert max(most) <= 1


def test_the_same_map_gives_the_same_bytes(tmp_path):
    write_map(tmp_path / "map.ply", room(2000))
    for name in ("first", "second"):
        lod.write(tmp_path / "map.ply", tmp_path / name, SMALL)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes()


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((1, 3)), np.ones((700, 3))])
def test_maps_of_no_size_are_written(tmp_path, points):
    """Nothing, one point, and many points at one place, which no level can tell apart."""
    write_map(tmp_path / "map.ply", points)
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", SMALL)
    assert sum(len(rows) for _, rows in potree.read_nodes(tmp_path / "cloud")) == len(points)


def test_plane_errors_are_distances_from_the_plane_of_the_cell():
    """Against the plain twin: per cell a plane by singular values."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-1, 1, (60, 2)), rng.normal(0, 0.02, (60, 1))], axis=1)
    tilted = flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + [3, 0, 0]
    ball, line = rng.normal(size=(40, 3)), np.outer(np.linspace(-1, 1, 30), [1.0, 2.0, 3.0])
    few = flat[:5]
    cells = [flat, ball, tilted, line, few]
    position = np.rint(np.concatenate(cells) * 10_000 + 1_000_000).astype(np.int32)
    starts = np.concatenate([[0], np.cumsum([len(cell) for cell in cells])])
    found = flatness.plane_error(position, starts, 1e-4)
    for c, is_plane in enumerate([True, False, True, False, False]):
        here = slice(starts[c], starts[c + 1])
        if not is_plane:
            assert np.isnan(found[here]).all()
            continue
        centered = position[here] - position[here].mean(0)
        normal = np.linalg.svd(centered)[2][2]
        normal *= np.sign(normal[np.abs(normal).argmax()])
        np.testing.assert_allclose(found[here], centered @ normal * 1e-4, atol=1e-7)


def test_maps_without_plane_errors_get_them(tmp_path):
    rng = np.random.default_rng(0)
    floor = np.concatenate([rng.uniform(0, 4, (5000, 2)), rng.normal(0, 0.01, (5000, 1))], axis=1)
    columns = dict(zip("xyz", floor.astype(np.float32).T))
    columns |= {name: np.zeros(5000, np.uint8) for name in ("red", "green", "blue")}
    ply.write_ply(tmp_path / "map.ply", columns)
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", SMALL)
    rows = np.concatenate([rows for _, rows in potree.read_nodes(tmp_path / "cloud")])
    metadata = json.loads((tmp_path / "cloud" / "metadata.json").read_text())
    height = rows["position"][:, 2] * metadata["scale"][2] + metadata["offset"][2]
    known = np.isfinite(rows["plane_error"])
    assert known.mean() > 0.9
    assert np.corrcoef(height[known], rows["plane_error"][known])[0, 1] > 0.9
    assert rows["plane_error"][known].std() == pytest.approx(0.01, rel=0.1)
    (told,) = [a for a in metadata["attributes"] if a["name"] == "plane_error"]
    assert told["max"] == [pytest.approx(rows["plane_error"][known].max())]


@pytest.mark.parametrize("known", [0, 1, 200])
def test_errors_that_are_not_known_do_not_hide_the_range_of_those_that_are(tmp_path, known):
    points = room(200)
    columns = dict(zip("xyz", points.astype(np.float32).T.copy()))
    columns |= {name: np.zeros(200, np.uint8) for name in ("red", "green", "blue", "views")}
    columns["error"] = np.full(200, np.nan, np.float32)
    columns["error"][:known] = np.linspace(0.001, 0.02, known)
    ply.write_ply(tmp_path / "map.ply", columns)
    lod.write(tmp_path / "map.ply", tmp_path / "cloud", SMALL)
    metadata = json.loads((tmp_path / "cloud" / "metadata.json").read_text(), parse_constant=pytest.fail)
    attribute = next(one for one in metadata["attributes"] if one["name"] == "error")
    assert attribute["type"] == "float"
    if known:
        assert attribute["min"] == [pytest.approx(0.001)]
        assert attribute["max"] == [pytest.approx(0.02 if known > 1 else 0.001)]
    found = np.concatenate([rows["error"] for _, rows in potree.read_nodes(tmp_path / "cloud")])
    np.testing.assert_array_equal(np.sort(found), np.sort(columns["error"]))
