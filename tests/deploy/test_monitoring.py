"""Prometheus' rules and Grafana's panels ask for figures that a live service has, with labels that they have."""

import json
import re

import promql_parser
import pytest
import yaml
from deployed import DEPLOY, compose
from prometheus_client.parser import text_string_to_metric_families

from service.db.tables import JOB_STATES

FOLDER = DEPLOY / "monitoring"
OF_PROMETHEUS = {"up": {"job", "instance"}}
"""What Prometheus itself adds."""


def rules():
    return yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"][0]["rules"]


def dashboard():
    return json.loads((FOLDER / "dashboard.json").read_text())


def expressions():
    """Where -> PromQL; what Grafana fills in is a time like any other."""
    found = {rule["alert"]: rule["expr"] for rule in rules()}
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            expression = target["expr"].replace("$__rate_interval", "5m")
            found[f"panel {panel['id']} {target['refId']}"] = expression
    return found


@pytest.fixture(scope="module")
def figures(service):
    """Name of each sample that a live service exports -> names of its labels, and values seen."""
    service.http.post("/v1/datasets", json={"name": "for a figure"}).raise_for_status()
    found = {}
    for family in text_string_to_metric_families(service.http.get("/metrics").raise_for_status().text):
        for sample in family.samples:
            labels = found.setdefault(sample.name, {})
            for name, value in sample.labels.items():
                labels.setdefault(name, set()).add(value)
    return found


def selectors(expression):
    """Every selector of an expression: (name, {label: (operator, value)})."""
    # as the parser writes it again: one form for everything
    plain = promql_parser.parse(expression).prettify()
    without_texts = re.sub(r'"[^"]*"', '""', plain)
    names = set(re.findall(r"\b(?:lvba_\w+|up)\b", without_texts))
    for name in names:
        matched = re.search(rf"\b{name}\{{([^}}]*)\}}", plain)
        pairs = re.findall(r'(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"', matched[1] if matched else "")
        yield name, {label: (operator, value) for label, operator, value in pairs}


def grouped(expression):
    """Labels that an expression groups by."""
    return {
        label.strip()
        for group in re.findall(r"\bby\s*\(([^)]*)\)", expression)
        for label in group.split(",")
        if label.strip()
    }


@pytest.mark.parametrize("where", expressions())
def test_expression_asks_for_what_the_service_exports(figures, where):
    expression = expressions()[where]
    found = list(selectors(expression))
    assert found
    for name, labels in found:
        assert name in figures or name in OF_PROMETHEUS, name
        there = set(figures.get(name, {})) | OF_PROMETHEUS.get(name, set())
        assert set(labels) <= there, (name, set(labels) - there)
        assert grouped(expression) <= there, (name, grouped(expression) - there)
        if name == "lvba_jobs" and "state" in labels:
            operator, value = labels["state"]
            assert set(value.split("|")) <= set(JOB_STATES), value
            assert operator in ("=~", "!~") or "|" not in value


def test_every_figure_is_shown_or_watched(figures):
    ours = {name for name in figures if name.startswith("lvba_") and not name.endswith("_created")}
    asked = {name for expression in expressions().values() for name, _ in selectors(expression)}
    assert ours <= asked, ours - asked


def test_mistakes_in_expressions_are_found(figures):
    with pytest.raises(ValueError):
        promql_parser.parse("sum by (state) (lvba_jobs")
    assert dict(selectors('lvba_jobbs{state="queued"} > 1')) == {"lvba_jobbs": {"state": ("=", "queued")}}
    assert "lvba_jobbs" not in figures


def test_alerts_say_what_is_wrong_and_what_to_do():
    for rule in rules():
        assert set(rule) - {"for"} == {"alert", "expr", "labels", "annotations"}
        assert rule["labels"]["severity"] in ("info", "warning", "critical")
        assert set(rule["annotations"]) == {"summary", "description"}
    assert len({rule["alert"] for rule in rules()}) == len(rules())


def test_prometheus_asks_the_service_itself_on_a_network_that_it_can_join():
    configuration = yaml.safe_load((FOLDER / "prometheus.yml").read_text())
    assert [(FOLDER / name).is_file() for name in configuration["rule_files"]] == [True]
    [scrape] = configuration["scrape_configs"]
    [target] = scrape["static_configs"][0]["targets"]
    name, _, port = target.partition(":")
    service = compose()["services"][name]
    assert service["environment"]["LVBA_PORT"] == port
    assert "web" in service["networks"]
    assert scrape["job_name"] == re.search('up{job="([a-z]+)"}', str(rules()))[1]
    assert "credentials_file" in scrape["authorization"]


def test_panels_have_places_of_their_own():
    panels = dashboard()["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken = [(x, y) for panel in panels for x, y in cells(panel["gridPos"])]
    assert len(set(taken)) == len(taken)
    assert max(x for x, _ in taken) == 23
    for panel in panels:
        assert panel["datasource"]["uid"] == "${datasource}"
        legends = {label for t in panel["targets"] for label in re.findall(r"{{(\w+)}}", t["legendFormat"])}
        assert legends <= {"instance"}.union(*(grouped(t["expr"]) for t in panel["targets"]))


def cells(place):
    return [(place["x"] + dx, place["y"] + dy) for dx in range(place["w"]) for dy in range(place["h"])]
