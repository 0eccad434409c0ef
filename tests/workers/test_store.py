"""Artifacts on disk: the same value back, and nothing half-written or altered is ever used."""

import json
import logging
import os

import numpy as np
import pytest

from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.errors import ArtifactError, InputError
from lvba.trajectory import Trajectory
from workers import codec
from workers import store as stores
from workers.store import ZarrStore


def trajectory(n=3):
    return Trajectory(np.arange(float(n)), np.tile(np.eye(4), (n, 1, 1)))


VALUES = {
    "array": np.arange(12, dtype=np.int16).reshape(3, 4),
    "large": np.linspace(0, 1, 3000).reshape(300, 10),
    "large turned": np.arange(6000, dtype=np.int32).reshape(300, 20).T,
    "empty": np.zeros((0, 3), np.float32),
    "zero": np.zeros((2, 2)),
    "scalar array": np.array(2.5),
    "bool": np.array([True, False]),
    "nan": np.array([np.nan, -0.0, np.inf]),
    "strings": np.array(["a", "bcd"]),
    "plain": {"a": [1, 2.5, None, True, "text"], "b": {"c": ()}},
    "numpy scalars": [np.float32(1.1), np.int64(3), np.bool_(True), np.float64(0.1)],
    "floats": [float("inf"), float("nan"), 1e-300, 0.1, -0.0],
    "keys": {1: "a", "$tuple": "b", "x/../y": np.arange(3.0)},
    "tuple": (1, (2.0, np.arange(2))),
    "dataclass": trajectory(),
    "nested": {"t": [trajectory(2), trajectory(4)], "c": Camera(4, 3, 1.0, 2.0, 3.0, 4.0)},
    "none": None,
}


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif hasattr(one, "__dataclass_fields__"):
        for name in one.__dataclass_fields__:
            assert_same(getattr(one, name), getattr(other, name))
    else:
        assert repr(one) == repr(other)


@pytest.mark.parametrize("name", VALUES)
def test_value_comes_back_as_it_was(tmp_path, name):
    ZarrStore(tmp_path)["stage-1"] = VALUES[name]
    assert_same(ZarrStore(tmp_path)["stage-1"], VALUES[name])


def test_dataset_comes_back(tmp_path):
    camera = RigCamera(Camera(4, 3, 1, 1, 2, 2), np.eye(4))
    dataset = Dataset("/d", ("a.pcd",), trajectory(1), (), trajectory(0), (camera,))
    ZarrStore(tmp_path)["input-1"] = dataset
    assert_same(ZarrStore(tmp_path)["input-1"], dataset)


def test_artifact_damaged_after_a_look_at_it_is_not_used(tmp_path):
    ZarrStore(tmp_path)["a-1"] = np.ones(4000)
    store = ZarrStore(tmp_path)
    assert "a-1" in store
    chunk = next((tmp_path / "a-1").rglob("c/0"))
    chunk.write_bytes(b"\0" * chunk.stat().st_size)
    with pytest.raises(KeyError):
        store["a-1"]
    assert "a-1" not in store
    assert not (tmp_path / "a-1").exists()


def test_large_array_is_few_files(tmp_path):
    ZarrStore(tmp_path)["a-1"] = np.ones((1_000_000, 3))
    assert len([p for p in (tmp_path / "a-1").rglob("*") if p.is_file()]) == 4


def test_array_larger_than_a_chunk(tmp_path, monkeypatch):
    monkeypatch.setattr(stores, "_CHUNK_BYTES", 1000)
    value = np.random.default_rng(0).normal(size=(300, 3))
    ZarrStore(tmp_path)["a-1"] = value
    assert_same(ZarrStore(tmp_path)["a-1"], value)


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), lambda: 1])
def test_what_cannot_be_stored_is_refused_and_leaves_nothing(tmp_path, value):
    with pytest.raises(TypeError, match="cannot be stored"):
        ZarrStore(tmp_path)["a-1"] = value
    assert list(tmp_path.iterdir()) == []


