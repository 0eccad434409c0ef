"""Which software makes a result: named in its manifest and report, and part of every step's key."""

import hashlib
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

_PACKAGES = ("lvba", "numpy", "scipy", "numba", "opencv-python-headless", "zarr")
_DECIDES_NOTHING = ("simulate",)


@cache
def versions() -> dict[str, str]:
    """Versions of Python, this package and what it computes with."""
    versions_by_name = {"python": platform.python_version(), "source": source_digest()[:16]}
    for name in _PACKAGES:
        try:
            versions_by_name[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions_by_name[name] = "not installed"
    return versions_by_name


@cache
def source_digest() -> str:
    """sha256 over the method's source: other code never reuses what this code made."""
    import lvba

    root = Path(lvba.__file__).parent
    total = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _DECIDES_NOTHING:
            total.update(f"{name.as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return total.hexdigest()


def key_version() -> str:
    """What goes into the key of every step."""
    import numba
    import numpy
    import scipy

    return " ".join([source_digest(), numpy.__version__, scipy.__version__, numba.__version__])
