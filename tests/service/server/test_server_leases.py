"""The queue at the level of its tables, on SQLite and PostgreSQL: who gets what, loses it, and nobody gets it twice."""

import errno
import os
import threading
import time

import pytest
from sqlalchemy import select

from service.db import journal, leases
from service.db.database import Database
from service.db.instance import Instance, Watch
from service.db.leases import Lease
from service.db.tables import Attempt, Dataset, Event, Job
from service.jobs.supervisor import Supervisor
from service.settings import Settings
from service.system.paths import Paths, new_id, now


@pytest.fixture(params=["sqlite", "postgres"])
def database(request, tmp_path):
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path / 'lvba.sqlite'}"
    else:
        url = request.getfixturevalue("postgres").new_database().replace("postgresql:", "postgresql+psycopg:")
    database = Database(url)
    database.migrate()
    yield database
    database.close()


def add_jobs(database, *jobs):
    """Jobs that wait: (owner, priority)."""
    ids = []
    with database.write() as session:
        for number, (owner, priority) in enumerate(jobs):
            dataset = Dataset(
                id=new_id("ds"), owner=owner, name="x", state="ready", created=now(), updated=now()
            )
            session.add(dataset)
            session.flush()
            job = Job(
                id=new_id("job"), owner=owner, name="x", dataset_id=dataset.id, config={},
                priority=priority, created=number, updated=now(),
            )  # fmt: skip
            session.add(job)
            ids.append(job.id)
    return ids


def claim(database, owner="a", running_jobs=10, but=()):
    job = leases.claim_job(database, owner, running_jobs, but)
    return None if job is None else job.id


def state(database, job_id):
    with database.read() as session:
        return session.get_one(Job, job_id).state


def test_higher_priority_first_then_the_oldest(database):
    low, old, new = add_jobs(database, ("x", 0), ("x", 5), ("x", 5))
    assert [claim(database) for _ in range(4)] == [old, new, low, None]


def test_owners_take_turns(database):
    x1, x2, y1 = add_jobs(database, ("x", 0), ("x", 0), ("y", 0))
    assert [claim(database) for _ in range(3)] == [x1, y1, x2]


def test_owner_at_its_limit_does_not_hold_up_others(database):
    x1, x2, y1 = add_jobs(database, ("x", 9), ("x", 9), ("y", 0))
    assert [claim(database, running_jobs=1) for _ in range(3)] == [x1, y1, None]
    assert state(database, x2) == "queued"


def test_job_that_met_a_full_disk_waits_until_there_is_room_and_holds_up_nobody(database):
    large, other = add_jobs(database, ("x", 5), ("x", 0))
    with database.write() as session:
        session.get_one(Job, large).error = {"code": "disk-full", "needed_bytes": 1000}
    assert leases.claim_job(database, "a", 10, free_bytes=999).id == other
    assert leases.claim_job(database, "a", 10, free_bytes=999) is None
    again = leases.claim_job(database, "a", 10, free_bytes=1000)
    assert (again.id, again.error) == (large, None)


def test_many_at_once_get_each_job_once(database):
    ids = add_jobs(database, *[("x", 0)] * 12)
    got, lock = [], threading.Lock()

    def work(name):
        while True:
            job_id = claim(database, name, running_jobs=100)
            if job_id is None:
                return
            with lock:
                got.append(job_id)

    threads = [threading.Thread(target=work, args=(f"w{n}",)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # a row that another transaction holds is left for the next round: then somebody may go home early
    work("last")
    assert sorted(got) == sorted(ids)


def test_taken_over_job_is_not_its_old_holders_any_more(database, tmp_path):
    [job_id] = add_jobs(database, ("x", 0))
    job = leases.claim_job(database, "dead", 1)
    old = Lease(Job, job_id, "dead", job.attempt)
    assert leases.lose(database, old, "the service died")
    assert claim(database, "alive") == job_id
    with database.write() as session:
        assert old.row(session) is None
        assert Lease(Job, job_id, "alive", 2).row(session) is not None
    assert not leases.lose(database, old, "again")
    with database.read() as session:
        attempts = session.scalars(select(Attempt).order_by(Attempt.number)).all()
    assert [(a.number, a.instance, a.outcome) for a in attempts] == [(1, "dead", "lost"), (2, "alive", None)]


def test_heartbeat_that_stands_still_is_taken_over_and_one_that_moves_is_not(database, tmp_path):
    still, moving = add_jobs(database, ("x", 0), ("x", 0))
    claim(database, "elsewhere+1")
    claim(database, "elsewhere+2")
    me, watch = Instance(tmp_path), Watch(patience=0.3)
    freed = []
    began = time.monotonic()
    # longer than the patience, also where the first is freed at once: the other must stay all the while
    while (seconds := time.monotonic() - began) < 1.0 or (not freed and seconds < 60):
        leases.renew(database, "elsewhere+2")
        freed += leases.take_over(database, me, watch)
    assert [lease.id for lease in freed] == [still]
    assert state(database, still) == "queued"
    assert state(database, moving) == "running"


def test_service_of_the_same_machine_that_died_is_taken_over_at_once(database, tmp_path):
    [job_id] = add_jobs(database, ("x", 0))
    alive, dead = Instance(tmp_path), Instance(tmp_path)
    claim(database, dead.name)
    watch = Watch(patience=1000)
    assert leases.take_over(database, alive, watch) == []
    dead._file.close()  # what the system does when a process ends
    assert [lease.id for lease in leases.take_over(database, alive, watch)] == [job_id]


def test_canceling_job_whose_service_died_is_canceled(database):
    [job_id] = add_jobs(database, ("x", 0))
    job = leases.claim_job(database, "dead", 1)
    with database.write() as session:
        session.get_one(Job, job_id).state = "canceling"
    leases.lose(database, Lease(Job, job_id, "dead", job.attempt), "the service died")
    assert state(database, job_id) == "canceled"
    assert claim(database) is None


def test_job_that_brings_services_down_is_given_up_at_last(database):
    [job_id] = add_jobs(database, ("x", 0))
    for _ in range(leases.MAX_LOSSES):
        job = leases.claim_job(database, "dead", 1)
        leases.lose(database, Lease(Job, job_id, "dead", job.attempt), "the service died")
    with database.read() as session:
        job = session.get_one(Job, job_id)
        assert job.state == "failed"
        assert "20 times" in job.error["cause"]


def test_events_appear_in_the_order_of_their_numbers(database):
    [job_id] = add_jobs(database, ("x", 0))
    seen, done = [], threading.Event()

    def write():
        for _ in range(25):
            with database.write() as session:
                database.order_events(session)
                journal.add(session, session.get_one(Job, job_id), "log", {})

    def read():
        while True:
            last = done.is_set()
            with database.read() as session:
                seen.extend(e.id for e in journal.after(session, seen[-1] if seen else 0))
            if last:
                return

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write) for _ in range(4)]
    for thread in [reader, *writers]:
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    reader.join()
    with database.read() as session:
        assert seen == list(session.scalars(select(Event.id).order_by(Event.id)))
    assert len(seen) == 100


