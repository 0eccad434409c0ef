"""Artifacts under a URL: the same values and files, nothing half-uploaded counts, one run at a time."""

import json
import os
import subprocess
import sys
import time

import fsspec
import numpy as np
import pytest

from lvba.errors import InputError
from workers import url_store
from workers.store import ZarrStore
from workers.url_store import open_store

VALUE = {"large": np.linspace(0, 1, 3000).reshape(300, 10), "n": 3}


@pytest.fixture
def url():
    files = fsspec.filesystem("memory")
    yield "memory://store/run"
    files.rm("/store", recursive=True) if files.exists("/store") else None


def under(url):
    files, root = fsspec.core.url_to_fs(url)
    return {path.removeprefix(root + "/"): files.cat_file(path) for path in files.find(root)}


def test_value_comes_back_and_the_files_are_those_of_a_folder(url, tmp_path):
    open_store(url)["a-1"] = VALUE
    ZarrStore(tmp_path)["a-1"] = VALUE
    found = open_store(url)["a-1"]
    assert found["large"].tobytes() == VALUE["large"].tobytes()
    assert found["n"] == 3
    folder = {p.relative_to(tmp_path).as_posix(): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    assert under(url) == folder


def test_store_is_a_mapping(url):
    store = open_store(url)
    assert list(store) == []
    store["b-1"], store["a-1"] = 1, 2
    assert dict(open_store(url)) == {"a-1": 2, "b-1": 1}
    del store["a-1"]
    assert "a-1" not in store
    with pytest.raises(KeyError):
        store["a-1"]
    with pytest.raises(KeyError):
        del store["a-1"]


def test_released_artifact_leaves_the_local_disk_and_can_be_read_again(url):
    store = open_store(url)
    store["a-1"] = VALUE
    store.release("a-1")
    assert list(store.folder.iterdir()) == []
    assert store["a-1"]["n"] == 3


@pytest.mark.parametrize("name", ["zarr.json", "0/zarr.json", "0/c/0/0"])
def test_damaged_object_is_noticed_and_the_artifact_removed(url, name):
    open_store(url)["a-1"] = VALUE
    files, root = fsspec.core.url_to_fs(url)
    content = files.cat_file(f"{root}/a-1/{name}")
    files.pipe_file(f"{root}/a-1/{name}", content[:-1] + bytes([content[-1] ^ 1]))
    assert "a-1" not in open_store(url)
    assert under(url) == {}


def test_artifact_without_manifest_does_not_count_and_is_tidied(url):
    store = open_store(url)
    store.put("a-1", VALUE, {"version": "1"})
    store.put("b-1", VALUE, {"version": "1"})
    store.put("c-1", VALUE, {"version": "0"})
    files, root = fsspec.core.url_to_fs(url)
    files.rm_file(f"{root}/a-1/manifest.json")
    other = open_store(url)
    assert "a-1" not in other
    other.tidy("1")
    assert {name.split("/")[0] for name in under(url)} == {"b-1"}


def test_what_another_worker_made_meanwhile_stays(url):
    for seconds in 1.5, 2.5:
        open_store(url).put("a-1", VALUE, {"seconds": seconds})
        store = open_store(url)
        assert store["a-1"]["n"] == 3
        assert store.facts("a-1")["seconds"] == 1.5


def test_manifest_goes_up_last(url, monkeypatch):
    store = open_store(url)

    def die(*arguments, **options):
        raise ConnectionError("gone")

    monkeypatch.setattr(store._files, "put_file", die)
    with pytest.raises(ConnectionError):
        store["a-1"] = VALUE
    assert "a-1/manifest.json" not in under(url)
    assert "a-1" not in open_store(url)


def test_second_run_is_refused_until_the_first_has_ended(url):
    other = pytest.raises(InputError, match="another run is writing here")
    with open_store(url).lock(), other, open_store(url).lock():
        pass
    with open_store(url).lock():
        pass
    assert under(url) == {}


def lease_of(url, **changes):
    files, root = fsspec.core.url_to_fs(url)
    lease = {"host": "elsewhere", "pid": 1, "id": "x", "until": time.time() + 60, **changes}
    files.pipe_file(f"{root}/.lock.json", json.dumps(lease).encode())


def test_lock_of_a_dead_run_does_not_block(url):
    lease_of(url)
    with pytest.raises(InputError, match="another run"), open_store(url).lock():
        pass
    lease_of(url, until=time.time() - 1)
    with open_store(url).lock():
        pass
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    lease_of(url, host=os.uname().nodename, pid=ended.pid)
    with open_store(url).lock():
        pass


def test_lock_is_renewed(url, monkeypatch):
    monkeypatch.setattr(url_store, "LEASE_SECONDS", 0.3)
    with open_store(url).lock():
        first = json.loads(under(url)[".lock.json"])["until"]
        deadline = time.monotonic() + 60
        while json.loads(under(url)[".lock.json"])["until"] == first:
            assert time.monotonic() < deadline
            time.sleep(0.02)


@pytest.mark.parametrize("place", ["nosuch://a/b", "http://127.0.0.1:9/x"])
def test_place_that_cannot_be_used_is_said(place):
    with pytest.raises(InputError, match=r"check the address|install"), open_store(place).lock():
        pass
