"""From a backup of the first version to this one, by the steps of docs/operations.md; and what retention then removes."""

import os
import subprocess
import sys

import pytest
import sqlalchemy
from deployed import DEPLOY, ROOT
from programs import program_or_skip
from real_server import Service, _programs, postgres_or_skip

from service.db.database import Database
from service.settings import Settings
from service.system.paths import Paths, now


@pytest.fixture(params=["sqlite", "postgres"])
def new_database(request):
    """URL of a new database, empty for SQLite."""
    if request.param == "sqlite":
        yield lambda: ""
        return
    server = postgres_or_skip()
    yield server.new_database
    server.stop()


def run(database, *words, **more):
    """What a command says that gets the settings of a service."""
    environment = {
        **os.environ, "PATH": f"{_programs()}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT),
        "PYTHON": sys.executable, "LVBA_DATABASE": database, **more,
    }  # fmt: skip
    done = subprocess.run([*map(str, words)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def first_version(folder, url):
    """A data folder as the first version left it: one job that ended today, one that ended long ago."""
    paths = Paths(folder)
    paths.make()
    database = Database(Settings(data=folder, database=url).database_url)
    database.migrate("0001")
    tables = sqlalchemy.MetaData()
    with database.engine.execution_options(immediate=True).connect() as connection, connection.begin():
        tables.reflect(connection)
        dataset = {"id": "ds_1", "owner": "local", "name": "yard", "state": "ready", "folder": str(folder)}
        dataset |= {"created": 1, "updated": 1, "bytes": 3, "files": 4, "deleted": False, "heartbeat": 0}
        connection.execute(tables.tables["datasets"].insert(), dataset | {"attempt": 1})
        for name, finished in (("job_old", 1000.0), ("job_new", now())):
            connection.execute(tables.tables["jobs"].insert(), job(name, finished))
            paths.out(name).mkdir(parents=True)
            (paths.out(name) / "map.ply").write_text(name)
    database.close()


def job(name, finished):
    told = {"config": {}, "stages": [], "estimate": {}, "summary": {}, "request_digest": ""}
    counts = dict.fromkeys(["priority", "crashes", "losses", "bytes", "heartbeat", "attempt"], 0)
    flags = dict.fromkeys(["reference", "hidden", "deleted"], False)
    times = {"created": 1.0, "updated": finished, "started": 1.0, "finished": finished, "progress": 1.0}
    who = {"id": name, "owner": "local", "name": name, "dataset_id": "ds_1", "state": "done"}
    return told | counts | flags | times | who


def test_backup_of_the_first_version_is_restored_upgraded_and_swept(new_database, tmp_path):
    program_or_skip("rsync")
    old, new = new_database(), new_database()
    first_version(tmp_path / "data", old)
    run(old, "sh", DEPLOY / "backup.sh", tmp_path / "data", tmp_path / "backup")
    restored = tmp_path / "restored"
    run(new, "sh", DEPLOY / "restore.sh", tmp_path / "backup", restored)

    service = Service(restored, environment={"LVBA_DATABASE": new} if new else {})
    for name in ("job_old", "job_new"):
        assert service.http.get(f"/v1/jobs/{name}").json()["state"] == "done"
        assert service.http.get(f"/v1/jobs/{name}/results/map.ply").text == name
    assert service.stop() == 0

    (restored / "jobs" / "job_unknown").mkdir()
    lvba = [sys.executable, "-m", "service.cli", "admin"]
    assert "as this version needs them" in run(new, *lvba, "migrate", "--data", restored)
    assert run(new, *lvba, "sweep", "--data", restored) == "0 removed\n"
    assert run(new, *lvba, "sweep", "--data", restored, LVBA_KEEP_DAYS="30") == "1 removed\n"
    assert sorted(path.name for path in (restored / "jobs").iterdir()) == ["job_new", "job_unknown"]
