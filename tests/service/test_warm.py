"""`lvba warm` leaves nothing to compile for the first run."""

import json
import os

import pytest

from service.cli import kernel_cache, kernel_signatures

FILL = "from service.cli import progress, warm_command\nwarm_command.fill(progress.Display(quiet=True))\n"
RUN = "import sys\nfrom service.cli import main\nassert main.main(sys.argv[1:]) == 0\n"
LIST = """
import json
from service.cli import kernel_signatures
for each in kernel_signatures.called():
    print("called:", json.dumps(each))
"""


def called(done):
    """Kernels that a process compiled or loaded, with the types of their arguments."""
    return {line for line in done.stdout.splitlines() if line.startswith("called:")}


def kept():
    """What is compiled ahead."""
    return {f"called: {json.dumps(each)}" for each in kernel_signatures.read()}


def test_a_run_calls_no_kernel_that_is_not_compiled_before(lvba, tiny_recording, tmp_path):
    warm = called(lvba(program=("-c", FILL + LIST)))
    run = called(lvba("run", tiny_recording, "--out", tmp_path / "out", program=("-c", RUN + LIST)))
    assert len(run) > 50
    assert run - warm == set()
    # `make signatures` writes them anew; all is compiled by now, and kernels that only others call are not loaded
    assert run - kept() == set()
    assert kept() - warm == set()


def test_warm_does_without_open3d(lvba, tmp_path):
    blocked = "import sys\nsys.modules['open3d'] = None\n"
    simulated = (
        "from pathlib import Path\nfrom service.cli import progress, warm_command\n"
        "warm_command.simulate_recording(Path(sys.argv[1]), progress.Display())\n"
    )
    lvba(tmp_path / "made", program=("-c", blocked + simulated))
    assert len(list((tmp_path / "made/all_image").glob("*.png"))) == 24


def test_a_warm_cache_is_known_until_a_file_or_the_program_is_another(tmp_path, monkeypatch):
    for name in ("a.nbi", "a.1.nbc"):
        (tmp_path / name).touch()
    assert not kernel_cache.is_warm(tmp_path)
    kernel_cache.note_warm(tmp_path)
    (tmp_path / "b.nbi").touch()
    assert kernel_cache.is_warm(tmp_path)
    with monkeypatch.context() as other:
        other.setattr(kernel_cache.versions, "key_version", lambda: "another")
        assert not kernel_cache.is_warm(tmp_path)
    (tmp_path / "a.1.nbc").unlink()
    assert not kernel_cache.is_warm(tmp_path)


@pytest.mark.parametrize("note", ["", "[]", "{}", json.dumps({"of": "x", "files": 3})])
def test_a_note_that_cannot_be_read_is_none(tmp_path, note):
    (tmp_path / "lvba-warm.json").write_text(note)
    assert not kernel_cache.is_warm(tmp_path)


def test_second_warm_compiles_nothing(lvba, tmp_path):
    """The cache is noted to be warm here, and not filled: that takes minutes."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    note = "from service.cli import kernel_cache\nkernel_cache.note_warm(kernel_cache.folder())\n"
    lvba(program=("-c", note), env=environment)
    said = lvba("warm", env=environment).stdout
    assert said.startswith("nothing to compile")
    assert str(tmp_path) in said


def test_cache_that_cannot_be_written_is_one_line(lvba, tmp_path):
    (tmp_path / "file").touch()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "file")}
    said = lvba("warm", env=environment, code=2).stderr
    assert said.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in said
    assert "cannot be written" in said


@pytest.mark.parametrize("command", [("warm",), ("run", "recording", "--out", "out")])
def test_no_folder_for_a_cache_is_one_line(lvba, command):
    # as where the program, the home folder and all else is read-only
    environment = {**os.environ, "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    environment.pop("NUMBA_CACHE_DIR", None)
    said = lvba(*command, env=environment, code=2).stderr
    assert said.count("\n") == 1
    assert "set NUMBA_CACHE_DIR" in said
