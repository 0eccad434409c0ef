"""Stages, progress and time left, from what a run tells; options from its dataclasses; rates."""

import dataclasses
import itertools

import pytest
from fastapi import FastAPI

from lvba import config
from lvba.pipeline import Config
from service.api import options_schema, rate_limits
from service.api.routes import jobs
from service.db.leases import Lease
from service.db.tables import Job
from service.jobs.job_run import JobRun
from service.jobs.timeline import Timeline, time_fractions
from service.problems import Problem
from service.system.paths import Paths


def run_of(*lines, weights=None, estimate=100.0):
    """A timeline after (second, line) pairs, and the events that came of them."""
    timeline, told = Timeline(weights or {}, estimate, 0.0), []
    for now, line in lines:
        told += timeline.take(line, now)
    return timeline, told


NAMES = {"event": "stages", "names": ["input", "lidar", "map", "write"]}


def begin(name, reused=False):
    return {"event": "stage", "name": name, "index": 0, "total": 4, "reused": reused}


def count(stage, done, total, what="points"):
    return {"event": "progress", "stage": stage, "what": what, "done": done, "total": total}


def test_an_import_is_the_first_stage_before_the_others_are_known():
    first = {"event": "stages", "names": ["import", "input"]}
    record = {"event": "record", "name": "import", "seconds": 4.0, "peak_memory_mb": 90.0, "reused": False}
    timeline, _ = run_of(
        (0.0, first), (0.0, begin("import")), (0.0, count("import", 0, 2)), (2.0, count("import", 1, 2))
    )
    assert [stage["state"] for stage in timeline.stages] == ["running", "waiting"]
    assert timeline.stages[0]["eta_s"] == 2.0
    assert timeline.fraction() < 0.1, "most of the work is not named yet"
    for now, line in (
        (4.0, record),
        (4.0, begin("input")),
        (5.0, {**NAMES, "names": ["import", *NAMES["names"]]}),
    ):
        told = timeline.take(line, now)
    assert told[-1] == ("stages", {"stages": ["import", "input", "lidar", "map", "write"]})
    assert [stage["state"] for stage in timeline.stages] == ["done", "done", "waiting", "waiting", "waiting"]
    assert (timeline.stages[0]["seconds"], timeline.stages[0]["peak_memory_mb"]) == (4.0, 90.0)
    assert timeline.fraction() == 0.4


def test_time_left_in_an_import_counts_the_stages_after_it():
    weights = {"import": 0.2, "input": 0.1, "lidar": 0.7}
    first = {"event": "stages", "names": ["import", "input"]}
    lines = ((0.0, first), (0.0, begin("import")), (10.0, count("import", 1, 1)))
    timeline, _ = run_of(*lines, weights=weights, estimate=100.0)
    # 0.82 of the work is left, of which a count at its end leaves a tenth: the estimate and the pace, weighed by it
    assert timeline.eta_s(10.0) == pytest.approx(0.82 * (0.82 * 100.0 + 10.0), abs=0.1)


def test_stages_are_those_that_the_run_names():
    timeline, told = run_of((1.0, NAMES), (1.0, begin("lidar")), (4.0, begin("map")))
    assert [(stage["name"], stage["state"]) for stage in timeline.stages] == [
        ("input", "done"), ("lidar", "done"), ("map", "running"), ("write", "waiting"),
    ]  # fmt: skip
    assert timeline.stages[1]["seconds"] == 3.0
    assert [(kind, data.get("name"), data.get("state")) for kind, data in told] == [
        ("stages", None, None), ("stage", "lidar", "running"), ("stage", "lidar", "done"),
        ("stage", "map", "running"),
    ]  # fmt: skip


def test_progress_never_goes_back_and_ends_at_one():
    lines = [NAMES, begin("lidar"), count("lidar", 1, 4), count("lidar", 4, 4), count("lidar", 0, 9, "more"),
             begin("map"), begin("write"), {"event": "end", "code": 0, "message": ""}]  # fmt: skip
    timeline, seen = Timeline({}, 0.0, 0.0), []
    for now, line in enumerate(lines):
        timeline.take(line, float(now))
        seen.append(timeline.fraction())
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_time_left_comes_from_the_shares_of_earlier_runs():
    weights = time_fractions([[{"name": "lidar", "seconds": 30.0}, {"name": "map", "seconds": 10.0}]] * 2) | {
        "input": 0.0,
        "write": 0.0,
    }
    timeline, _ = run_of(
        (0.0, NAMES), (0.0, begin("lidar")), (30.0, begin("map")), weights=weights, estimate=40.0
    )
    assert timeline.eta_s(30.0) == pytest.approx(10.0)


