"""Running a plan on Dask with real processes: the same bytes, and every way in which processes can die."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import numpy as np
import pytest
import toy_steps
from real_cluster import Cluster
from toy_steps import chain, said, wait_for

from lvba.errors import InputError
from lvba.plan import LazyRef, Plan, Ref
from workers import cluster, connection, local, versions
from workers.store import ZarrStore

STEPS = ["a", "bb", "ccc", "dddd"]

DRIVER = """
import sys
from pathlib import Path
from toy_steps import chain
from workers import cluster, connection
folder = Path(sys.argv[1])
cluster.run(chain(folder), str(folder / "store"), connection.at(sys.argv[2], None))
"""
"""A driver in a process of its own."""


@pytest.fixture(scope="module")
def toy_cluster(tmp_path_factory):
    """A scheduler and two workers that may use little memory."""
    started = Cluster(tmp_path_factory.mktemp("cluster"))
    for _ in range(2):
        started.start_worker("--memory-limit", "700MB")
    yield started
    started.end()


def contents(folder: Path):
    """Every file of the steps' artifacts but the manifests, which hold times."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "manifest.json" and p.relative_to(folder).parts[0].split("-")[0] in STEPS
    }


@pytest.fixture
def expected(tmp_path):
    """What one process makes of the plan; the log begins empty."""
    local.run(chain(tmp_path), ZarrStore(tmp_path / "expected"))
    (tmp_path / "log").unlink()
    return contents(tmp_path / "expected")


def run(toy_cluster, folder, work=None, **options):
    scheduler = connection.at(toy_cluster.address, None)
    return cluster.run(work or chain(folder), str(folder / "store"), scheduler, **options)


class Background(threading.Thread):
    """A run beside the test, held in the step `bb`."""

    def __init__(self, toy_cluster, folder, **options):
        super().__init__(daemon=True)
        (folder / "hold-bb").touch()
        self.result = self.error = None
        self._arguments, self._options, self._folder = (toy_cluster, folder), options, folder
        self.start()
        self.worker = int(wait_for(lambda: said(folder, "began bb"))[0].split()[2])

    def run(self):
        try:
            self.result = run(*self._arguments, **self._options)
        except BaseException as error:
            self.error = error

    def release(self):
        (self._folder / "hold-bb").unlink()
        self.join(60)
        if self.error:
            raise self.error
        return self.result


def test_same_bytes_as_one_process_and_a_record_per_step(toy_cluster, expected, tmp_path):
    begun, told = [], []
    records = run(
        toy_cluster,
        tmp_path,
        on_step=lambda step, index, total: begun.append((step.name, index, total)),
        progress=lambda what, done, total: told.append(what),
    )
    assert [r.name for r in records] == STEPS
    assert all(r.peak_memory_mb > 1 and not r.reused for r in records)
    assert sorted(begun) == [(name, i, 4) for i, name in enumerate(STEPS)]
    assert any("making" in what for what in told)
    assert contents(tmp_path / "store") == expected
    again = run(toy_cluster, tmp_path)
    assert all(r.reused for r in again)
    assert len(said(tmp_path, "began")) == 4


def test_progress_can_be_asked_for(toy_cluster, tmp_path):
    background = Background(toy_cluster, tmp_path)
    client = connection.at(toy_cluster.address, None).connect(5, lambda: None)
    store = str(tmp_path / "store")
    (bb,) = (key for key in chain(tmp_path).steps if key.startswith("bb-"))
    state = wait_for(lambda: (e := cluster.latest_progress(client, store).get(bb)) and e["done"] and e)
    assert state["what"] == "holding"
    assert state["seconds"] > 0
    assert state["process"] == background.worker
    client.close()
    background.release()


def test_only_keys_go_through_the_scheduler(toy_cluster, tmp_path):
    run(toy_cluster, tmp_path)
    names = {p.name.split("-")[0] for p in (tmp_path / "store").iterdir()}
    assert names == {*STEPS, "plan"}


def test_worker_killed_in_the_midst_of_a_step(toy_cluster, expected, tmp_path):
    background = Background(toy_cluster, tmp_path)
    os.kill(background.worker, signal.SIGKILL)
    wait_for(lambda: len(said(tmp_path, "began bb")) == 2)
    background.release()
    assert contents(tmp_path / "store") == expected
    assert len(said(tmp_path, "began")) == 5


def test_scheduler_killed_in_the_midst_of_a_step(toy_cluster, expected, tmp_path):
    background = Background(toy_cluster, tmp_path)
    wait_for(lambda: said(tmp_path, "ended dddd"))
    toy_cluster.kill_scheduler()
    toy_cluster.start_scheduler()
    wait_for(lambda: len(said(tmp_path, "began bb")) == 2)
    background.release()
    assert contents(tmp_path / "store") == expected
    assert len(said(tmp_path, "began")) == 5


