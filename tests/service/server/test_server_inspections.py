"""A bag is looked at before it is uploaded: by pieces of it, as the page sends them, and by the client itself."""

import http.client
import json
import shutil

import pytest


def look(service, files, **query):
    """files: (name, content, pieces of it that are sent) of each"""
    head = {
        "files": [{"path": name, "size": len(content), "pieces": pieces} for name, content, pieces in files]
    }
    body = b"".join(content[begin:end] for _, content, pieces in files for begin, end in pieces)
    return service.http.post(
        "/v1/inspections", content=json.dumps(head).encode() + b"\n" + body, params=query
    )


def test_a_bag_is_told_by_the_pieces_that_the_server_asks_for(service, bags):
    content = (bags / "walk.bag").read_bytes()
    pieces = [(0, 100_000), (len(content) - 3000, len(content))]
    seen, asked = look(service, [("walk.bag", content, pieces)]).raise_for_status().json(), 0
    while seen["needs"]:
        assert (seen["inspection"], seen["error"]) == (None, None)
        pieces += [(need["begin"], need["end"]) for need in seen["needs"]]
        seen, asked = look(service, [("walk.bag", content, pieces)]).raise_for_status().json(), asked + 1
    assert 0 < asked < 5
    assert seen["later"] == ""
    assert seen["inspection"]["choice"]["lidar"] == "/lidar/points"
    assert seen["inspection"]["missing"] == []
    assert (seen["inspection"]["format"], seen["inspection"]["file"]) == ("ROS 1 bag", "walk.bag")


def test_a_bag_of_tables_is_told_by_its_metadata_and_later_without_them(service, bags):
    files = [(file.name, file.read_bytes()) for file in sorted((bags / "walk_sqlite3").iterdir())]
    metadata, database = ((name, content, [(0, 4096)]) for name, content in files)
    seen = look(service, [database, (*metadata[:2], [(0, len(metadata[1]))])]).raise_for_status().json()
    assert seen["inspection"]["choice"]["image"] == "/camera/image"
    assert "by metadata.yaml alone" in seen["inspection"]["notes"][-1]
    seen = look(service, [database]).raise_for_status().json()
    assert (seen["inspection"], seen["needs"]) == (None, [])
    assert "when all of it has arrived" in seen["later"]


def test_a_missing_part_is_told_before_anything_is_sent(service, bags):
    file = bags / "walk_mcap" / "metadata.yaml"
    line = json.dumps({"path": "metadata.yaml", "text": file.read_text()})
    error = service.http.post("/v1/checks", content=line).json()["error"]
    assert "is named in metadata.yaml, and missing" in error["cause"]
    whole = line + "\n" + json.dumps({"path": next((bags / "walk_mcap").glob("*.mcap")).name})
    assert service.http.post("/v1/checks", content=whole).json()["error"] is None


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"\xff\xff\n", "the list of files: is invalid"),
        (b'{"files": [{"path": "a.bag", "size": 10, "pieces": [[5, 20]]}]}\n', "is invalid"),
        (b'{"files": [{"path": "a.bag", "size": 99999999999999999, "pieces": []}]}\n', "is invalid"),
        (b'{"files": [{"path": "../a.bag", "size": 1, "pieces": []}]}\n', "plain relative path"),
        (
            b'{"files": [{"path": "a.bag", "size": 9, "pieces": [[0, 9]]}]}\nno bag at ',
            "a.bag: is no ROS 1 bag",
        ),
        (b'{"files": [{"path": "a.mcap", "size": 0, "pieces": []}]}\n', "a.mcap"),
    ],
)
def test_pieces_that_mean_no_good_are_refused_in_words(service, body, words):
    answer = service.http.post("/v1/inspections", content=body).raise_for_status().json()
    assert answer["inspection"] is None
    assert words in answer["error"]["cause"]
    assert "/tmp" not in json.dumps(answer)


def test_more_than_the_limit_is_refused_before_it_is_sent(service):
    connection = http.client.HTTPConnection(service.url.removeprefix("http://"), timeout=60)
    connection.putrequest("POST", "/v1/inspections")
    connection.putheader("Content-Length", str(1 << 30))
    connection.endheaders()
    answer = connection.getresponse()
    assert (answer.status, json.loads(answer.read())["code"]) == (413, "too-large")
    connection.close()


def test_clients_that_send_slowly_keep_none_from_being_looked_at(service, bags):
    """As many as are looked at at a time, and more."""
    slow = []
    for _ in range(3):
        connection = http.client.HTTPConnection(service.url.removeprefix("http://"), timeout=60)
        connection.putrequest("POST", "/v1/inspections")
        connection.putheader("Content-Length", "1000")
        connection.endheaders()
        connection.send(b'{"files": [')
        slow.append(connection)
    content = (bags / "walk_mcap" / "metadata.yaml").read_bytes()
    answer = look(service, [("metadata.yaml", content, [(0, len(content))])])
    for connection in slow:
        connection.close()
    assert answer.status_code == 200


def datasets(service):
    return len(service.http.get("/v1/datasets?limit=500").json()["items"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--lidar", "/nothing"], "/lidar/points"),
        (["--odometry", "run {bag} {out}"], "a server runs no commands"),
        (["--calibration", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
    ],
)
def test_the_client_sends_nothing_of_a_bag_with_a_wrong_choice(service, lvba, bags, options, words):
    before = datasets(service)
    done = lvba("submit", bags / "walk.bag", "--server", service.url, *options, code=2)
    assert words in done.stderr.splitlines()[-1]
    assert datasets(service) == before


def test_the_client_looks_at_a_bag_and_sends_it_with_its_choices(service, lvba, bags, tmp_path):
    bag, camera = shutil.copy(bags / "walk.bag", tmp_path / "yard.bag"), tmp_path / "camera.yaml"
    camera.write_text("cam0: {}\n")
    with service.held("import"):
        words = ["--image", "none", "--calibration", camera, "--every", 2]
        done = lvba("submit", bag, "--server", service.url, *words)
        job = service.http.get(f"/v1/jobs/{done.stdout.strip()}").raise_for_status().json()
        assert job["import"] == {"image": "none", "calibration": ["camera.yaml"], "every": 2}
        service.http.post(f"/v1/jobs/{job['id']}/cancel")
    assert "the stamp is end of the sweep" in done.stderr
    inspection = service.http.get(f"/v1/datasets/{job['dataset']}/inspection").json()
    assert (inspection["file"], inspection["beside"]) == ("yard.bag", ["camera.yaml"])
