"""The whole API under requests that a machine makes up from its description: no server error, problems as promised.

LVBA_FUZZ_EXAMPLES: requests of each operation (here few; the long run in docs/evidence.md takes 200).
"""

import os

import hypothesis
import pytest
import schemathesis

from service.problems import KINDS

schemathesis.serializer.alias("application/x-ndjson", "application/octet-stream")
EXAMPLES = int(os.environ.get("LVBA_FUZZ_EXAMPLES", "5"))


@pytest.fixture(scope="module")
def operations(service):
    schema = schemathesis.openapi.from_url(f"{service.url}/openapi.json")
    return {
        f"{found.ok().method.upper()} {found.ok().path}": found.ok() for found in schema.get_all_operations()
    }


def test_no_request_brings_the_server_down(operations):
    assert len(operations) > 40
    streams = {"GET /v1/events"}  # without an end by design
    failures = [failure for name in operations.keys() - streams if (failure := failure_of(operations[name]))]
    assert failures == []


def failure_of(operation):
    """What went wrong with the simplest request of this operation with which something did, or None."""

    @hypothesis.given(case=operation.as_strategy())
    @hypothesis.settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    def ask(case):
        check(case, case.call(timeout=60))

    try:
        ask()
    except Exception as error:
        return f"{operation.label}: {error!r}"
    return None


def check(case, answer):
    assert answer.status_code < 500, (case, answer.text)
    if answer.status_code >= 400 and case.method != "HEAD":
        assert answer.headers["content-type"][0] == "application/problem+json", answer.text
        problem = answer.json()
        assert problem["status"] == answer.status_code
        assert problem["code"] in KINDS
        assert problem["detail"]
        assert problem["hint"]
