"""A recording in parts, whatever dies or is damaged: the same bytes, and what was finished is not redone.

Real stages, from end to end; `test_parts_faults.py` kills and stops toys in every kind of step.
"""

import signal

import pytest
from real_cluster import Cluster, tls_files
from split_street import Driver, artifacts, manifests, name_of, products, reused
from toy_steps import wait_for
from two_parts import PARTS


@pytest.fixture(scope="module")
def alone(result_in_two):
    """The result folder of a run in one process that nothing disturbed."""
    out, done = result_in_two
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
def drive(street_in_two):
    """Begins a run of the street into a folder, with options; none outlives the test."""
    started = []

    def begin(out, *options):
        started.append(Driver(street_in_two, out, *options))
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


def test_own_workers_give_the_same_bytes_and_redo_only_what_is_damaged(street_in_two, alone, lvba, tmp_path):
    run = ["run", street_in_two, "--out", tmp_path, *PARTS, "--workers", 2, "--memory-limit", 2]
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


def test_scheduler_driver_and_everything_killed_in_turn(
    drive, street_in_two, alone, tls_cluster, lvba, tmp_path
):
    driver = drive(tmp_path, *tls_cluster.on())
    driver.until("lidar-step")
    other = lvba("run", street_in_two, "--out", tmp_path, *PARTS, *tls_cluster.on(), code=2)
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
