"""Settings as they are sent to a server: what is not as by default."""

import argparse
from typing import Any

from lvba import config
from lvba.pipeline import Config
from service.cli import settings_files


def of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What --config and --set change.

    Raises InputError: a file that cannot be read, a setting that does not exist or has a wrong value.
    """
    return changed(settings_files.load(arguments))


def changed(wanted: Config) -> dict[str, Any]:
    """What of the settings is not as by default."""
    return _difference(config.to_dict(wanted), config.to_dict(Config()))


def _difference(values: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    difference: dict[str, Any] = {}
    for name, value in values.items():
        inner = _difference(value, defaults[name]) if isinstance(value, dict) else value
        if inner != defaults[name] and inner != {}:
            difference[name] = inner
    return difference
