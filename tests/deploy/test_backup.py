"""backup.sh and restore.sh: of a service that serves and works, on SQLite and on PostgreSQL."""

import os
import shutil
import subprocess
import sys

import pytest
from deployed import DEPLOY
from programs import program_or_skip
from real_server import Service, _programs, ended, submit, until, upload

from service.db import keys
from service.db.database import Database
from service.settings import Settings
from service.system.paths import Paths

PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply"]


@pytest.fixture(params=["sqlite", "postgres"])
def new_database(request):
    """URL of a new database, empty for SQLite."""
    if request.param == "sqlite":
        return lambda: ""
    return request.getfixturevalue("postgres").new_database


@pytest.fixture(autouse=True)
def _rsync():
    """Skips before anything is started that a skipped test would leave running."""
    program_or_skip("rsync")


def script(name, *words, database="", code=0, **more):
    """What the script says."""
    path = f"{_programs()}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHON": sys.executable, "LVBA_DATABASE": database, **more}
    command = ["sh", DEPLOY / f"{name}.sh", *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done.stderr


def service_at(data, database):
    # a restored service waits for the leases of the one that is gone
    environment = {"LVBA_LEASE_S": "4"}
    return Service(data, environment=environment | ({"LVBA_DATABASE": database} if database else {}))


def files(folder):
    """Path below the folder -> content."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_service_is_restored_and_its_job_goes_on(new_database, tiny_recording, tiny_result, tmp_path):
    database, backup = new_database(), tmp_path / "backup"
    service = service_at(tmp_path / "data", database)
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("visual"):
        until(service.http, f"/v1/jobs/{job_id}", lambda job: finished(job, "lidar"))
        assert "database" in script("backup", service.data, backup, database=database)
        service.kill()
    shutil.rmtree(service.data)

    database = new_database()
    script("restore", backup, tmp_path / "restored", database=database)
    restored = service_at(tmp_path / "restored", database)
    job = ended(restored.http, job_id)
    assert job["state"] == "done"
    assert next(stage for stage in job["stages"] if stage["name"] == "lidar")["reused"]
    for name in PRODUCTS:
        found = restored.http.get(f"/v1/jobs/{job_id}/results/{name}").content
        assert found == (tiny_result / name).read_bytes(), name
    restored.stop()


def finished(job, name):
    return any(stage["name"] == name and stage["state"] == "done" for stage in job["stages"])


@pytest.fixture
def data(new_database, tmp_path):
    """A data folder with a dataset, a job and a key, as a service leaves it, and the URL of its database."""
    paths, url = Paths(tmp_path / "data"), new_database()
    paths.make()
    for name in ("datasets/ds_1/files/a.pcd", "jobs/job_1/out/map.ply", "trash/old/file", "secret"):
        (paths.root / name).parent.mkdir(parents=True, exist_ok=True)
        (paths.root / name).write_text(name)
    keys_of(paths.root, url, "first")
    return paths.root, url


def keys_of(folder, url, new=None):
    """Owners of the keys in a database, after one more was made."""
    database = Database(Settings(data=folder, database=url).database_url)
    database.migrate()
    if new:
        keys.create(database, new, ("read",))
    found = sorted(key.owner for key in keys.every(database))
    database.close()
    return found


def test_second_backup_has_what_is_new_and_not_what_went(data, new_database, tmp_path):
    (folder, url), backup = data, tmp_path / "backup"
    script("backup", folder, backup, database=url)
    shutil.rmtree(folder / "datasets" / "ds_1")
    (folder / "jobs" / "job_2").mkdir()
    (folder / "jobs" / "job_2" / "log.txt").write_text("new")
    keys_of(folder, url, "second")
    script("backup", folder, backup, database=url)
    assert set(files(backup / "files")) == {"jobs/job_1/out/map.ply", "jobs/job_2/log.txt", "secret"}
    target = new_database()
    script("restore", backup, tmp_path / "new", database=target)
    assert keys_of(tmp_path / "new", target) == ["first", "second"]
    assert {"secret", "jobs/job_2/log.txt"} < set(files(tmp_path / "new"))
    assert "is not empty" in script("restore", backup, tmp_path / "new", database=target, code=1)


def test_backup_that_is_cut_short_leaves_the_one_before(data, tmp_path):
    (folder, url), backup = data, tmp_path / "backup"
    script("backup", folder, backup, database=url)
    before = files(backup)
    keys_of(folder, url, "second")
    script("backup", folder, backup, database=url, code=1, RSYNC_OPTIONS="--no-such-option")
    after = files(backup)
    assert {path: after[path] for path in before} == before
    assert set(after) - set(before) <= {"database.sqlite.new", "database.dump.new"}


def test_damaged_database_is_not_taken_for_a_backup(tmp_path):
    paths = Paths(tmp_path / "data")
    paths.make()
    keys_of(paths.root, "", "first")
    file = paths.root / "lvba.sqlite"
    content = bytearray(file.read_bytes())
    content[8192:12288] = b"x" * 4096
    file.write_bytes(content)
    script("backup", paths.root, tmp_path / "backup", code=1)
    assert not (tmp_path / "backup" / "database.sqlite").exists()


def test_mistakes_are_said_and_nothing_is_overwritten(postgres, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "is not the data folder" in script("backup", tmp_path / "empty", tmp_path / "b", code=1)
    assert "usage" in script("backup", tmp_path / "empty", code=2)
    assert "is it a copy of another kind" in script("restore", tmp_path / "empty", tmp_path / "new", code=1)
    database, target = postgres.new_database(), postgres.new_database()
    Paths(tmp_path / "data").make()
    keys_of(tmp_path / "data", database)
    script("backup", tmp_path / "data", tmp_path / "backup", database=database)
    used = script("restore", tmp_path / "backup", tmp_path / "new", database=database, code=1)
    assert "the database is not empty" in used
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "new" / "file").touch()
    assert "is not empty" in script("restore", tmp_path / "backup", tmp_path / "new", database=target, code=1)


def test_password_is_on_no_command_line(tmp_path):
    """A pg_dump that writes down how it was called."""
    (tmp_path / "pg_dump").write_text('#!/bin/sh\necho "$* $PGPASSWORD" >"$SEEN"\nexit 9\n')
    for name in ("pg_restore", "psql"):
        (tmp_path / name).write_text("#!/bin/sh\n")
    for name in ("pg_dump", "pg_restore", "psql"):
        (tmp_path / name).chmod(0o755)
    (tmp_path / "data" / "jobs").mkdir(parents=True)
    (tmp_path / "url").write_text("postgresql+psycopg://lvba:a%40b:c@database/lvba?x=1\n")
    environment = {
        **os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "SEEN": str(tmp_path / "seen"),
        "LVBA_DATABASE_FILE": str(tmp_path / "url"), "PYTHON": sys.executable,
    }  # fmt: skip
    command = ["sh", DEPLOY / "backup.sh", tmp_path / "data", tmp_path / "backup"]
    assert subprocess.run(command, env=environment).returncode == 9
    words, password = (tmp_path / "seen").read_text().rsplit(maxsplit=1)
    assert password == "a@b:c"
    assert words.endswith(" postgresql://lvba@database/lvba?x=1")
