"""A recording is looked at by its names and small texts before it is uploaded, by the server and by the client."""

import json
import shutil

import pytest


def listed(recording, but=(), texts=True):
    """The lines that say what a recording has, as the page sends them."""
    lines = []
    for path in sorted(recording.rglob("*")):
        name = path.relative_to(recording).as_posix()
        if path.is_file() and name not in but:
            text = {"text": path.read_text()} if texts and path.suffix in (".txt", ".yaml") else {}
            lines.append(json.dumps({"path": name, **text}))
    return "\n".join(lines)


def check(service, body, **query):
    return service.http.post("/v1/checks", content=body, params=query)


def test_a_good_recording_has_nothing_wrong(service, tiny_recording):
    assert check(service, listed(tiny_recording)).json() == {"error": None}


def test_what_is_wrong_is_told_with_its_place_and_the_mend(service, tiny_recording):
    poses = "all_pcd_body/lidar_poses.txt"
    assert (tiny_recording / poses).exists()
    error = check(service, listed(tiny_recording, but=[poses])).json()["error"]
    assert error["cause"].startswith("DATASET/all_pcd_body/lidar_poses.txt: no poses")
    assert error["hint"].startswith("write one pose a line")
    assert error["path"] == "all_pcd_body/lidar_poses.txt"
    part = "\n".join(json.dumps({"path": f"{n}.5.pcd"}) for n in range(3))
    told = check(service, part, name="all_pcd_body").json()["error"]
    assert "is a part of a recording" in told["cause"]
    assert "/tmp" not in json.dumps(told)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('{"path": "../../etc/passwd"}', ".."),
        ('{"path": "/etc/passwd"}', "passwd"),
        ('{"path": "a"}\n{"path": "a/b"}', "as a file and as a folder"),
        ("[1, 2]", "has an invalid line"),
        ("\xff\x00", "has an invalid line"),
        ("", "DATASET"),
    ],
)
def test_lists_that_mean_no_good_are_refused_in_words(service, body, words):
    assert words in check(service, body).json()["error"]["cause"]


def test_a_list_beyond_the_limit_is_not_read(service):
    answer = check(service, b"x" * ((16 << 20) + 1))
    assert (answer.status_code, answer.json()["code"]) == (413, "too-large")


def test_the_client_sends_nothing_of_a_wrong_folder(service, lvba, tiny_recording, tmp_path):
    wrong = shutil.copytree(tiny_recording, tmp_path / "wrong")
    (wrong / "all_pcd_body").rename(wrong / "scans")
    before = len(service.http.get("/v1/datasets").json()["items"])
    done = lvba("submit", wrong, "--server", service.url, code=2)
    assert done.stderr.splitlines()[-1].endswith("put <seconds>.pcd and lidar_poses.txt there")
    assert len(service.http.get("/v1/datasets").json()["items"]) == before
