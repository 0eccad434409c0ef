"""A plan in parts on a real cluster, whatever is killed, stopped or full: the same bytes, and nothing is redone in vain.

The steps are toys: what dies, and what continues, is the same as for a recording, see `test_split_run.py`.
"""

import os
import signal
import threading
from contextlib import contextmanager

import pytest
from real_cluster import Cluster
from small_disk import small_disk
from split_street import artifacts, artifacts_in_bucket, kind, manifests, name_of
from toy_parts import QUICK, parts
from toy_steps import said, wait_for

from workers import cluster, connection, local
from workers.store import ZarrStore


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory):
    started = Cluster(tmp_path_factory.mktemp("cluster"))
    for _ in range(2):
        started.start_worker("--memory-limit", "2")
    yield started
    started.end()


@pytest.fixture
def expected(tmp_path):
    """What one process makes of the plan; the log begins empty."""
    with quick(tmp_path):
        local.run(parts(tmp_path), ZarrStore(tmp_path / "expected"))
    (tmp_path / "log").unlink()
    return artifacts(tmp_path / "expected")


@contextmanager
def quick(folder):
    """Steps take no time that is to be met in them."""
    (folder / QUICK).touch()
    yield
    (folder / QUICK).unlink()


def run(two_workers, folder, store=None, **options):
    scheduler = connection.at(two_workers.address, None)
    return cluster.run(parts(folder), str(store or folder / "store"), scheduler, **options)


def kinds(folder):
    """Of all steps of the plan."""
    return {kind(step.name) for step in parts(folder).steps.values()}


class Killer(threading.Thread):
    """Kills the worker that begins the first step of each kind, in the midst of it."""

    def __init__(self, folder):
        super().__init__(daemon=True)
        self.killed = {}
        self._folder, self._done = folder, threading.Event()
        self.start()

    def run(self):
        while not self._done.wait(0.01):
            for line in said(self._folder, "began "):
                _, name, process = line.split()
                if kind(name) not in self.killed:
                    self.killed[kind(name)] = name
                    os.kill(int(process), signal.SIGKILL)

    def end(self):
        self._done.set()
        self.join()


def test_a_worker_killed_in_every_kind_of_step(two_workers, expected, tmp_path):
    killer = Killer(tmp_path)
    records = run(two_workers, tmp_path)
    killer.end()
    assert set(killer.killed) == kinds(tmp_path)
    assert artifacts(tmp_path / "store") == expected
    # a death costs the step it came in, and at most the one that the other worker's death gave to it
    again = len(said(tmp_path, "began ")) - len(records)
    assert len(killer.killed) <= again <= 2 * len(killer.killed)
    # what had ended is not made again
    ended = [line.split()[1] for line in said(tmp_path, "ended ")]
    assert len(set(ended)) == len(records)


def test_stopped_in_every_kind_of_step_it_goes_on_where_it_was(two_workers, expected, tmp_path):
    stopped = []
    finished = {}

    def until_another_kind_begins():
        seen = threading.Event()

        def note(step, index, total):
            if kind(step.name) not in stopped:
                stopped.append(kind(step.name))
                seen.set()

        def check():
            if seen.is_set():
                raise KeyboardInterrupt

        return {"on_step": note, "check": check}

    scheduler = connection.at(two_workers.address, None)
    client = scheduler.connect(10, lambda: None)
    while True:
        try:
            run(two_workers, tmp_path, **until_another_kind_begins())
            break
        except KeyboardInterrupt:
            wait_for(lambda: not any(client.processing().values()))
        now = manifests(tmp_path / "store")
        assert [key for key in finished if now[key] != finished[key]] == []
        finished = now
    client.close()
    assert set(stopped) == kinds(tmp_path)
    assert artifacts(tmp_path / "store") == expected


def test_full_disk_is_said_and_the_run_goes_on_where_there_is_room_again(two_workers, expected, tmp_path):
    with quick(tmp_path), small_disk(tmp_path / "disk", "200k") as enlarge:
        store = tmp_path / "disk" / "store"
        with pytest.raises(OSError, match="No space left on device"):
            run(two_workers, tmp_path, store)
        finished = manifests(store)
        assert finished
        enlarge("20m")
        run(two_workers, tmp_path, store)
        now = manifests(store)
        assert [name_of(key) for key in finished if now[key] != finished[key]] == []
        assert len(now) > len(finished)
        assert artifacts(store) == expected


def test_a_store_in_a_bucket_holds_the_same_bytes(two_workers, expected, bucket, tmp_path):
    """Own workers: those of the cluster began before the bucket was there."""
    with quick(tmp_path), connection.local(2, 1) as scheduler:
        cluster.run(parts(tmp_path), "s3://maps/toy", scheduler)
    assert artifacts_in_bucket(bucket, "toy") == expected
