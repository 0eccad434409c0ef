"""A recording in parts, whatever dies, fills up or is damaged: the same bytes, and what was finished is not redone."""

import argparse
import os
import shutil
import signal
import subprocess
import threading
from pathlib import Path

import pytest
from real_cluster import Cluster, tls_files
from split_street import (
    PARTS,
    Driver,
    artifacts,
    kind,
    make_street,
    manifests,
    name_of,
    products,
    reused,
)
from toy_steps import wait_for

from lvba import pipeline
from lvba.io.dataset import open_dataset
from service.cli import settings_files
from workers import cluster, connection, versions


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return make_street(tmp_path_factory.mktemp("street") / "street")


@pytest.fixture(scope="module")
def alone(street, lvba, tmp_path_factory):
    """The result folder of a run in one process that nothing disturbed."""
    out = tmp_path_factory.mktemp("alone") / "out"
    done = lvba("run", street, "--out", out, *PARTS, "--threads", 1)
    assert "memory for each of 2 parts: about 0.4 GB, of " in done.stderr
    return out


@pytest.fixture(scope="module")
def tls_cluster(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cluster")
    started = Cluster(folder, tls_files(folder))
    for _ in range(2):
        started.start_worker("--memory-limit", "2")
    yield started
    started.end()


@pytest.fixture
def drive(street):
    """Begins a run of the street into a folder, with options; none outlives the test."""
    started = []

    def begin(out, *options):
        started.append(Driver(street, out, *options))
        return started[-1]

    yield begin
    for driver in started:
        driver.kill()
        print("driver:", *driver.lines, sep="\n")


def same(out, alone):
    assert products(out) == products(alone)
    stages = artifacts(out / "stages")
    expected = artifacts(alone / "stages")
    assert sorted(stages) == sorted(expected)
    assert [name for name in stages if stages[name] != expected[name]] == []


def test_own_workers_give_the_same_bytes_and_redo_only_what_is_damaged(street, alone, lvba, tmp_path):
    run = ["run", street, "--out", tmp_path, *PARTS, "--workers", 2, "--memory-limit", 2]
    lvba(*run)
    same(tmp_path, alone)
    before = manifests(tmp_path / "stages")
    damaged = {
        kind: next((tmp_path / "stages").glob(f"{kind}-*"))
        for kind in ("lidar-part-0", "visual-part-1", "map-0")
    }
    next(p for p in damaged["lidar-part-0"].rglob("c/*") if p.is_file()).write_bytes(b"\0")
    (damaged["visual-part-1"] / "manifest.json").unlink()
    damaged["map-0"].rename(damaged["map-0"].with_name(".partial-map"))
    lvba(*run)
    assert {name for name, again in reused(tmp_path).items() if not again} == set(damaged)
    after = manifests(tmp_path / "stages")
    assert {name_of(key) for key in after if after[key] != before[key]} == set(damaged)
    same(tmp_path, alone)


def download(bucket, prefix, folder):
    for page in bucket.get_paginator("list_objects_v2").paginate(Bucket="maps", Prefix=prefix):
        for item in page["Contents"]:
            path = folder / Path(item["Key"]).relative_to(prefix)
            path.parent.mkdir(parents=True, exist_ok=True)
            bucket.download_file("maps", item["Key"], str(path))
    return folder


def test_a_store_in_a_bucket_holds_the_same_bytes(street, alone, lvba, bucket, tmp_path):
    lvba("run", street, "--out", tmp_path / "out", *PARTS, "--store", "s3://maps/street", "--workers", 2)
    assert products(tmp_path / "out") == products(alone)
    assert not (tmp_path / "out" / "stages").exists()
    stored = artifacts(download(bucket, "street", tmp_path / "bucket"))
    assert stored == artifacts(alone / "stages")


def test_a_worker_killed_in_every_kind_of_stage(drive, alone, tls_cluster, tmp_path):
    killed = {}

    def kill(name, process):
        if kind(name) not in killed:
            killed[kind(name)] = name
            os.kill(process, signal.SIGKILL)

    driver = drive(tmp_path, *tls_cluster.on())
    driver.at_every_beginning(kill)
    driver.ended(0)
    same(tmp_path, alone)
    names = list(reused(tmp_path))
    assert set(killed) == set(map(kind, names))
    # a death costs the step it came in; one that was just finished may be asked for again, and is found
    again = len(driver.begun()) - len(names)
    assert 5 <= again <= 2 * len(killed)


def test_scheduler_driver_and_everything_killed_in_turn(drive, street, alone, tls_cluster, lvba, tmp_path):
    driver = drive(tmp_path, *tls_cluster.on())
    driver.until("lidar-step")
    other = lvba("run", street, "--out", tmp_path, *PARTS, *tls_cluster.on(), code=2)
    assert "another run is writing here" in other.stderr
    tls_cluster.kill_scheduler()
    finished = manifests(tmp_path / "stages")
    tls_cluster.start_scheduler()

    # it may have been further than that already when the scheduler died: something must follow
    wait_for(lambda: len(manifests(tmp_path / "stages")) > len(finished), 500)
    with tls_cluster.gates.held("visual-merge"):
        driver.until("visual-part")
        driver.kill()
    driver.ended(-signal.SIGKILL)
    finished = unchanged(finished, tmp_path)
    again = [line for line in driver.lines if line.endswith("begins again")]
    assert len(again) <= 2  # one for each worker

    driver = drive(tmp_path, *tls_cluster.on())
    with tls_cluster.gates.held("visual-gate"):
        driver.until("evaluate")
        driver.kill()
        tls_cluster.kill_all()
    driver.ended(-signal.SIGKILL)
    finished = unchanged(finished, tmp_path)

    tls_cluster.start_scheduler()
    for _ in range(2):
        tls_cluster.start_worker()
    drive(tmp_path, *tls_cluster.on()).ended(0)
    unchanged(finished, tmp_path)
    assert {name for name, there in reused(tmp_path).items() if there} == set(map(name_of, finished))
    same(tmp_path, alone)


def unchanged(finished, out):
    """What is finished now, after checking that nothing that was finished has been done again."""
    now = manifests(out / "stages")
    assert [key for key in finished if now.get(key) != finished[key]] == []
    assert len(now) > len(finished)
    return now


@pytest.fixture
def disk(tmp_path):
    """A small disk, and how to make it larger."""
    if os.geteuid() or shutil.which("mount") is None:
        pytest.skip("only root can mount a small disk")
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", folder], check=False)
    if mounted.returncode:
        pytest.skip("no disk can be mounted here")
    yield folder, lambda: subprocess.run(["mount", "-o", "remount,size=200m", folder], check=True)
    subprocess.run(["umount", folder], check=True)


def test_full_disk_is_said_and_the_run_goes_on_where_there_is_room_again(
    drive, alone, tls_cluster, disk, tmp_path
):
    folder, enlarge = disk
    run = ["--store", folder / "stages", *tls_cluster.on()]
    said = drive(tmp_path / "out", *run).ended(2)
    assert f"{folder / 'stages'}: no space left on device" in said.splitlines()[-1]
    assert "Traceback" not in said
    finished = manifests(folder / "stages")
    assert finished
    enlarge()
    drive(tmp_path / "out", *run).ended(0)
    unchanged(finished, folder)
    assert products(tmp_path / "out") == products(alone)
    assert artifacts(folder / "stages") == artifacts(alone / "stages")


def test_a_part_that_always_fails_is_tried_once_and_the_other_is_finished(
    drive, street, alone, tls_cluster, tmp_path
):
    """Images of the second part are cut short after the run has opened the recording.

    What judges the scans of the whole recording needs the images of every part; all before it is finished.
    """
    images = sorted((street / "all_image").iterdir())[15:]
    whole = [path.read_bytes() for path in images]
    try:
        with tls_cluster.gates.held("survey"):
            driver = drive(tmp_path, *tls_cluster.on())
            driver.until("survey")
            for path, content in zip(images, whole, strict=True):
                path.write_bytes(content[: len(content) // 2])
        said = driver.ended(2)
    finally:
        for path, content in zip(images, whole, strict=True):
            path.write_bytes(content)
    last = said.splitlines()[-1]
    assert any(path.name in last for path in images)
    assert driver.begun().count("images-1") == 1
    finished = manifests(tmp_path / "stages")
    names = set(map(name_of, finished))
    assert {"lidar", "lidar-entropy-1", "lidar-images-0", "images-0"} <= names
    assert not {"images-1", "lidar-images-1", "lidar-gate"} & names
    drive(tmp_path, *tls_cluster.on()).ended(0)
    unchanged(finished, tmp_path)
    same(tmp_path, alone)


def test_canceled_in_every_kind_of_stage_the_workers_stop_and_the_store_goes_on(
    street, alone, tls_cluster, tmp_path, monkeypatch
):
    monkeypatch.chdir(street.parent)
    given = argparse.Namespace(config=None, set=[word for word in PARTS if word != "--set"])
    work = pipeline.refine(open_dataset(street), settings_files.load(given), None, versions.key_version())
    store = str(tmp_path / "stages")
    scheduler = connection.at(tls_cluster.address, connection.Tls(*tls_cluster.tls))
    client = scheduler.connect(10, lambda: None)
    canceled = []

    def until_another_kind_begins():
        told = threading.Event()

        def note(step, index, total):
            if kind(step.name) not in canceled:
                canceled.append(kind(step.name))
                told.set()

        def check():
            if told.is_set():
                raise KeyboardInterrupt

        return {"on_step": note, "check": check}

    finished = {}
    while True:
        try:
            cluster.run(work, store, scheduler, **until_another_kind_begins())
            break
        except KeyboardInterrupt:
            wait_for(lambda: not any(client.processing().values()))
        now = manifests(tmp_path / "stages")
        assert [key for key in finished if now[key] != finished[key]] == []
        finished = now
    client.close()
    assert set(canceled) == {kind(step.name) for step in work.steps.values()}
    assert artifacts(tmp_path / "stages") == artifacts(alone / "stages")