def test_transaction_that_fails_leaves_nothing(database):
    def fail():
        with database.write() as session:
            session.add(Dataset(id="ds_1", owner="x", name="x", state="ready", created=0, updated=0))
            session.flush()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    with database.read() as session:
        assert session.get(Dataset, "ds_1") is None


def test_tables_are_those_that_the_migrations_make(database):
    from alembic.autogenerate import compare_metadata
    from alembic.migration import MigrationContext

    from service.db.tables import Base

    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
    database.migrate()  # once more does no harm


def test_upgrade_keeps_what_is_there(database):
    from sqlalchemy import text

    with database.engine.execution_options(immediate=True).connect() as connection, connection.begin():
        # back to an empty database, which the fixture has brought to this version already
        for table in (
            "results",
            "deliveries",
            "events",
            "attempts",
            "jobs",
            "uploads",
            "datasets",
            "batches",
            "keys",
        ):
            connection.execute(text(f"DROP TABLE {table}"))
        connection.execute(text("DROP TABLE alembic_version"))
    database.migrate("0001")
    old = "INSERT INTO {} VALUES ({})"
    columns = "id, owner, name, state, created, updated, bytes, files, deleted, heartbeat, attempt"
    with database.engine.execution_options(immediate=True).connect() as connection, connection.begin():
        values = "'ds_1', 'ann', 'yard', 'ready', 1, 2, 3, 4, false, 0, 1"
        connection.execute(text(old.format(f"datasets ({columns})", values)))
        columns = "id, owner, name, dataset_id, config, reference, priority, request_digest, state, created, updated"
        columns += ", crashes, losses, stages, progress, estimate, hidden, deleted, bytes, heartbeat, attempt"
        values = "'job_1', 'ann', 'yard', 'ds_1', '{}', false, 0, '', 'queued', 1, 2, 0, 0, '[]', 0, '{}'"
        connection.exec_driver_sql(old.format(f"jobs ({columns})", values + ", false, false, 0, 0, 0"))
    database.migrate()
    assert claim(database) == "job_1"
    with database.read() as session:
        assert session.get_one(Job, "job_1").webhook is None


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.EAGAIN, errno.EMFILE, errno.ENOSPC])
def test_job_whose_process_cannot_be_started_goes_back_as_it_was(database, tmp_path, monkeypatch, number):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("service.system.child_process.subprocess.Popen", fail)
    [job_id] = add_jobs(database, ("x", 0))
    paths = Paths(tmp_path / "data")
    paths.make()
    supervisor = Supervisor(database, paths, Settings())
    for _ in range(3):
        supervisor._idle_until = 0.0
        supervisor._claim()
        with database.read() as session:
            job = session.get_one(Job, job_id)
            assert (job.state, job.lease_owner, job.losses, job.crashes) == ("queued", None, 0, 0)
            assert job.error["cause"].endswith(os.strerror(number))
            assert session.scalars(select(Attempt)).all() == []
    supervisor._claim()
    with database.read() as session:
        assert session.get_one(Job, job_id).attempt == 3, "it waits a while before it tries again"


def test_files_of_dead_services_are_removed_but_for_those_that_others_must_know_of(tmp_path):
    living, needed, *dead = (Instance(tmp_path) for _ in range(5))
    for instance in (needed, *dead):
        instance._file.close()  # as when it is killed: the system lets its lock go
    for name in ("elsewhere+old", "elsewhere+new"):
        (tmp_path / name).touch()
    os.utime(tmp_path / "elsewhere+old", (1.0, 1.0))
    me = Instance(tmp_path)
    me.sweep({needed.name})
    assert {file.name for file in tmp_path.iterdir()} == {living.name, needed.name, me.name, "elsewhere+new"}
    assert me.knows_dead(needed.name)
    assert not me.knows_dead(living.name)


def test_supervisor_sweeps_what_holds_no_lease(database, tmp_path):
    [job_id] = add_jobs(database, ("x", 0))
    paths = Paths(tmp_path / "data")
    paths.make()
    holder, idle = Instance(paths.instances), Instance(paths.instances)
    assert claim(database, owner=holder.name) == job_id
    for instance in (holder, idle):
        instance._file.close()
    supervisor = Supervisor(database, paths, Settings())
    supervisor._sweep_instances()
    assert holder.name in {file.name for file in paths.instances.iterdir()}
    assert idle.name not in {file.name for file in paths.instances.iterdir()}
