"""docs/server_settings.md: every setting of `lvba serve`, from the dataclasses that the server reads.

python -m service.cli.settings_reference > docs/server_settings.md
"""

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict

from service.cli import main
from service.settings import GB, PREFIX, Limits, Settings

_HEAD = """\
# Settings of the server

*Reference.* Every setting of `lvba serve`, with its default.

`lvba serve` takes each setting from its command line, or from the environment; the command line wins. `NAME_FILE` in
place of `NAME` names a file that holds the value: for what should not be in an environment. Lists have commas between
their items. systemd reads them from `/etc/lvba/lvba.env`, Docker Compose from `deploy/.env`; Kubernetes has them in
`deploy/kubernetes/kustomization.yaml`. Where the default is empty, the setting is not set.

This page is made by `python -m service.cli.settings_reference`.
"""
_TABLE = "| environment | option | default | meaning |\n| --- | --- | --- | --- |\n"
_AUTOMATIC = {"False": "no", "True": "yes", "None": "", "()": "", "": ""}


def text() -> str:
    """The page, Markdown."""
    options = _options()
    general, limits = _rows(Settings, PREFIX, options), _rows(Limits, f"{PREFIX}LIMITS_", {})
    return (
        f"{_HEAD}\n## General\n\n{_TABLE}{_lines(general)}\n## Limits\n\n"
        f"What one owner, one request or one archive may take.\n\n{_TABLE}{_lines(limits)}"
    )


def _options() -> dict[str, str]:
    """The option of `lvba serve` that sets a field, by the field's name."""
    commands = next(
        action for action in main.parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    return {action.dest: action.option_strings[-1] for action in commands.choices["serve"]._actions}


class _Described(BaseModel):
    """Has pydantic find the text of each field."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    settings: Settings


def _helps(kind: Any) -> dict[str, str]:
    groups = _Described.model_json_schema()["$defs"]
    return {
        name: " ".join(one["description"].split())
        for name, one in groups[kind.__name__]["properties"].items()
        if "description" in one
    }


def _rows(kind: Any, prefix: str, options: dict[str, str]) -> Iterator[tuple[str, str, str, str]]:
    helps = _helps(kind)
    for field in dataclasses.fields(kind):
        if field.name == "limits":  # have a table of their own
            continue
        default = "" if field.default is dataclasses.MISSING else _shown(field.default)
        yield (
            f"{prefix}{field.name.upper()}",
            options.get(field.name, ""),
            default,
            helps[field.name].replace("None:", "not set:"),
        )


def _shown(default: Any) -> str:
    if isinstance(default, int) and not isinstance(default, bool) and default >= GB and default % GB == 0:
        return f"{default} ({default // GB} GiB)"
    return _AUTOMATIC.get(str(default), str(default))


def _lines(rows: Any) -> str:
    return "".join(
        f"| `{name}` | {f'`{option}`' if option else ''} | {default} | {meaning} |\n"
        for name, option, default, meaning in rows
    )


if __name__ == "__main__":
    sys.stdout.write(text())
