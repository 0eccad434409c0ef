"""docs/settings.md: every setting of a run, from the dataclasses that hold them.

python -m lvba.settings_reference > docs/settings.md
"""

import sys
from collections.abc import Iterable

import yaml

from lvba import settings
from lvba.pipeline import Config
from lvba.settings import Setting

_HEAD = """\
# Settings of a run

*Reference.* Every setting of a run, with meaning, unit and range.

Every setting has a default that is meant for all recordings. Set one by `--set visual.levels=3`, by a file for
`--config`, in the `config` of a job, or in Python:

    from lvba.visual.config import VisualConfig
    lvba.refine(dataset, lvba.Config(visual=VisualConfig(levels=3)))

A result's `config.yaml` holds all of them with their values, and can be given as `--config`. Everything else that the
method could be tuned by is a constant beside the code that uses it, with its reason.

This page is made by `python -m lvba.settings_reference`.
"""
_BASIC = """
## Basic

What a recording or a wish may call for.
"""
_ADVANCED = """
## Advanced

Nobody needs these for a first result. Change one at a time, and compare the scores in the reports.
"""


def text() -> str:
    """The page, Markdown."""
    every = list(settings.every(Config))
    basic = [each for each in every if not each.about.advanced]
    advanced = [each for each in every if each.about.advanced]
    return f"{_HEAD}{_BASIC}{_groups(basic)}{_ADVANCED}{_groups(advanced)}"


def _groups(every: list[Setting]) -> str:
    groups: dict[str, list[Setting]] = {}
    for each in every:
        groups.setdefault(each.name.partition(".")[0] if "." in each.name else "", []).append(each)
    kinds = {group: settings.summary(type(getattr(Config(), group))) for group in groups if group}
    return "".join(
        (f"\n### {group}\n\n{kinds[group]}\n\n" if group else "\n") + _table(members)
        for group, members in groups.items()
    )


def _table(every: Iterable[Setting]) -> str:
    head = "| setting | default | unit | allowed | meaning | change it when |\n| --- | --- | --- | --- | --- | --- |\n"
    return head + "".join(f"| {' | '.join(_cells(each))} |\n" for each in every)


def _cells(each: Setting) -> tuple[str, ...]:
    known = each.about
    allowed = known.allowed or each.type_words
    return f"`{each.name}`", f"`{_shown(each)}`", known.unit, allowed, known.meaning, known.change_when


def _shown(each: Setting) -> str:
    value = each.default
    return yaml.safe_dump(list(value) if isinstance(value, tuple) else value, default_flow_style=True).split(
        "\n"
    )[0]


if __name__ == "__main__":
    sys.stdout.write(text())
