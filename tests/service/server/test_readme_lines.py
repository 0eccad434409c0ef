"""README's curl lines, pasted into a shell: they work, also twice, and where they do not, they end and say why."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ports import free_port
from programs import program_or_skip

ROOT = Path(__file__).resolve().parents[3]
PATIENCE = 300


def shown_lines(port):
    """The block of README that begins with `lvba serve &`, for a server on another port."""
    text = (ROOT / "README.md").read_text()
    block = re.search(r"^    lvba serve &\n(?:    .*\n)+", text, re.MULTILINE)[0]
    lines = [line.removeprefix("    ") for line in block.splitlines()]
    return [line.replace(":8080", f":{port}").replace("--retry 60", "--retry 600") for line in lines]


def paste(lines, folder, port):
    """What a shell says that is given the lines as if they were typed."""
    program_or_skip("curl", package="curl")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return subprocess.run(
        ["bash", "--norc", "-i"],
        input="\n".join([*lines, "kill %1", "wait", ""]),
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PATH": path, "LVBA_PORT": str(port), "PYTHONPATH": str(ROOT)},
        timeout=PATIENCE,
        start_new_session=True,
    )


@pytest.fixture
def folder(tiny_recording, tmp_path):
    """A working folder that holds the recording under the name that README uses."""
    (tmp_path / "RECORDING").symlink_to(tiny_recording)
    return tmp_path


def test_lines_pasted_twice_bring_the_map_twice(folder, tiny_result):
    port = free_port()
    lines = [line.replace("tar czf", "tar chzf") for line in shown_lines(port)]
    keep = ["mv map.ply first.ply"]
    said = paste([*lines, *keep, *lines], folder, port)
    wanted = (tiny_result / "map.ply").read_bytes()
    for name in ("first.ply", "map.ply"):
        assert (folder / name).exists(), said.stdout + said.stderr
        assert (folder / name).read_bytes() == wanted
    assert said.stdout.count('"state":"ready"') == 2


def test_lines_end_with_words_where_nobody_answers(folder):
    port = free_port()
    lines = [line.replace("--retry 600", "--retry 1") for line in shown_lines(port)[1:]]
    said = paste(lines, folder, port)
    assert "the server made no dataset" in said.stderr
    assert "the server made no job" in said.stderr
    assert "Failed to connect" in said.stderr or "Could not connect" in said.stderr


def test_lines_end_with_words_where_the_recording_is_none(service, tmp_path):
    (tmp_path / "RECORDING").mkdir()
    (tmp_path / "RECORDING" / "notes.txt").write_text("no scans here")
    port = service.url.rsplit(":", 1)[1]
    said = paste(shown_lines(port)[1:], tmp_path, port)
    assert '"state":"invalid"' in said.stdout
    assert "all_pcd_body" in said.stdout
    assert "the server made no job" in said.stderr