def test_before_a_run_says_anything_time_left_is_the_estimate():
    timeline, _ = run_of(weights={"lidar": 1.0})
    assert timeline.eta_s(40.0) == 60.0
    assert timeline.eta_s(140.0) == 0.0


def test_no_time_left_is_told_where_no_run_was_finished():
    """Equal shares of stages and counts of files told 15 s, and a stage later 101 s."""
    timeline, _ = run_of((0.0, NAMES), (0.0, begin("lidar")), (30.0, begin("map")))
    assert timeline.eta_s(30.0) is None


def test_time_left_does_not_jump_where_a_run_is_slower_than_those_before():
    """A run that takes three times the estimate: what is told rises slowly and ends at nothing."""
    weights = {"input": 0.0, "lidar": 0.5, "map": 0.4, "write": 0.1}
    timeline, seen = Timeline(weights, 100.0, 0.0), []
    timeline.take(NAMES, 0.0)
    for second in range(300):
        if second in (0, 150, 270):
            timeline.take(begin({0: "lidar", 150: "map", 270: "write"}[second]), float(second))
        if second < 150:
            timeline.take(count("lidar", second, 150), float(second))
        seen.append(timeline.eta_s(float(second)))
    assert seen[0] == 100.0
    # passing from one stage to the next it may change by what that stage was off, not more
    assert max(after - before for before, after in itertools.pairwise(seen)) < 15.0
    assert max(seen) < 130.0
    assert seen[-1] < 15.0


def test_time_left_falls_while_a_stage_counts_nothing():
    weights = {"input": 0.0, "lidar": 0.9, "map": 0.1, "write": 0.0}
    timeline, _ = run_of((0.0, NAMES), (0.0, begin("lidar")), weights=weights)
    left = [timeline.eta_s(now) for now in (0.0, 20.0, 40.0, 60.0)]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 60.0


def test_reused_stages_do_not_make_the_rest_look_short():
    timeline, _ = run_of(
        *((0.0, NAMES), (0.0, begin("lidar", reused=True)), (0.1, begin("map")), (10.1, count("map", 1, 2))),
        weights={"lidar": 0.5, "map": 0.4, "write": 0.1},
    )
    assert timeline.eta_s(10.1) > 5.0


def test_stage_that_runs_at_a_failure_has_failed():
    timeline, told = run_of(
        (0.0, NAMES), (0.0, begin("lidar")), (2.0, {"event": "end", "code": 1, "message": "x"})
    )
    assert timeline.stages[1]["state"] == "failed"
    assert told[-1][1]["state"] == "failed"
    assert timeline.end.message == "x"


@pytest.mark.parametrize("told", [True, False], ids=["it said so", "it was killed"])
def test_stage_that_runs_when_a_job_is_canceled_has_not_failed(told):
    timeline, _ = run_of((0.0, NAMES), (0.0, begin("lidar")))
    if told:
        timeline.take({"event": "end", "code": 1, "reason": "stopped", "message": "x"}, 2.0)
        assert timeline.stages[1]["state"] == "stopped"
    timeline.stop(3.0)
    assert [stage["state"] for stage in timeline.stages] == ["done", "stopped", "waiting", "waiting"]


@pytest.mark.parametrize(
    ("line", "state"),
    [
        ({"code": 1, "reason": "failed", "message": "stopped by too few planes"}, "failed"),
        ({"code": 1, "reason": "stopped", "message": "interrupted"}, "stopped"),
        ({"code": 130, "message": "stopped; finished stages are kept"}, "stopped"),  # of earlier versions
        ({"code": 1, "message": "x"}, "failed"),
        ({"code": 1, "reason": "of a later version", "message": "x"}, "failed"),
    ],
)
def test_state_of_the_stage_at_the_end_comes_from_the_reason_and_never_from_the_sentence(line, state):
    timeline, _ = run_of((0.0, NAMES), (0.0, begin("lidar")), (1.0, {"event": "end", **line}))
    assert timeline.stages[1]["state"] == state


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ({"code": 1, "reason": "out-of-memory", "message": "no room in memory"}, "out-of-memory"),
        (
            {"code": 2, "reason": "out-of-memory", "message": "a", "problem": "b", "mend": "c"},
            "out-of-memory",
        ),
        ({"code": 1, "reason": "failed", "message": "out of memory of the LiDAR's clock"}, "failed"),
        ({"code": 2, "reason": "input", "message": "a", "where": "a", "problem": "b", "mend": "c"}, "input"),
    ],
)
def test_error_of_a_job_comes_from_the_reason_and_never_from_the_sentence(tmp_path, line, code):
    run = JobRun.__new__(JobRun)
    run.lease, run._paths, run._recording = Lease(Job, "job_1", "me", 1), Paths(tmp_path), tmp_path
    run._timeline = run_of((0.0, NAMES), (0.0, begin("lidar")), (1.0, {"event": "end", **line}))[0]
    error = run._failure(line["message"])
    assert (error["code"], error["stage"]) == (code, "lidar")


