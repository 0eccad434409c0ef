"""Notebooks in docs/examples do what they say, in a process of their own, as a notebook program would run them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs/examples").glob("*.ipynb"))
SHOWN = "import IPython.display as d\nd.display = lambda *each: print('shown:', *(type(one).__name__ for one in each))\n"
AFTER = """
for sensor in ("scans", "cameras"):
    rough, refined = (np.sqrt((errors_mm[name, sensor] ** 2).mean()) for name in ("rough", "refined"))
    assert refined < 5 < 50 < rough, (sensor, rough, refined)
assert len(result.map) > 10_000
picture = Image(filename=str(work / "map.png")).data
assert len(picture) > 20_000
"""


def code(path):
    """Its code cells, one after another; what they display is told on stdout."""
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_kept(path):
    notebook = json.loads(path.read_text())
    assert notebook["nbformat"] == 4
    assert [c["id"] for c in notebook["cells"] if c.get("outputs") or c.get("execution_count")] == []


def test_first_map_is_refined_to_millimeters_and_shown(tmp_path):
    script = tmp_path / "first_map.py"
    script.write_text("\n\n".join([SHOWN, *code(ROOT / "docs/examples/first_map.ipynb"), AFTER]))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    words = [sys.executable, script]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=550)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("shown: SVG") == 2
    assert done.stdout.count("shown: Image") == 1
    assert "Traceback" not in done.stderr
