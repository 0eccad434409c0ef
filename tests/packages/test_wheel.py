"""What is installed from the wheel works where the checkout is not: commands, workers, service and page.

`python -m build` makes the sdist, and the wheel from that sdist, each in an environment of its own with nothing but the
build requirements; the wheel is installed into an empty environment. What it depends on is not installed again, which
would take minutes: a .pth file shows the packages of the environment that runs the tests, all but the lvba that is
installed there from the checkout, for .pth files in folders that come in by a .pth file are not read. So this proves what
is in sdist and wheel, not that what the wheel requires is enough to run it: test_requirements.py compares that with what
the code imports, and here only that the wheel requires what pyproject.toml says.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import time
import tomllib
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import httpx
import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PATIENCE = 300
NOT_SOURCE = shutil.ignore_patterns(
    "__pycache__", "node_modules", "*.egg-info", ".*", "build", "dist", "tests", "demo"
)
ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "LVBA_"))}


def run(*words, cwd, code=0):
    """Output of a command that knows nothing of the checkout."""
    done = subprocess.run(
        [*map(str, words)], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == code, f"{words}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Folder of the sdist and the wheel; of a copy, so that the checkout stays as it is."""
    folder = tmp_path_factory.mktemp("built")
    shutil.copytree(ROOT, folder / "source", ignore=NOT_SOURCE)
    words = [sys.executable, "-m", "build", "--outdir", str(folder / "dist"), str(folder / "source")]
    done = subprocess.run(
        words, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE
    )
    said = done.stdout + done.stderr
    if re.search(r"No matching distribution found for setuptools|Could not find a version", said):
        pytest.skip("no package index can be reached, from which the build takes setuptools")
    assert done.returncode == 0, said
    assert "absent from the `packages` configuration" not in said
    return folder / "dist"


@pytest.fixture(scope="module")
def wheel(built):
    [path] = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tiny_result, tmp_path_factory):
    """Folder of the programs of an environment with the wheel and, for all else, the packages around this test.

    tiny_result: run before, so that what it takes is compiled by then
    """
    folder = tmp_path_factory.mktemp("empty") / "venv"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin/python"
    [packages] = (folder / "lib").glob("python*/site-packages")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet"]
    run(*pip, "--no-deps", "--no-index", "--no-compile", wheel, cwd=folder)
    around = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "around.pth").write_text("".join(f"{path}\n" for path in sorted(around)))
    compiled_kernels(packages / "lvba/kernels")
    return folder / "bin"


def compiled_kernels(folder):
    """What other tests compiled, copied beside the same sources, so that nothing is compiled again."""
    for source in (ROOT / "lvba/kernels").glob("*.py"):
        same = folder / source.name
        assert same.read_bytes() == source.read_bytes()
        times = source.stat()
        os.utime(same, ns=(times.st_atime_ns, times.st_mtime_ns))
    # a file .nbi lists files .nbc, which are written before it
    cache = ROOT / "lvba/kernels/__pycache__"
    for path in [*cache.glob("*.nbi"), *cache.glob("*.nbc")]:
        (folder / "__pycache__").mkdir(exist_ok=True)
        shutil.copy2(path, folder / "__pycache__")


def names_in_sdist(built):
    [path] = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


def names_in_wheel(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def of_checkout(pattern):
    found = {path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern) if path.is_file()}
    return {name for name in found if "node_modules" not in name and "__pycache__" not in name}


def test_wheel_has_all_modules_the_page_and_presets_and_nothing_else(wheel):
    modules = {n for package in ("lvba", "workers", "service") for n in of_checkout(f"{package}/**/*.py")}
    modules -= of_checkout("service/page_src/**/*")
    others = (
        of_checkout("service/page/**/*") | of_checkout("service/db/**/*.mako") | of_checkout("*/py.typed")
    ) | (of_checkout("lvba/sources/presets/*.yaml") | of_checkout("lvba/kernels/*.json"))
    assert "service/page/index.html" in others
    found = {name for name in names_in_wheel(wheel) if ".dist-info/" not in name}
    assert found == modules | others


def test_sdist_has_what_the_page_is_built_from_and_no_tests(built):
    found = names_in_sdist(built)
    assert {"LICENSE", "NOTICE", "README.md", "CHANGELOG.md", "pyproject.toml"} <= found
    assert of_checkout("service/page_src/**/*") <= found
    assert not [name for name in found if name.startswith(("tests", ".")) or "node_modules" in name]


