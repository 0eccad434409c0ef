"""What docs say of the interface and the settings of the server is what the code has."""

import re
from pathlib import Path

from service import problems
from service.api.routes import about, batches, datasets, job_files, jobs, ogc, uploads
from service.db import journal
from service.db.tables import JOB_STATES

DOCS = Path(__file__).resolve().parents[3] / "docs"
WORDS = (DOCS / "rest.md").read_text()


def test_every_path_is_described():
    modules = (about, batches, datasets, job_files, jobs, ogc, uploads)
    paths = {route.path for module in modules for route in module.router.routes}
    plain = {re.sub(r"\{\w*(?:_id)\}", "{id}", path).replace(":path}", "}") for path in paths}
    short = {"/processes/{id}": "/processes/lvba", "/processes/{id}/execution": "/processes/lvba/execution"}
    assert sorted(path for path in plain if short.get(path, path) not in WORDS) == []


def test_every_event_state_and_problem_is_described():
    named = {*journal.KINDS, *JOB_STATES, *problems.KINDS}
    assert sorted(name for name in named if f"`{name}`" not in WORDS) == []


def test_options_of_the_command_line_that_operations_name_exist():
    from service.cli.main import parser

    named = set(re.findall(r"lvba serve[^\n|]*?(--[a-z-]+)", (DOCS / "operations.md").read_text()))
    assert named
    for option in named:
        words = ["serve", option, "1"] if option not in ("--auth", "--webhooks") else ["serve", option]
        parser().parse_args(words)


def test_reference_of_settings_is_what_the_server_reads():
    from service.cli import settings_reference

    mend = "python -m service.cli.settings_reference > docs/server_settings.md"
    assert (DOCS / "server_settings.md").read_text() == settings_reference.text(), mend
    assert "`LVBA_HOSTS` | `--host-name` |" in settings_reference.text()