def test_scheduler_killed_and_its_client_too_busy_to_close(toy_cluster, expected, tmp_path, monkeypatch):
    close = cluster.Client.close

    def slow(client, timeout=None):
        close(client, timeout)
        raise TimeoutError("timed out after 1 s.")

    monkeypatch.setattr(cluster.Client, "close", slow)
    background = Background(toy_cluster, tmp_path)
    toy_cluster.kill_scheduler()
    toy_cluster.start_scheduler()
    wait_for(lambda: len(said(tmp_path, "began bb")) == 2)
    background.release()
    assert contents(tmp_path / "store") == expected


def test_scheduler_killed_between_telling_that_a_step_is_done_and_sending_what_it_returned(
    toy_cluster, expected, tmp_path, monkeypatch
):
    result, killed = cluster.Future.result, []

    def too_late(future, timeout=None):
        if not killed:
            killed.append(future.key)
            toy_cluster.kill_scheduler()
            toy_cluster.start_scheduler()
        return result(future, timeout)

    monkeypatch.setattr(cluster.Future, "result", too_late)
    run(toy_cluster, tmp_path)
    assert len(killed) == 1
    assert contents(tmp_path / "store") == expected


def test_driver_killed_in_the_midst_of_a_step(toy_cluster, expected, tmp_path):
    (tmp_path / "hold-bb").touch()
    environment = {"PYTHONPATH": f"{Path(toy_steps.__file__).parent}:{Path(connection.__file__).parents[1]}"}
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, tmp_path, toy_cluster.address], env=environment)
    wait_for(lambda: said(tmp_path, "began bb") and list((tmp_path / "store").glob("dddd-*")))
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    # nobody waits for the step any more, and its worker notices
    assert wait_for(lambda: said(tmp_path, "stopped bb")) == ["stopped bb UnwantedError"]
    (tmp_path / "hold-bb").unlink()
    records = run(toy_cluster, tmp_path)
    assert [r.reused for r in records] == [True, False, False, True]
    assert contents(tmp_path / "store") == expected


def test_told_to_stop_the_worker_stops_and_the_same_run_goes_on(toy_cluster, expected, tmp_path):
    stop = threading.Event()

    def check():
        if stop.is_set():
            raise KeyboardInterrupt

    background = Background(toy_cluster, tmp_path, check=check)
    stop.set()
    assert wait_for(lambda: said(tmp_path, "stopped bb")) == ["stopped bb UnwantedError"]
    with pytest.raises(KeyboardInterrupt):
        background.release()
    run(toy_cluster, tmp_path)
    assert contents(tmp_path / "store") == expected
    assert len(said(tmp_path, "began a")) == 1