def test_wheel_says_what_pyproject_says(wheel):
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        said = Parser().parsestr(archive.read(name).decode())
        licenses = {Path(n).name for n in archive.namelist() if ".dist-info/licenses/" in n}
    assert licenses == {"LICENSE", "NOTICE"}
    assert (said["Name"], said["Version"], said["License-Expression"]) == (
        "lvba",
        PROJECT["version"],
        "Apache-2.0",
    )
    plain = {re.sub(r"\s", "", line) for line in said.get_all("Requires-Dist") if "extra ==" not in line}
    assert plain == {re.sub(r"\s", "", line) for line in PROJECT["dependencies"]}
    assert set(said.get_all("Provides-Extra")) == set(PROJECT["optional-dependencies"])


def test_it_is_the_installed_one_that_runs(installed):
    code = (
        "import lvba, workers, service; from importlib.metadata import version;"
        "print(version('lvba'), lvba.__file__, workers.__file__, service.__file__)"
    )
    version, *files = run(installed / "python", "-c", code, cwd=installed).split()
    assert version == PROJECT["version"]
    assert all(Path(file).is_relative_to(installed.parent) for file in files)
    assert run(installed / "lvba", "--version", cwd=installed).split() == ["lvba", version]
    assert not any(Path(file).is_relative_to(ROOT) for file in files)


def same_bytes(one, two):
    names = ("lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply")
    return all((one / name).read_bytes() == (two / name).read_bytes() for name in names)


def test_command_line_gives_the_bytes_of_the_checkout(installed, tiny_recording, tiny_result, tmp_path):
    words = ("run", tiny_recording, "--out", tmp_path / "out", "--threads", 2)
    run(installed / "lvba", *words, cwd=tmp_path)
    assert same_bytes(tmp_path / "out", tiny_result)
    assert (tmp_path / "out/report.html").is_file()


def test_two_workers_give_the_same_bytes(installed, tiny_recording, tiny_result, tmp_path):
    words = ("run", tiny_recording, "--out", tmp_path / "out", "--workers", 2, "--threads", 2)
    run(installed / "lvba", *words, cwd=tmp_path)
    assert same_bytes(tmp_path / "out", tiny_result)


@pytest.fixture(scope="module")
def url(installed, tmp_path_factory):
    """Address of `lvba serve`."""
    folder = tmp_path_factory.mktemp("serving")
    log = folder / "log"
    words = [
        str(installed / "lvba"),
        "serve",
        "--data",
        str(folder / "data"),
        "--port",
        "0",
        "--threads",
        "2",
    ]
    with log.open("wb") as writer:
        process = subprocess.Popen(words, cwd=folder, env=ENVIRONMENT, stdout=writer, stderr=writer)
    until = time.monotonic() + PATIENCE
    while not (found := re.search(r"serving (http://\S+)", log.read_text())):
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < until, log.read_text()
        time.sleep(0.05)
    yield found[1]
    process.terminate()
    process.wait(60)


def test_service_has_its_page(url):
    for path in ("/", "/app/"):
        page = httpx.get(url + path, headers={"Accept": "text/html"})
        assert page.status_code == 200
        assets = re.findall(r"assets/[\w.-]+", page.text)
        assert {Path(name).suffix for name in assets} >= {".js", ".css"}
        for name in assets:
            answer = httpx.get(f"{url}/app/{name}")
            assert answer.status_code == 200
            assert answer.content == (ROOT / "service/page" / name).read_bytes()


def test_service_describes_its_interface(url):
    described = httpx.get(url + "/openapi.json")
    assert described.status_code == 200
    assert described.json()["info"]["version"] == PROJECT["version"]
    assert "/v1/jobs" in described.json()["paths"]
    assert httpx.get(url + "/docs").status_code == 200


def test_service_runs_a_job(installed, url, tiny_recording, tiny_result, tmp_path):
    job = run(installed / "lvba", "submit", tiny_recording, "--wait", "--server", url, cwd=tmp_path).split()[
        -1
    ]
    run(installed / "lvba", "fetch", job, "--out", tmp_path / "out", "--server", url, cwd=tmp_path)
    assert (tmp_path / "out/map.ply").read_bytes() == (tiny_result / "map.ply").read_bytes()
