"""docs/cli.md: every command with its arguments, from the parser of the command line.

python -m service.cli.reference > docs/cli.md
"""

import argparse
import sys
import textwrap
from collections.abc import Iterator

from service.cli import main

_HEAD = """\
# Command line

*Reference.* Every command of `lvba` with its arguments. Exit codes: 0 done; 2 bad input or usage, with one line on
stderr; 130 Ctrl-C; 1 anything else.

This page is made by `python -m service.cli.reference`.
"""
_COMMON = ("help", "threads", "quiet", "verbose")


def text() -> str:
    """The page, Markdown."""
    pages = "".join(_page(name, command) for name, command in _commands(main.parser()))
    return f"{_HEAD}\n## In every command\n\n{_common()}{pages}"


def _commands(
    parser: argparse.ArgumentParser, above: str = "lvba"
) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Commands without subcommands of their own, by their full name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                inner = list(_commands(command, f"{above} {name}"))
                yield from inner or [(f"{above} {name}", command)]


def _common() -> str:
    _, command = next(_commands(main.parser()))
    return _table(action for action in command._actions if action.dest in _COMMON)


def _page(name: str, command: argparse.ArgumentParser) -> str:
    description = (command.description or "").strip()
    arguments = [action for action in command._actions if action.dest not in _COMMON]
    examples = (command.epilog or "").partition("examples:\n")[2].partition("\n\n")[0]
    parts = [
        f"\n## {name}\n",
        description,
        _table(arguments).strip(),
        textwrap.indent(textwrap.dedent(examples).strip(), "    "),
    ]
    return "\n\n".join(part.strip("\n") for part in parts if part).join(("\n", "\n"))


def _table(actions: Iterator[argparse.Action] | list[argparse.Action]) -> str:
    rows = [f"| {_names(action)} | {_meaning(action)} |" for action in actions]
    return "\n".join(["| argument | meaning |", "| --- | --- |", *rows]) + "\n" if rows else ""


def _names(action: argparse.Action) -> str:
    words = [action.metavar] if isinstance(action.metavar, str) else list(action.metavar or ())
    value = "" if action.nargs == 0 else " ".join(words) or ",".join(map(str, action.choices or ()))
    value = value.replace("|", "\\|")  # else it ends the cell, in code, too
    if not action.option_strings:
        return f"`{value or action.dest}`"
    return ", ".join(f"`{f'{option} {value}'.strip()}`" for option in action.option_strings)


def _meaning(action: argparse.Action) -> str:
    required = "; required" if action.required and action.option_strings else ""
    return f"{(action.help or '').replace('|', ' or ')}{required}"


if __name__ == "__main__":
    sys.stdout.write(text())
