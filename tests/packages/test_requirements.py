"""What pyproject.toml asks for is what the code imports; what is left out is named by the error that misses it."""

import ast
import importlib
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from lvba.errors import InputError
from lvba.io import laz
from service.db import data_folder
from service.settings import load
from service.system.paths import Paths
from workers.url_store import UrlStore

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("lvba", "workers", "service")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NOT_ASKED_FOR = {"pyproj": "docs/export.md says who needs it"}


def plain(name):
    """A distribution's name as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def named(requirements):
    """The distributions of requirement lines, without versions, extras and markers."""
    return {plain(re.match(r"[\w.-]+", line)[0]) for line in requirements}


def asked_for():
    return named(PROJECT["dependencies"])


def offered():
    """What extras bring to those who use lvba; not what its developers need."""
    extras = PROJECT["optional-dependencies"]
    return set().union(
        *(named(extras[name]) for name in ("simulate", "laz", "bags", "odometry", "s3", "postgres"))
    )


def modules(node, late=False):
    """(top-level module, whether only when a function is called) of each import of others' modules below a node."""
    for child in ast.iter_child_nodes(node):
        never = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
        if isinstance(child, ast.Import):
            names = [alias.name for alias in child.names]
        elif isinstance(child, ast.ImportFrom) and not child.level:
            names = [child.module]
        else:
            names = []
        for name in (name.partition(".")[0] for name in names):
            if name not in sys.stdlib_module_names and name not in PACKAGES:
                yield name, late
        if not never:
            yield from modules(child, late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))


def imported(*, late):
    """module: a file that imports it, on being imported itself or later."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    files = (path for path in files if "page_src" not in path.parts)
    return {
        module: path.relative_to(ROOT).as_posix()
        for path in sorted(files)
        for module, when in modules(ast.parse(path.read_text()))
        if when == late
    }


def missing(found, allowed):
    """module: file, of what is imported and not among the distributions allowed."""
    distributions = metadata.packages_distributions()
    return {
        module: path
        for module, path in found.items()
        if not {plain(name) for name in distributions.get(module, [module])} & allowed
    }


def test_each_distribution_is_asked_for_once():
    assert len(asked_for()) == len(PROJECT["dependencies"])


def test_what_is_imported_at_once_comes_with_a_plain_install():
    found = imported(late=False)
    assert {"numpy", "distributed", "fastapi"} <= set(found)  # it looks where it should
    assert missing(found, asked_for()) == {}


def test_what_is_imported_later_comes_with_it_or_with_an_extra():
    found = imported(late=True)
    assert {"zarr", "laspy", "open3d"} <= set(found)
    assert set(missing(found, asked_for() | offered())) == set(NOT_ASKED_FOR)


def test_commands_of_the_readme_but_simulate_laz_bags_odometry_s3_and_postgres_come_with_a_plain_install():
    assert {"dask", "distributed", "cryptography", "zarr", "fastapi", "uvicorn", "httpx"} <= asked_for()
    assert {
        "open3d",
        "open3d-cpu",
        "laspy",
        "rosbags",
        "small-gicp",
        "lz4",
        "backports-zstd",
        "s3fs",
        "psycopg",
    } == offered()


def test_extras_named_anywhere_exist():
    """In the documents, in deploy/, and in errors."""
    texts = [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "deploy").rglob("*"),
        ROOT / "Makefile",
    ]
    texts += [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    said = {
        extra
        for path in texts
        if path.is_file()
        for group in re.findall(r"(?:lvba|\"\.)\[([a-z0-9,]+)\]", path.read_text(errors="ignore"))
        for extra in group.split(",")
    }
    assert {"laz", "s3", "postgres"} <= said
    assert said - set(PROJECT["optional-dependencies"]) == set()


def test_error_names_the_extra_of_laz(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=re.escape("pip install 'lvba[laz]'")):
        laz.write_las(tmp_path / "map.laz", iter([]), {}, np.zeros(3))


def test_error_names_the_extra_of_stores_in_buckets(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    # other tests in this process may have used a bucket
    monkeypatch.delitem(importlib.import_module("fsspec.registry")._registry, "s3", raising=False)
    with pytest.raises(InputError, match=re.escape("pip install 'lvba[s3]'")):
        UrlStore("s3://bucket/folder")


def test_error_names_the_extra_of_postgresql(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    settings = load({"data": str(tmp_path), "database": "postgresql://lvba@db/lvba"}, {})
    with pytest.raises(InputError, match=re.escape("pip install 'lvba[postgres]'")):
        data_folder.open_database(settings, Paths(tmp_path))
