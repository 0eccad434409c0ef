"""The table of README says what docs/results.json has."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SCENES = {
    "courtyard": "courtyard",
    "street of 300 m": "street",
    "rooms with thin walls": "rooms",
}


def plain(value: float, digits: int) -> str:
    """So many significant digits, without zeros at the end."""
    rounded = f"{value:.{digits}g}"
    return f"{float(rounded):g}"


def span(values: list[float], text) -> str:
    return f"{text(min(values))}-{text(max(values))}"


def expected_row(scene: str, lidar: str, rows: dict) -> str:
    known = [
        row["reference"] for name, row in rows.items() if name.startswith(f"{SCENES[scene]}, {lidar}, seed")
    ]
    assert len(known) == 9
    lengths = [
        span([1e3 * each[part]["ate_m"] for each in known], lambda x: plain(x, 2))
        for part in ("lidar", "camera")
    ]
    turns = span([each["camera"]["rotation_deg"] for each in known], lambda x: plain(x, 1))
    exposures = span([each["exposure"]["rms_percent"] for each in known], lambda x: f"{round(x, 2):g}")
    cameras = f"{lengths[1]} mm, {turns} deg"
    return f"| {scene}, {lidar} LiDAR | {lengths[0]} mm | {cameras} | {exposures} % |"


def test_figures_are_those_of_the_results():
    rows = json.loads((ROOT / "docs" / "results.json").read_text())["simulated, medium"]
    expected = [
        expected_row(scene, lidar, rows) for scene in SCENES for lidar in ("spinning", "non-repetitive")
    ]
    readme = (ROOT / "README.md").read_text()
    found = [line for line in readme.splitlines() if re.match(r"\| .* LiDAR \| ", line)]
    assert found == expected
    nees = [
        each["reference"][part].get("nees")
        for each in rows.values()
        for part in ("lidar", "camera", "exposure")
        if part in each["reference"]
    ]
    known = [value for value in nees if value is not None]
    assert f"{plain(min(known), 1)} to {max(known):.1f} times as large" in readme
