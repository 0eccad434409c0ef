"""Bags on a server: looked at, imported and run as one job, the import kept for the next one."""

import json
import shutil
import struct

import pytest
from real_server import ended, submit, until


@pytest.fixture(scope="module")
def dataset(service, bags):
    """Id of the ROS 1 bag, with a calibration and poses beside it."""
    extra = {"cam.yaml": b"cam0: {}\n", "poses.txt": b"# none\n"}
    found = sent(service, bags / "walk.bag", **extra)
    assert found["state"] == "ready", found
    return found["id"]


@pytest.fixture(scope="module")
def job(service, dataset):
    """A job on it that has ended well."""
    done = ended(
        service.http, submit(service.http, dataset, name="walk", **{"import": {"imu": "none"}})["id"]
    )
    assert done["state"] == "done", done
    return done


def sent(service, bag, **extra):
    """The dataset of a file, or a folder of files, once it is checked. extra: content of files by name"""
    http = service.http
    made = http.post("/v1/datasets", json={"name": bag.name}).raise_for_status().json()["id"]
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    contents = {file.name: file.read_bytes() for file in files} | {
        n.replace("__", "."): c for n, c in extra.items()
    }
    for name, content in contents.items():
        http.put(f"/v1/datasets/{made}/files/{name}", content=content).raise_for_status()
    http.post(f"/v1/datasets/{made}/finish").raise_for_status()
    return until(http, f"/v1/datasets/{made}", lambda row: row["state"] in ("ready", "invalid"))


@pytest.mark.parametrize(
    ("name", "form"),
    [("walk.bag", "ROS 1 bag"), ("walk_mcap", "MCAP file"), ("walk_sqlite3", "ROS 2 bag (sqlite3)")],
)
def test_what_is_in_a_bag_of_each_container_is_told(service, bags, name, form):
    found = sent(service, bags / name)
    facts = found["facts"]
    assert (facts["format"], facts["scans"], facts["images"]) == (form, 16, 8)
    assert (facts["width"], facts["height"]) == (96, 72)
    inspection = service.http.get(f"/v1/datasets/{found['id']}/inspection").raise_for_status().json()
    assert inspection["choice"] == {
        "lidar": "/lidar/points", "image": "/camera/image", "odometry": "/odometry", "imu": "/imu/data",
    }  # fmt: skip
    streams = {each["name"]: each for each in inspection["streams"]}
    scans = streams["/lidar/points"]
    assert (scans["stamp_is"], scans["time_unit"], round(scans["rate"])) == ("end of the sweep", "s", 10)
    assert streams["/camera/camera_info"]["fx_fy_cx_cy"][0] == pytest.approx(77.451)
    assert inspection["missing"] == []
    assert str(service.data) not in json.dumps([found, inspection])


def test_a_job_imports_the_bag_and_refines_it_as_stages_of_one(service, job):
    names = [stage["name"] for stage in job["stages"]]
    assert names[:2] == ["import", "input"]
    assert names[-1] == "viewer"
    assert {stage["state"] for stage in job["stages"]} == {"done"}
    assert job["import"] == {"imu": "none"}
    assert job["stages"][0]["seconds"] > 0
    assert not job["stages"][0]["reused"]
    results = service.http.get(f"/v1/jobs/{job['id']}/results").json()["items"]
    assert "map.ply" in {each["name"] for each in results}
    frames = service.http.get(f"/v1/jobs/{job['id']}/frames").raise_for_status().json()["items"]
    assert len(frames) == 8
    assert frames[0]["photo"] is not None
    log = service.http.get(f"/v1/jobs/{job['id']}/logs").json()["text"]
    assert "16 scans and 8 images, imported" in log
    assert str(service.data) not in log


def stage_done(service, job_id, name):
    """The stage of a running job, once it is done."""
    found = until(
        service.http,
        f"/v1/jobs/{job_id}",
        lambda job: any((stage["name"], stage["state"]) == (name, "done") for stage in job["stages"]),
    )
    return next(stage for stage in found["stages"] if stage["name"] == name)


def canceled(service, job_id):
    service.http.post(f"/v1/jobs/{job_id}/cancel").raise_for_status()
    return ended(service.http, job_id)


def test_another_job_with_the_same_choices_reuses_the_import(service, dataset, job):
    before = service.http.get(f"/v1/datasets/{dataset}").json()["bytes"]
    with service.held("survey"):
        again = submit(service.http, dataset, **{"import": {"imu": "none", "every": 1}})["id"]
        assert stage_done(service, again, "input")
        assert stage_done(service, again, "import")["reused"] is True
        canceled(service, again)
    assert service.http.get(f"/v1/datasets/{dataset}").json()["bytes"] == before


