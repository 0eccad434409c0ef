"""A job from its submission to its results, on a real service."""

import concurrent.futures
import io
import json
import zipfile

import httpx
import pytest
from real_server import ended, submit, until

from service.api import file_responses
from service.datasets import file_names

PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply", "config.yaml"]


def events(text):
    """Server-sent events as (id, kind, data)."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "id" in fields:
            found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return found


def test_result_has_the_bytes_of_the_command_line(service, done_job, tiny_result):
    assert done_job["state"] == "done", done_job
    for name in PRODUCTS:
        got = service.http.get(f"/v1/jobs/{done_job['id']}/results/{name}")
        assert got.content == (tiny_result / name).read_bytes(), name


def test_ended_job_says_what_happened(done_job, tiny_result):
    stages = [stage["name"] for stage in json.loads((tiny_result / "report.json").read_text())["stages"]]
    assert [stage["name"] for stage in done_job["stages"]] == [*stages, "write", "viewer"]
    assert {stage["state"] for stage in done_job["stages"]} == {"done"}
    assert [attempt["outcome"] for attempt in done_job["attempts"]] == ["done"]
    assert done_job["progress"] == 1.0
    assert done_job["error"] is None
    assert done_job["summary"]["psnr_after"] > done_job["summary"]["psnr_before"]
    assert done_job["estimate"]["seconds"] > 0
    assert done_job["estimate"]["memory_bytes"] > 1e8


def test_events_tell_everything_in_order_and_go_on_where_one_stopped(service, done_job):
    url = f"/v1/jobs/{done_job['id']}/events"
    told = events(service.http.get(url).text)
    kinds = [kind for _, kind, _ in told]
    assert kinds[0] == "state"
    assert kinds[-1] == "end"
    ids = [number for number, _, _ in told]
    assert ids == sorted(set(ids))
    begun = [data["name"] for _, kind, data in told if kind == "stage" and data["state"] == "running"]
    assert begun == [stage["name"] for stage in done_job["stages"]][1:]
    half = ids[len(ids) // 2]
    rest = events(service.http.get(url, headers={"Last-Event-ID": str(half)}).text)
    assert rest == [event for event in told if event[0] > half]
    assert events(service.http.get(url, params={"after": half}).text) == rest


def test_results_are_listed_and_come_whole_or_in_parts(service, done_job, tiny_result):
    items = service.http.get(done_job["links"]["results"]).json()["items"]
    names = {item["name"]: item for item in items}
    assert {*PRODUCTS, "report.json", "report.html"} <= set(names)
    assert not any(name.startswith("stages") for name in names)
    whole = (tiny_result / "map.ply").read_bytes()
    item = names["map.ply"]
    assert item["bytes"] == len(whole)
    head = service.http.head(item["url"])
    assert (head.headers["content-length"], head.headers["etag"]) == (str(len(whole)), item["etag"])
    part = service.http.get(item["url"], headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, whole[100:200])
    tail = service.http.get(item["url"], headers={"Range": "bytes=-50", "If-Range": item["etag"]})
    assert (tail.status_code, tail.content) == (206, whole[-50:])
    other = service.http.get(item["url"], headers={"Range": "bytes=0-9", "If-Range": '"other"'})
    assert (other.status_code, other.content) == (200, whole)
    assert service.http.get(item["url"], headers={"If-None-Match": item["etag"]}).status_code == 304
    for wrong in ("bytes=999999999-", "bytes=9-1", "pages=1-2,x"):
        beyond = service.http.get(item["url"], headers={"Range": wrong})
        assert (beyond.status_code, beyond.json()["code"]) == (416, "range")
        assert beyond.headers["content-range"] == f"bytes */{len(whole)}"


def test_archive_holds_all_results_in_a_folder_named_after_the_job(service, done_job, tiny_result):
    answer = service.http.get(done_job["links"]["archive"])
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    assert archive.read("first/map.ply") == (tiny_result / "map.ply").read_bytes()
    items = service.http.get(done_job["links"]["results"]).json()["items"]
    assert sorted(archive.namelist()) == [f"first/{item['name']}" for item in items]
    assert 'filename="first.zip"' in answer.headers["content-disposition"]


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("Lange Straße 4", "Lange Straße 4"), ("../../etc", "_.._etc"), ("a/b\\c", "a_b_c"), (".hidden", "hidden"),
        ("..", "job_1"), ("", "job_1"), ("nul.txt", "_nul.txt"), ("yard\u202egpj", "yard_gpj"),
        ("x" * 150, "x" * 100),
    ],
)  # fmt: skip
def test_names_of_archives_are_plain(name, plain):
    assert file_names.plain(name, "job_1") == plain
    disposition = file_responses.attachment(f"{file_names.plain(name, 'job_1')}.zip")
    assert disposition.isascii()
    assert disposition.count('"') == 2


def test_report_has_the_name_of_the_recording(service, done_job):
    page = service.http.get(f"/v1/jobs/{done_job['id']}/results/report.html").text
    recording = service.http.get(f"/v1/datasets/{done_job['dataset']}").json()["name"]
    assert f"<title>{recording} - " in page
    assert recording != "files"


@pytest.mark.parametrize(
    "name",
    ["../config.yaml", "%2e%2e/config.yaml", "..%2f..%2flvba.sqlite", "stages/.lock", ".partial", "none"],
)
def test_only_results_are_served(service, done_job, name):
    with httpx.Client() as plain:
        answer = plain.get(f"{service.url}/v1/jobs/{done_job['id']}/results/{name}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_report_cannot_reach_the_origin_that_serves_it(service, done_job):
    answer = service.http.get(f"/v1/jobs/{done_job['id']}/results/report.html")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;")
    assert "allow-same-origin" not in policy


def test_log_is_read_piece_by_piece_and_names_no_folder_of_the_server(service, done_job):
    url, start, text = f"/v1/jobs/{done_job['id']}/logs", 0, ""
    while True:
        piece = service.http.get(url, params={"from": start, "limit": 100}).json()
        text, start = text + piece["text"], piece["next"]
        if piece["next"] >= piece["size"]:
            break
    assert "--- attempt 1" in text
    assert "lidar" in text
    assert str(service.data) not in text
    assert "report: OUT/report.html\n" in text
    tail = service.http.get(url, params={"from": -200}).json()["text"]
    assert tail
    assert text.endswith("\n" + tail)


def test_frames_name_the_photographs(service, done_job, tiny_recording):
    frames = service.http.get(done_job["links"]["frames"]).json()["items"]
    assert [frame["index"] for frame in frames] == list(range(8))
    picture = service.http.get(frames[3]["raw"])
    files = sorted((tiny_recording / "all_image").glob("*.png")) or sorted(
        (tiny_recording / "all_image").glob("*.jpg")
    )
    assert picture.content == files[3].read_bytes()
    assert picture.headers["content-type"] in ("image/png", "image/jpeg")


def test_restart_makes_only_what_is_asked_for_and_what_depends_on_it(service, done_job, ready_dataset):
    before = service.http.get(f"/v1/jobs/{done_job['id']}/results/map.ply").content
    answer = service.http.post(f"/v1/jobs/{done_job['id']}/restart", json={"from": "visual-gate"})
    assert answer.status_code == 202
    job = ended(service.http, done_job["id"])
    assert job["state"] == "done"
    again = [stage["name"] for stage in job["stages"][1:-2] if not stage["reused"]]
    assert again == [
        *("visual-gate", "evaluate-result", "expected-error"),
        *("map", "planes", "renderings", "pictures", "facts"),
    ]
    assert service.http.get(f"/v1/jobs/{job['id']}/results/map.ply").content == before
    service.http.post(f"/v1/jobs/{job['id']}/restart", json={"config": {"map": {"voxel_m": 0.3}}})
    job = ended(service.http, done_job["id"])
    assert [stage["name"] for stage in job["stages"][1:-2] if not stage["reused"]] == ["map", "facts"]
    assert service.http.get(f"/v1/jobs/{job['id']}/results/map.ply").content != before
    assert [attempt["number"] for attempt in job["attempts"]] == [1, 2, 3]
    # others compare with the result as it was
    service.http.post(f"/v1/jobs/{job['id']}/restart", json={"config": {}})
    ended(service.http, done_job["id"])
    assert service.http.get(f"/v1/jobs/{job['id']}/results/map.ply").content == before


def test_restart_from_no_stage_names_those_there_are(service, done_job):
    answer = service.http.post(f"/v1/jobs/{done_job['id']}/restart", json={"from": "colour"})
    assert answer.status_code == 422
    assert "one of these: survey" in answer.json()["hint"]


def test_one_idempotency_key_many_times_at_once_makes_one_job(service, ready_dataset):
    with concurrent.futures.ThreadPoolExecutor(10) as pool:
        jobs = list(
            pool.map(lambda _: submit(service.http, ready_dataset, key="same", priority=-5), range(10))
        )
    assert len({job["id"] for job in jobs}) == 1
    other = service.http.post(
        "/v1/jobs", json={"dataset": ready_dataset}, headers={"Idempotency-Key": "same"}
    )
    assert other.status_code == 422
    canceled = service.http.post(f"/v1/jobs/{jobs[0]['id']}/cancel")
    assert canceled.status_code == 202
    job = ended(service.http, jobs[0]["id"])
    assert job["state"] == "canceled"
    assert service.http.post(f"/v1/jobs/{job['id']}/cancel").status_code == 202
    assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert service.http.get(f"/v1/jobs/{job['id']}").status_code == 404


def test_running_job_is_canceled_and_goes_on_later(service, ready_dataset):
    with service.held("visual"):
        job = submit(service.http, ready_dataset, config={"visual": {"levels": 1}})
        until(
            service.http,
            f"/v1/jobs/{job['id']}",
            lambda row: any(stage["state"] == "running" for stage in row["stages"]),
        )
        assert service.http.get(f"/v1/jobs/{job['id']}/results").status_code == 409
        assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 409
        assert service.http.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "canceling"
        stopped = ended(service.http, job["id"])
    assert stopped["state"] == "canceled"
    assert stopped["attempts"][-1]["outcome"] == "canceled"
    assert "failed" not in {stage["state"] for stage in stopped["stages"]}
    told = [kind for _, kind, _ in events(service.http.get(f"/v1/jobs/{job['id']}/events").text)]
    assert told[-1] == "end"
    assert "progress" not in told


def test_setting_that_does_not_exist_is_refused_with_what_was_meant(service, ready_dataset):
    answer = service.http.post(
        "/v1/jobs", json={"dataset": ready_dataset, "config": {"visual": {"levls": 2}}}
    )
    assert answer.status_code == 422
    assert answer.json()["hint"] == "did you mean visual.levels?"
    wrong = {"dataset": ready_dataset, "config": {"visual": {"levels": 77}}}
    [error] = service.http.post("/v1/jobs", json=wrong).json()["errors"]
    assert error == {"where": "config.visual.levels", "message": "levels is 77, must be 1 to 6"}


def test_run_that_fails_says_why_and_what_to_do(service, ready_dataset):
    # scans that hold no plane of this size: nothing to refine from
    files = service.data / "datasets" / ready_dataset / "files"
    hidden = (files / "all_pcd_body").rename(files / "away")
    try:
        job = ended(service.http, submit(service.http, ready_dataset)["id"])
    finally:
        hidden.rename(files / "all_pcd_body")
    assert job["state"] == "failed"
    assert job["error"]["code"] == "input"
    assert "there is no such folder" in job["error"]["cause"]
    assert job["error"]["hint"]
    assert str(service.data) not in json.dumps(job)


def test_disk_that_cannot_hold_a_job_refuses_it(tiny_recording, tmp_path):
    from real_server import Service, upload

    service = Service(tmp_path / "data", "--jobs", "0")
    dataset = upload(service.http, tiny_recording)
    service.stop()
    crowded = Service(tmp_path / "data", environment={"LVBA_LIMITS_DISK_RESERVE_BYTES": str(1 << 60)})
    answer = crowded.http.post("/v1/jobs", json={"dataset": dataset})
    assert answer.status_code == 507
    assert answer.json()["code"] == "disk-full"
    assert answer.json()["needed_bytes"] > answer.json()["free_bytes"]
    assert crowded.stop() == 0


def test_batch_is_all_or_nothing_and_is_canceled_as_one(service, ready_dataset):
    bad = {"name": "bad", "jobs": [{"dataset": ready_dataset}, {"dataset": "ds_0"}]}
    answer = service.http.post("/v1/batches", json=bad)
    assert (answer.status_code, answer.json()["entry"]) == (404, 1)
    assert "bad" not in [row["name"] for row in service.http.get("/v1/batches").json()["items"]]
    good = {
        "name": "good",
        "jobs": [{"dataset": ready_dataset, "priority": -9, "name": f"n{i}"} for i in range(3)],
    }
    with service.held("lidar"):
        made = service.http.post("/v1/batches", json=good, headers={"Idempotency-Key": "b"})
        assert made.status_code == 201
        again = service.http.post("/v1/batches", json=good, headers={"Idempotency-Key": "b"})
        assert (again.status_code, again.json()["id"]) == (200, made.json()["id"])
        batch = service.http.get(f"/v1/batches/{made.json()['id']}").json()
        assert batch["counts"]["queued"] + batch["counts"]["running"] == 3
        assert [job["name"] for job in batch["jobs"]] == ["n0", "n1", "n2"]
        service.http.post(f"/v1/batches/{batch['id']}/cancel")
        until(service.http, f"/v1/batches/{batch['id']}", lambda row: row["counts"]["canceled"] == 3)


def test_backup_taken_while_it_serves_is_restored(service, done_job, tmp_path):
    import shutil
    import sqlite3

    from real_server import Service

    copy = tmp_path / "copy"
    copy.mkdir()
    with (
        sqlite3.connect(service.data / "lvba.sqlite") as here,
        sqlite3.connect(copy / "lvba.sqlite") as there,
    ):
        here.backup(there)
    left_out = shutil.ignore_patterns("lvba.sqlite*", "instances", "trash")
    shutil.copytree(service.data, copy, ignore=left_out, dirs_exist_ok=True)
    restored = Service(copy, "--jobs", "0")
    job = restored.http.get(f"/v1/jobs/{done_job['id']}").json()
    assert job["state"] == "done"
    url = f"/v1/jobs/{done_job['id']}/results/map.ply"
    assert restored.http.get(url).content == service.http.get(url).content
    assert restored.stop() == 0


def test_run_that_fails_by_itself_is_not_tried_again(service, done_job):
    # a folder where the run keeps its lock: an error that it has no words for
    lock = service.data / "jobs" / done_job["id"] / "out" / "stages" / ".lock"
    lock.unlink()
    lock.mkdir()
    before = len(service.http.get(f"/v1/jobs/{done_job['id']}").json()["attempts"])
    service.http.post(f"/v1/jobs/{done_job['id']}/restart")
    job = ended(service.http, done_job["id"])
    lock.rmdir()
    assert (job["state"], job["error"]["code"]) == ("failed", "failed")
    assert job["error"]["cause"].startswith("IsADirectoryError")
    assert str(service.data) not in job["error"]["cause"]
    assert [attempt["outcome"] for attempt in job["attempts"]][before:] == ["failed"]
    service.http.post(f"/v1/jobs/{done_job['id']}/restart")
    assert ended(service.http, done_job["id"])["state"] == "done"
