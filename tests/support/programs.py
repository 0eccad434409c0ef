"""Programs of the system that tests need."""

import os
import shutil

import pytest


def program_or_skip(*names, package=None):
    """Path of the first of these programs that is there; skips where none is, and says what to install."""
    path = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
    found = next((found for name in names if (found := shutil.which(name, path=path))), None)
    if found is None:
        pytest.skip(f"{names[0]} is not installed: apt-get install {package or names[0]}")
    return found
