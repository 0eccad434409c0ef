"""Whoever may submit cannot take more than is its own: what is refused leaves nothing, and all that lies there counts."""

import io
import os
import random
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import pytest
from real_server import Service, until, upload

from service.datasets import leftovers
from service.db.database import Database
from service.db.tables import Dataset, Job, Upload
from service.system import file_lock
from service.system.paths import Paths

QUOTA = 5_000_000
LIMITS = {
    "LVBA_LIMITS_OWNER_BYTES": str(QUOTA),
    "LVBA_LIMITS_OWNER_FILES": "60",
    "LVBA_LIMITS_ARCHIVE_ENTRIES": "50",
}


@pytest.fixture
def small(tmp_path, on_database):
    """A service that gives an owner little."""
    service = Service(tmp_path / "data", *on_database, environment=LIMITS)
    yield service
    assert service.stop() == 0


def zipped(**files):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return packed.getvalue()


def refused(http, content):
    """A dataset whose archive was refused."""
    dataset = http.post("/v1/datasets", json={"name": "much"}).json()["id"]
    assert http.put(f"/v1/datasets/{dataset}/archive", content=content).status_code == 201
    http.post(f"/v1/datasets/{dataset}/finish").raise_for_status()
    found = until(http, f"/v1/datasets/{dataset}", lambda row: row["state"] != "validating")
    assert found["state"] == "invalid", found
    return found


def there(service, dataset):
    """What lies in the folders of a dataset: names, without its own few small files."""
    folder = service.data / "datasets" / dataset
    return sorted(path.relative_to(folder).parts[0] for path in folder.rglob("*") if path.parent != folder)


def used(http):
    quota = http.get("/v1/me").json()["quota"]
    return quota["bytes_used"], quota["files_used"]