def test_canceled_in_the_import_it_goes_on_when_restarted_and_the_import_goes_with_its_last_job(
    service, dataset, job
):
    before = service.http.get(f"/v1/datasets/{dataset}").json()["bytes"]
    with service.held("import"):
        held = submit(service.http, dataset, **{"import": {"rate": 5.0}})["id"]
        until(
            service.http,
            f"/v1/jobs/{held}",
            lambda one: one["stages"] and one["stages"][0]["what"] == "held by a test",
        )
        assert canceled(service, held)["stages"][0]["state"] == "stopped"
    with service.held("survey"):
        service.http.post(f"/v1/jobs/{held}/restart").raise_for_status()
        assert stage_done(service, held, "import")["reused"] is False
        canceled(service, held)
    assert service.http.get(f"/v1/datasets/{dataset}").json()["bytes"] > before
    service.http.delete(f"/v1/jobs/{held}").raise_for_status()
    until(service.http, f"/v1/datasets/{dataset}", lambda row: row["bytes"] == before)


@pytest.mark.parametrize(
    ("choices", "place", "words"),
    [
        ({"lidar": "/nothing"}, "import.lidar", "/lidar/points"),
        ({"odometry": "run {bag} {out}"}, "import.odometry", "runs no commands"),
        ({"odometry": "/etc/passwd"}, "import.odometry", "upload it beside the bag"),
        ({"calibration": ["../../secret"]}, "import.calibration", "plain"),
        ({"calibration": ["nowhere.yaml"]}, "import.calibration", "there are cam.yaml, poses.txt"),
        ({"preset": "kitti"}, "import.preset", "choose one of hilti-2022"),
        ({"conventions": {"pose_of": "wheel"}}, "import.conventions", "body, lidar, camera"),
        ({"conventions": ["a"]}, "import", "object of texts"),
        ({"every": 0}, "import.every", "at least 1"),
        ({"topic": "/a"}, "import.topic", "no such setting"),
    ],
)
def test_a_wrong_choice_is_refused_before_anything_waits(service, dataset, choices, place, words):
    answer = service.http.post("/v1/jobs", json={"dataset": dataset, "import": choices})
    assert answer.status_code == 422, answer.text
    problem = answer.json()
    [error] = problem["errors"]
    assert error["where"] == place
    assert words in f"{problem['detail']}; {problem['hint']}"
    assert str(service.data) not in answer.text


def test_poses_that_are_none_are_named_by_the_job(service, dataset):
    done = ended(service.http, submit(service.http, dataset, **{"import": {"odometry": "poses.txt"}})["id"])
    assert (done["state"], done["error"]["code"], done["error"]["stage"]) == ("failed", "input", "import")
    assert done["error"]["cause"].startswith("DATASET/poses.txt:")


def test_a_recording_takes_no_import(service, ready_dataset):
    answer = service.http.post("/v1/jobs", json={"dataset": ready_dataset, "import": {}})
    assert (answer.status_code, answer.json()["detail"]) == (
        422,
        "the dataset is a recording and needs no import",
    )
    assert service.http.get(f"/v1/datasets/{ready_dataset}/inspection").status_code == 404


def test_a_cut_bag_is_taken_with_what_is_left_of_it(service, bags, tmp_path):
    cut = tmp_path / "cut.bag"
    cut.write_bytes((bags / "walk.bag").read_bytes()[:400_000])
    found = sent(service, cut)
    assert found["state"] == "ready"
    assert 0 < found["facts"]["scans"] < 16
    assert "has no index" in found["facts"]["warnings"][0]


def hostile(folder, bags):
    """Bags that mean no good, with what is said of each."""
    whole = (bags / "walk.bag").read_bytes()
    (folder / "empty.bag").write_bytes(b"")
    yield folder / "empty.bag", "empty.bag"
    length = struct.pack("<I", 0xFFFFFFF0)
    (folder / "huge.bag").write_bytes(whole[:13] + length + whole[17:])
    yield folder / "huge.bag", "huge.bag"
    (folder / "text.db3").write_bytes(b"SQLite format 3\0" + bytes(4096))
    yield folder / "text.db3", "text.db3"
    missing = shutil.copytree(bags / "walk_mcap", folder / "missing")
    next(missing.glob("*.mcap")).unlink()
    yield missing, "is named in metadata.yaml, and missing"


def test_bags_that_mean_no_good_are_refused_in_a_line_that_names_the_file(service, bags, tmp_path):
    for bag, words in hostile(tmp_path, bags):
        found = sent(service, bag)
        assert (found["state"], found["error"]["code"]) == ("invalid", "input"), found
        assert words in found["error"]["cause"]
        assert found["error"]["hint"]
        assert str(service.data) not in json.dumps(found)