@pytest.mark.parametrize("problem", ["no space left on device", "pas d'espace disponible"])
def test_full_disk_is_told_by_the_reason_in_every_language(tmp_path, problem):
    run = JobRun.__new__(JobRun)
    run._paths = Paths(tmp_path)
    for reason in ("disk-full", "input"):
        line = {"event": "end", "code": 2, "reason": reason, "message": problem, "problem": problem}
        run._timeline = run_of((0.0, NAMES), (1.0, line))[0]
        assert run._disk_is_full(2) == (reason == "disk-full")


def test_options_have_every_setting_with_default_and_help():
    described = options_schema.describe()
    flat = {option["name"]: option for option in described["options"]}
    assert list(flat) == config.names(Config)
    assert all(option["help"] for option in flat.values())
    plain = config.to_dict(Config())
    for name, option in flat.items():
        value = plain
        for part in name.split("."):
            value = value[part]
        assert option["default"] == value
    assert described["defaults"] == plain


def test_schema_takes_what_the_dataclasses_take():
    jsonschema = pytest.importorskip("jsonschema")
    described = options_schema.describe()
    validator = jsonschema.Draft202012Validator(described["schema"])
    jsonschema.Draft202012Validator.check_schema(described["schema"])
    validator.validate(described["defaults"])
    assert not validator.is_valid({"visual": {"levls": 2}})
    assert not validator.is_valid({"refine_scans": "yes"})
    assert {item.name for item in dataclasses.fields(Config)} == set(described["schema"]["properties"])


def outside(option):
    """Values on either side of what a setting takes."""
    step = 1 if "integer" in option["type"] else 1e-3
    if "minimum" in option:
        yield option["minimum"] - step
    if "maximum" in option:
        yield option["maximum"] + step * max(1, abs(option["maximum"]))


def test_limits_of_the_schema_are_those_that_are_kept():
    limited = [option for option in options_schema.describe()["options"] if list(outside(option))]
    for option in limited:
        for value in outside(option):
            nested = value
            for part in reversed(option["name"].split(".")):
                nested = {part: nested}
            with pytest.raises(config.SettingError) as refused:
                config.from_mapping(Config, nested)
            assert refused.value.setting == option["name"]


def test_schema_of_requests_holds_the_same_settings_as_the_options():
    application = FastAPI()
    application.include_router(jobs.router)
    schemas = application.openapi()["components"]["schemas"]
    names, texts = [], {}

    def walk(schema, prefix):
        for name, one in schema["properties"].items():
            inner = schemas[one["$ref"].rsplit("/", 1)[1]] if "$ref" in one else one
            if "properties" in inner:
                walk(inner, f"{prefix}{name}.")
            else:
                names.append(prefix + name)
                texts[prefix + name] = " ".join(one["description"].split())

    walk(schemas[schemas["NewJob"]["properties"]["config"]["$ref"].rsplit("/", 1)[1]], "")
    options = options_schema.describe()["options"]
    assert names == [option["name"] for option in options] == config.names(Config)
    assert texts == {option["name"]: option["help"] for option in options}


def test_bucket_is_emptied_by_requests_and_fills_again():
    bucket = rate_limits.Rates()
    for _ in range(5):
        bucket.take("key", 0.001, 5)
    with pytest.raises(Problem) as refused:
        bucket.take("key", 0.001, 5)
    assert (refused.value.code, refused.value.headers["Retry-After"]) == ("too-many-requests", "1000")
    bucket.take("other", 0.001, 5)
