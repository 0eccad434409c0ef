"""Settings from --config and --set."""

import argparse

from lvba import config
from lvba.io import files
from lvba.pipeline import Config


def load(arguments: argparse.Namespace) -> Config:
    """The config that the command line asks for.

    Raises InputError: a file that cannot be read, a setting that does not exist or has a wrong value.
    """
    text = files.read_text(arguments.config) if arguments.config else ""
    return config.load(Config, text, arguments.set, where=str(arguments.config or "config"))
