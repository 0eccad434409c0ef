"""What goes, when, and what never goes: retention, removal, and folders that the database does not know."""

import dataclasses

import pytest

from service.db.database import Database
from service.db.tables import Dataset, Job
from service.jobs import retention
from service.jobs.retention import Retention
from service.settings import Settings
from service.system import paths as placing
from service.system.paths import Paths, now

DAY = 86400.0


@pytest.fixture
def paths(tmp_path):
    paths = Paths(tmp_path / "data")
    paths.make()
    return paths


@pytest.fixture
def database(paths):
    database = Database(f"sqlite:///{paths.root / 'lvba.sqlite'}")
    database.migrate()
    yield database
    database.close()


def add_job(database, paths, name, state="done", finished_days_ago=10.0, **more):
    with database.write() as session:
        if session.get(Dataset, "ds_1") is None:
            session.add(Dataset(id="ds_1", owner="x", name="x", state="ready", created=0, updated=now()))
            session.flush()
        finished = now() - finished_days_ago * DAY if state in ("done", "failed", "canceled") else None
        job = Job(
            id=name, owner="x", name=name, dataset_id="ds_1", config={}, state=state, created=0, updated=0
        )
        job.finished = finished
        for field, value in more.items():
            setattr(job, field, value)
        session.add(job)
    paths.out(name).mkdir(parents=True)
    (paths.out(name) / "map.ply").write_bytes(b"map")


def left(paths):
    return sorted(path.name for path in (paths.root / "jobs").iterdir())


def test_only_ended_jobs_whose_time_is_over_go(database, paths):
    add_job(database, paths, "old")
    add_job(database, paths, "young", finished_days_ago=1.0)
    add_job(database, paths, "asked to stay", keep_days=30.0)
    add_job(database, paths, "asked to go", finished_days_ago=1.0, keep_days=0.5)
    add_job(database, paths, "runs", state="running")
    swept = Retention(database, paths, Settings(keep_days=7.0)).sweep(sure_s=0.0)
    assert swept == 2
    assert left(paths) == ["asked to stay", "runs", "young"]
    assert list(paths.trash.iterdir()) == []


def test_by_default_everything_stays(database, paths):
    add_job(database, paths, "ancient", finished_days_ago=10_000.0)
    assert Retention(database, paths, Settings()).sweep(sure_s=0.0) == 0
    assert left(paths) == ["ancient"]


def test_clock_that_jumps_ahead_removes_nothing_until_it_is_sure(database, paths, monkeypatch):
    add_job(database, paths, "young", finished_days_ago=0.0)
    keeper = Retention(database, paths, Settings(keep_days=7.0))
    monkeypatch.setattr(retention, "now", lambda: placing.now() + 365 * DAY)
    assert keeper.sweep() == 0
    monkeypatch.setattr(retention, "now", placing.now)
    assert keeper.sweep(sure_s=0.0) == 0
    assert left(paths) == ["young"]


def test_folder_that_the_database_does_not_know_stays(database, paths):
    (paths.root / "jobs" / "job_unknown").mkdir()
    (paths.root / "datasets" / "ds_unknown").mkdir()
    Retention(database, paths, Settings(keep_days=0.001, keep_uploads_days=0.001)).sweep(sure_s=0.0)
    assert left(paths) == ["job_unknown"]
    assert (paths.root / "datasets" / "ds_unknown").exists()


def test_forgotten_uploads_go_and_datasets_in_use_stay(database, paths):
    add_job(database, paths, "done", finished_days_ago=0.0)
    with database.write() as session:
        session.get_one(Dataset, "ds_1").deleted = True
        for name, state in (("ds_2", "uploading"), ("ds_3", "ready")):
            session.add(
                Dataset(id=name, owner="x", name="x", state=state, created=0, updated=now() - 30 * DAY)
            )
    for name in ("ds_1", "ds_2", "ds_3"):
        paths.dataset(name).mkdir(parents=True)
    keeper = Retention(database, paths, Settings())
    keeper.sweep(sure_s=0.0)
    assert sorted(p.name for p in (paths.root / "datasets").iterdir()) == ["ds_1", "ds_3"]
    with database.write() as session:
        session.get_one(Job, "done").deleted = True
    keeper.sweep(sure_s=0.0)
    keeper.sweep(sure_s=0.0)
    assert sorted(p.name for p in (paths.root / "datasets").iterdir()) == ["ds_3"], (
        "nothing needs it any more"
    )
    assert left(paths) == []


def test_removal_that_was_cut_short_is_ended_later(database, paths):
    (paths.trash / "job_half").mkdir()
    (paths.trash / "job_half" / "big").write_bytes(b"x")
    retention.remove_marked(database, paths)
    assert list(paths.trash.iterdir()) == []


def test_settings_come_from_the_environment_and_the_command_line_wins(tmp_path):
    from lvba.errors import InputError
    from service.settings import load

    environment = {"LVBA_PORT": "9", "LVBA_AUTH": "yes", "LVBA_ROOTS": "/a,/b", "LVBA_LIMITS_ATTEMPTS": "7"}
    settings = load({"port": 10, "data": None}, environment)
    assert (settings.port, settings.auth, [str(root) for root in settings.roots]) == (10, True, ["/a", "/b"])
    assert settings.limits.attempts == 7
    assert dataclasses.replace(settings, database="postgres://h/d").database_url == "postgresql+psycopg://h/d"
    for wrong in ({"LVBA_PORT": "x"}, {"LVBA_JOBS": "-1"}, {"LVBA_KEEP_DAYS": "soon"}):
        with pytest.raises(InputError):
            load({}, wrong)