def text(size):
    """It packs to about a sixth."""
    letters = random.Random(3).choices(b"01", k=100_000)
    return bytes(letters) * (size // 100_000)


def test_refused_archives_leave_nothing_and_a_small_one_holds_no_more_than_the_quota(small):
    http = small.http
    bombs = [zipped(**{f"all_image/{n}.png": bytes(7_000_000) for n in range(15)}) for _ in range(3)]
    crowds = [zipped(**{f"{n}/{n}.png": b"" for n in range(26)}) for _ in range(3)]
    poor = zipped(**{f"all_image/{n}.png": b"no picture" for n in range(40)})
    large = zipped(scan=random.Random(1).randbytes(200_000) + text(6_000_000))
    found = {name: [refused(http, each) for each in each_kind] for name, each_kind in
             {"bomb": bombs, "crowd": crowds, "poor": [poor], "large": [large]}.items()}  # fmt: skip
    assert {row["error"]["code"] for row in found["large"]} == {"quota"}
    assert all("50 files and folders" in row["error"]["cause"] for row in found["crowd"])
    every = [row["id"] for rows in found.values() for row in rows]
    assert [there(small, dataset) for dataset in every] == [["uploads"]] * len(every)
    archives = sum(map(len, [*bombs, *crowds, poor, large]))
    assert used(http) == (archives, 2 * len(every))
    left = small.data / "datasets" / every[0] / "files.partial"
    left.mkdir()  # as by a check that ended with its machine
    for dataset in every[1:]:
        assert http.delete(f"/v1/datasets/{dataset}").status_code == 204
    until(http, "/v1/me", lambda me: not left.exists())
    assert there(small, every[0]) == ["uploads"]
    for dataset in every[:1]:
        assert http.delete(f"/v1/datasets/{dataset}").status_code == 204
    until(http, "/v1/me", lambda me: me["quota"]["bytes_used"] == me["quota"]["files_used"] == 0)
    assert list((small.data / "datasets").iterdir()) == list((small.data / "trash").iterdir()) == []


def test_of_two_recordings_that_are_unpacked_at_once_one_has_no_room(small, tiny_recording):
    http = small.http
    files = [path for path in tiny_recording.rglob("*") if path.is_file()]
    contents = {path.relative_to(tiny_recording).as_posix(): path.read_bytes() for path in files}
    packed = zipped(padding=text(2_600_000), **contents)
    datasets = [http.post("/v1/datasets", json={"name": "much"}).json()["id"] for _ in range(2)]
    for dataset in datasets:
        assert http.put(f"/v1/datasets/{dataset}/archive", content=packed).status_code == 201
    for dataset in datasets:
        assert http.post(f"/v1/datasets/{dataset}/finish").status_code == 202
    found = [
        until(http, f"/v1/datasets/{dataset}", lambda row: row["state"] in ("ready", "invalid"))
        for dataset in datasets
    ]
    assert sorted(row["state"] for row in found) == ["invalid", "ready"]
    assert [row["error"]["code"] for row in found if row["error"]] == ["quota"]
    assert used(http)[0] < QUOTA


def test_everything_that_lies_there_counts(small, tiny_recording):
    http = small.http
    ready = upload(http, tiny_recording)
    begun = http.post("/v1/datasets", json={"name": "begun"}).json()["id"]
    url = f"/v1/datasets/{begun}/files"
    assert http.put(f"{url}/a", content=b"x", headers={"Upload-Length": "4000000"}).status_code == 200
    before = used(http)
    assert before[0] > 4_000_000
    for length in (QUOTA, QUOTA - before[0] + 1):
        answer = http.put(f"{url}/b", content=b"x", headers={"Upload-Length": str(length)})
        assert (answer.status_code, answer.json()["code"]) == (429, "quota")
    many = [http.post("/v1/datasets", json={"name": "many"}).json()["id"] for _ in range(8)]
    begin = {"content": b"x", "headers": {"Upload-Length": str((QUOTA - before[0]) * 2 // 3)}}
    with ThreadPoolExecutor(8) as threads:  # each alone would do
        answers = list(threads.map(lambda each: http.put(f"/v1/datasets/{each}/files/a", **begin), many))
    assert sorted(answer.status_code for answer in answers) == [200] + [429] * 7
    for each in many:
        assert http.delete(f"/v1/datasets/{each}").status_code == 204
    until(http, "/v1/me", lambda me: me["quota"]["files_used"] == before[1])
    job = http.post("/v1/jobs", json={"dataset": ready})  # what it is estimated to take is more than is left
    assert (job.status_code, job.json()["code"]) == (429, "quota")
    assert used(http) == before
    for number in range(60 - before[1]):
        assert http.put(f"{url}/{number}", content=b"").status_code == 201
    assert http.put(f"{url}/one_more", content=b"").status_code == 429
    assert http.post("/v1/datasets", json={"name": "one more"}).status_code == 429


@pytest.fixture
def database(tmp_path, on_database):
    url = on_database[1] if on_database else f"sqlite:///{tmp_path / 'lvba.sqlite'}"
    database = Database(url.replace("postgresql://", "postgresql+psycopg://"))
    database.migrate()
    yield database
    database.close()


def add_dataset(database, paths, name, state, folder=None, **more):
    with database.write() as session:
        row = Dataset(id=name, owner="x", name=name, state=state, folder=folder, created=0, updated=0, **more)
        session.add(row)
    for part in (paths.files(name), paths.partial(name), paths.uploads(name)):
        part.mkdir(parents=True)
        (part / "big").write_bytes(b"x")


def test_what_an_end_of_the_machine_left_is_swept(database, tmp_path):
    paths = Paths(tmp_path / "data")
    paths.make()
    add_dataset(database, paths, "refused", "invalid")
    add_dataset(database, paths, "arrives", "uploading")
    add_dataset(database, paths, "ready", "ready")
    add_dataset(database, paths, "fetched", "invalid", "s3://bucket/one", bytes=1)
    add_dataset(database, paths, "checked", "validating")
    add_dataset(database, paths, "locked", "invalid")
    (paths.root / "datasets" / "unknown" / "files.partial").mkdir(parents=True)
    with database.write() as session:
        session.add(Upload(id="big", dataset_id="arrives", path="", length=1))
        ended = {"state": "failed", "attempt": 1, "created": 0, "updated": 0, "config": {}}
        session.add(Job(id="job_1", owner="x", name="x", dataset_id="ready", **ended))
    paths.out("job_1").mkdir(parents=True)
    (paths.out("job_1") / "map.ply").write_bytes(b"12345")
    with file_lock.exclusive(paths.dataset("locked") / ".lock"):  # by a check that has just begun
        leftovers.sweep(database, paths, uploads=False)
    left = {
        folder.name: sorted(part.name for part in folder.iterdir() if part.is_dir())
        for folder in (paths.root / "datasets").iterdir()
    }
    assert left == {
        "refused": ["uploads"],
        "arrives": ["uploads"],
        "ready": ["files"],
        "fetched": ["files.partial", "uploads"],
        "checked": ["files", "files.partial", "uploads"],
        "locked": ["files", "files.partial", "uploads"],
        "unknown": ["files.partial"],
    }
    assert list(paths.trash.iterdir()) == []
    with database.read() as session:
        assert session.get(Job, "job_1").bytes == 5
    for dataset in ("refused", "arrives"):
        for name, age in (("old", 7200), ("big", 7200), ("young", 0)):
            make_old(paths.uploads(dataset) / name, age)
    leftovers.sweep(database, paths, uploads=True)
    assert sorted(path.name for path in paths.uploads("refused").iterdir()) == ["young"]
    assert sorted(path.name for path in paths.uploads("arrives").iterdir()) == ["big", "young"]


def make_old(file, seconds):
    file.write_bytes(b"x")
    os.utime(file, (time.time() - seconds,) * 2)
