"""The facade of OGC API - Processes, asked by a client that others wrote."""

import json

import pytest
from owslib.ogcapi.processes import Processes
from real_server import ended, until


@pytest.fixture(scope="module")
def client(service):
    return Processes(service.url)


def test_client_finds_the_process_and_what_it_takes(client):
    assert [process["id"] for process in client.processes()] == ["lvba"]
    process = client.process("lvba")
    assert {"dataset", "config", "import", "reference"} == set(process["inputs"])
    assert process["inputs"]["dataset"]["minOccurs"] == 1
    assert "async-execute" in process["jobControlOptions"]
    assert any(uri.endswith("/conf/core") for uri in client.conformance()["conformsTo"])


def test_client_submits_polls_and_fetches(client, service, ready_dataset, done_job):
    accepted = client.execute("lvba", {"dataset": ready_dataset}, response="document", async_=True)
    job_id = accepted["jobID"]
    assert accepted["status"] in ("accepted", "running")
    ended(service.http, job_id)
    status = service.http.get(f"/jobs/{job_id}").json()
    assert (status["status"], status["progress"], status["processID"]) == ("successful", 100, "lvba")
    results = service.http.get(f"/jobs/{job_id}/results").json()
    report = service.http.get(results["report"]["href"]).json()
    assert report["schema"] == 1
    same = service.http.get(f"/v1/jobs/{done_job['id']}/results/map.ply").content
    assert service.http.get(results["map"]["href"]).content == same
    listed = service.http.get("/jobs", params={"status": "successful"}).json()["jobs"]
    assert job_id in [job["jobID"] for job in listed]
    assert service.http.delete(f"/jobs/{job_id}").json()["status"] == "dismissed"
    assert job_id not in [job["jobID"] for job in service.http.get("/jobs").json()["jobs"]]
    assert service.http.get(f"/v1/jobs/{job_id}/results").status_code == 200, "its files stay"


def test_dismissed_before_its_end_it_is_canceled(service, ready_dataset):
    inputs = {"dataset": ready_dataset, "config": {"visual": {"levels": 1}}}
    with service.held("visual"):
        answer = service.http.post("/processes/lvba/execution", json={"inputs": inputs})
        assert answer.status_code == 201
        place = answer.headers["location"]
        not_ready = service.http.get(f"{place}/results")
        kind = not_ready.json()["type"].rsplit("/", 1)[1]
        assert (not_ready.status_code, kind) == (404, "result-not-ready")
        assert service.http.delete(place).json()["status"] == "dismissed"
        until(service.http, place, lambda job: job["status"] == "dismissed")


def test_unknown_process_and_wrong_inputs_are_said_in_its_words(service):
    missing = service.http.get("/processes/none")
    assert (missing.status_code, missing.json()["type"].rsplit("/", 1)[1]) == (404, "no-such-process")
    wrong = service.http.post("/processes/lvba/execution", json={"inputs": {"datset": "x"}})
    assert wrong.status_code == 422
    assert "inputs.dataset" in wrong.json()["detail"]


def test_root_is_a_landing_page_for_programs_and_a_page_for_people(service):
    landing = service.http.get("/", headers={"Accept": "application/json"}).json()
    rels = {link["rel"].rsplit("/", 1)[-1] for link in landing["links"]}
    assert {"self", "service-desc", "service-doc", "conformance", "processes", "job-list"} <= rels
    for link in landing["links"]:
        assert service.http.get(link["href"]).status_code == 200, link
    page = service.http.get("/", headers={"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"})
    assert page.headers["content-type"].startswith("text/html")


def test_documentation_of_the_api_asks_nobody_else(service):
    page = service.http.get("/docs").text
    assert "/v1/jobs/{job_id}/restart" in page
    assert "<script" not in page
    assert "http://" not in page
    assert "https://" not in page
    described = json.loads(service.http.get("/openapi.json").text)
    assert {"/v1/jobs", "/v1/datasets/{dataset_id}/files/{path}", "/processes"} <= set(described["paths"])