def every_file(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def written(tmp_path):
    ZarrStore(tmp_path)["a-1"] = {"t": trajectory(100), "n": 3}
    return tmp_path


def test_every_corrupt_byte_truncation_and_loss_is_noticed(written):
    artifact = written / "a-1"
    originals = {name: (artifact / name).read_bytes() for name in every_file(artifact)}
    assert len(originals) == 4  # the times are small and stand in the JSON
    for name, content in originals.items():
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        for damaged in (content[:middle], flipped, b"", None):
            if name == "manifest.json" and damaged == flipped:
                continue  # timings are not covered by a digest
            if damaged is None:
                (artifact / name).unlink()
            else:
                (artifact / name).write_bytes(damaged)
            with pytest.raises(ArtifactError):
                stores.verify(artifact)
            (artifact / name).write_bytes(content)
    stores.verify(artifact)


def test_file_too_many_is_noticed(written):
    (written / "a-1" / "0" / "c" / "9").write_bytes(b"x")
    with pytest.raises(ArtifactError, match="manifest lists"):
        stores.verify(written / "a-1")


def test_corrupt_artifact_is_removed_and_said(written, caplog):
    chunk = next(p for p in (written / "a-1").rglob("*") if p.is_file() and "/c/" in p.as_posix())
    chunk.write_bytes(b"\0" * chunk.stat().st_size)
    store = ZarrStore(written)
    with caplog.at_level(logging.WARNING):
        assert "a-1" not in store
    assert "a-1" in caplog.text
    assert "made again" in caplog.text
    assert not (written / "a-1").exists()
    store["a-1"] = 5
    assert ZarrStore(written)["a-1"] == 5


def test_half_written_artifact_does_not_count_and_is_tidied(tmp_path, monkeypatch):
    def die(partial, artifact):
        os._exit(7)

    pid = os.fork()
    if pid == 0:
        monkeypatch.setattr(stores, "_move_into_place", die)
        ZarrStore(tmp_path)["a-1"] = trajectory()
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
    store = ZarrStore(tmp_path)
    assert any(p.name.startswith(".partial") for p in tmp_path.iterdir())
    assert "a-1" not in store
    assert list(store) == []
    store.tidy()
    assert list(tmp_path.iterdir()) == []


def test_store_is_a_mapping(tmp_path):
    store = ZarrStore(tmp_path)
    assert list(store) == []
    store["b-1"], store["a-1"] = 1, 2
    assert dict(store) == {"a-1": 2, "b-1": 1}
    del store["a-1"]
    assert "a-1" not in store
    assert len(store) == 1
    with pytest.raises(KeyError):
        store["a-1"]
    with pytest.raises(KeyError):
        del store["a-1"]


def test_manifest_has_digests_and_facts(tmp_path):
    store = ZarrStore(tmp_path)
    store.put("a-1", trajectory(100), {"seconds": 1.5})
    manifest = json.loads((tmp_path / "a-1" / "manifest.json").read_text())
    assert manifest["seconds"] == 1.5
    assert set(manifest["files"]) == set(every_file(tmp_path / "a-1")) - {"manifest.json"}


def test_what_another_worker_made_meanwhile_stays_and_what_is_damaged_is_replaced(tmp_path):
    for seconds in 1.5, 2.5:
        ZarrStore(tmp_path).put("a-1", trajectory(100), {"seconds": seconds})
        assert ZarrStore(tmp_path).facts("a-1")["seconds"] == 1.5
    (tmp_path / "a-1" / "zarr.json").write_text("{")
    ZarrStore(tmp_path).put("a-1", trajectory(100), {"seconds": 3.5})
    assert ZarrStore(tmp_path).facts("a-1")["seconds"] == 3.5
    assert_same(ZarrStore(tmp_path)["a-1"], trajectory(100))
    assert [path.name for path in tmp_path.iterdir()] == ["a-1"]


@pytest.mark.parametrize(
    "name", ["os:stat_result", "lvbax.camera:Camera", "lvba.camera:np", "lvba.camera:Gone"]
)
def test_only_dataclasses_of_the_package_are_made(name):
    with pytest.raises(ArtifactError):
        codec.decode({"$object": name, "fields": {}}, {})


def test_second_run_into_one_folder_is_refused_and_a_dead_one_does_not_block(tmp_path):
    ready, release = os.pipe(), os.pipe()
    pid = os.fork()
    if pid == 0:
        with stores.lock(tmp_path):
            os.write(ready[1], b"x")
            os.read(release[0], 1)
            os._exit(9)  # without giving the lock back
    os.read(ready[0], 1)
    with pytest.raises(InputError, match="another run"), stores.lock(tmp_path):
        pass
    os.write(release[1], b"x")
    os.waitpid(pid, 0)
    with stores.lock(tmp_path):
        pass


def test_what_is_known_counts_without_being_read(tmp_path):
    store = ZarrStore(tmp_path)
    store.know("a-1", VALUES["dataclass"])
    assert "a-1" in store
    assert store["a-1"] is VALUES["dataclass"]
    assert list(tmp_path.iterdir()) == []
    store.release("a-1")
    assert "a-1" not in store
