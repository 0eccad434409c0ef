"""Programs of the system that tests need."""

import os
import shutil

import pytest


def program_or_skip(name, package=None):
    """Path of a program; skips where it is missing, and says what to install."""
    found = shutil.which(name, path=os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"]))
    if found is None:
        pytest.skip(f"{name} is not installed: apt-get install {package or name}")
    return found