def test_told_to_stop_a_step_that_reports_nothing_is_ended_with_its_process(toy_cluster, tmp_path):
    (tmp_path / "hold-stay").touch()
    work = Plan(versions.key_version())
    work.add("stay", toy_steps.stay, str(tmp_path))

    def check():
        if said(tmp_path, "began stay"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(toy_cluster, tmp_path, work, check=check)
    process = Path("/proc") / said(tmp_path, "began stay")[0].split()[2]
    wait_for(lambda: not process.exists())
    (tmp_path / "hold-stay").unlink()
    run(toy_cluster, tmp_path, work)
    assert len(said(tmp_path, "began stay")) == 2


@pytest.mark.parametrize("damage", ["chunk", "manifest", "half-written"])
def test_damaged_artifact_alone_is_made_again(toy_cluster, expected, tmp_path, damage):
    run(toy_cluster, tmp_path)
    artifact = next((tmp_path / "store").glob("bb-*"))
    if damage == "chunk":
        (artifact / "0" / "c" / "0" / "0").write_bytes(b"\0" * 100)
    elif damage == "manifest":
        (artifact / "manifest.json").unlink()
    else:
        shutil.move(artifact, artifact.with_name(".partial-1"))
    records = run(toy_cluster, tmp_path)
    assert [r.reused for r in records] == [True, False, True, True]
    assert contents(tmp_path / "store") == expected


def test_artifact_damaged_while_the_run_goes_on(toy_cluster, expected, tmp_path):
    work = chain(tmp_path)
    a = next(iter(work.steps))
    spoiled = work.add("spoil", toy_steps.spoil, str(tmp_path), str(tmp_path / "store"), Ref(a))
    work.add("last", toy_steps.make, str(tmp_path), "last", Ref(a), spoiled)
    records = run(toy_cluster, tmp_path, work)
    assert len(records) == 6
    assert len(said(tmp_path, "began a ")) == 2
    assert contents(tmp_path / "store") == expected


@pytest.mark.parametrize("wants", [True, False])
def test_artifact_that_is_read_late_is_made_again_only_where_it_is_wanted(toy_cluster, tmp_path, wants):
    work = Plan(versions.key_version())
    a = work.add("a", toy_steps.make, str(tmp_path), "a")
    spoiled = work.add("spoil", toy_steps.spoil, str(tmp_path), str(tmp_path / "store"), a)
    asked = work.add("ask", toy_steps.ask, str(tmp_path), LazyRef(a.key), wants, spoiled)
    records = run(toy_cluster, tmp_path, work)
    assert len(records) == 3
    times = 2 if wants else 1
    assert [len(said(tmp_path, what)) for what in ("began a ", "began ask")] == [times, times]
    store = ZarrStore(tmp_path / "store")
    assert (a.key in store) == wants
    np.testing.assert_array_equal(store[asked.key], store[a.key] + 1 if wants else 0)


@pytest.mark.parametrize(
    ("kind", "error", "words", "tries"),
    [
        ("input", InputError, "scan.pcd: is cut short", 1),
        ("disk", OSError, "Input/output error", 4),
    ],
)
def test_step_that_always_fails_is_given_up_and_the_others_are_finished(
    toy_cluster, tmp_path, kind, error, words, tries
):
    work = Plan(versions.key_version())
    failing = work.add("fail", toy_steps.fail, str(tmp_path), kind)
    work.add("after", toy_steps.make, str(tmp_path), "after", failing)
    work.add("a", toy_steps.make, str(tmp_path), "a")
    with pytest.raises(error, match=words):
        run(toy_cluster, tmp_path, work)
    assert len(said(tmp_path, "began fail")) == tries
    assert said(tmp_path, "ended") == ["ended a"]


def test_worker_that_runs_out_of_memory_is_restarted_and_only_the_step_that_did_it_is_given_up(tmp_path):
    work = Plan(versions.key_version())
    work.add("fail", toy_steps.fail, str(tmp_path), "memory")
    once = work.add("hungry", toy_steps.hungry, str(tmp_path), 1)
    # these wait on the only worker while it dies, and are not to blame
    others = [work.add(name, toy_steps.make, str(tmp_path), name) for name in ("a", "dddd")]
    gives_up = pytest.raises(connection.ClusterError, match=r"fail: .*--memory-limit.*split\.memory_gb")
    with gives_up, connection.local(1, 1, memory_bytes=700_000_000) as scheduler:
        cluster.run(work, str(tmp_path / "store"), scheduler)
    # Dask gives a step up after four dead workers, and once more where the driver heard of fewer than four begins: the
    # other step's death counts among the first four, or a worker died before it had sent that the step begins
    assert 2 <= len(said(tmp_path, "began fail")) <= 8
    assert len({line.split()[2] for line in said(tmp_path, "began hungry")}) == 2
    made = ZarrStore(tmp_path / "store")
    assert made[once.key].tobytes() == np.arange(1000.0).tobytes()
    assert all(ref.key in made for ref in others)


def test_worker_of_another_version_is_refused(toy_cluster, tmp_path):
    with pytest.raises(InputError, match="another version"):
        run(toy_cluster, tmp_path, chain(tmp_path, "older"))


def test_store_that_workers_cannot_see_is_said(toy_cluster, tmp_path):
    scheduler = connection.at(toy_cluster.address, None)
    with pytest.raises(InputError, match="all machines share"):
        cluster.run(chain(tmp_path), "memory://mine", scheduler)


def test_no_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "FIRST_CONTACT_SECONDS", 0.1)
    monkeypatch.setattr(connection, "_ATTEMPT_SECONDS", 0.2)
    with pytest.raises(connection.ClusterError, match="no scheduler answers"):
        cluster.run(chain(tmp_path), str(tmp_path), connection.at("tcp://127.0.0.1:9", None))


def test_own_cluster_has_no_pages_for_whoever_is_on_this_machine():
    with connection.local(1, 1) as scheduler:
        client = scheduler.connect(60.0, lambda: None)
        client.wait_for_workers(1, timeout=120)
        found = client.scheduler_info()
        ports = [found["services"]["dashboard"]]
        ports += [worker["services"]["dashboard"] for worker in found["workers"].values()]
        for port in ports:
            for path in (
                "/",
                "/status",
                "/health",
                "/metrics",
                "/json/counts.json",
                "/info/main/workers.html",
            ):
                assert httpx.get(f"http://127.0.0.1:{port}{path}").status_code == 404, path
        client.close()
