"""The field's standard terms are used: terms that were retired do not come back, in code or in text."""

import ast
import re
from pathlib import Path

import pytest
from parsed import parsed

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("lvba", "workers", "service", "benchmarks")
IDENTIFIERS = {
    "Mount": "Extrinsic",
    "mount": "extrinsic",
    "mount_sigma": "extrinsic_sigma",
    "Weakness": "DegenerateDirections",
    "weakness": "directions",
    "WeakDirections": "DegenerateDirections",
    "excess": "variance_factor",
    "inflation": "variance_factor",
    "MountedCamera": "RigCamera",
    "ODD": "OUTLIER",
    "odd_ones": "outlier_indices",
    "Share": "BlockClusters",
    "ShareEquations": "BlockEquations",
    "Shares": "WallClusters, DescriptorLimits",
    "Ground": "MapPlanes",
    "Late": "LazyRef",
    "Passing": "StreamedRef",
    "lay_out": "select_scene_points, pack",
    "tie_exposures": "solve_exposures",
    "on_map": "local_covariance",
    "off_map": "local_covariance",
    "loose": "odometry_dependence",
    "between": "interpolation_error_scale",
    "missed": "leave_one_out_error",
    "end_effect": "boundary_error",
    "least_gain": "cost_tolerance",
    "settled": "converged, pose_tolerance",
    "hold": "project_degenerate, return_to_prior",
    "seen_from": "scan_poses_from_cameras, observer",
    "feigned": "noise_information",
    "doubt": "degeneracy",
    "priors": "trajectory_prior",
    "found": "a noun for what was found",
    "told": "a noun for what is said",
    "deed": "action",
    "PROMISED": "COVARIANCE_FACTOR",
    "FOLLOWED": "STEP_FACTOR",
    "STRANDED": "lease expired",
    "answer_for": "extend the deadline",
    "darkest": "DARK",
    "least_intensity": "DARK",
    "hidden_m": "HIDDEN_M",
    "occlusion_m": "HIDDEN_M",
    "tolerance_m": "HIDDEN_M",
}
"""Retired names of variables, functions, classes, arguments and fields, and the standard ones."""
WORDS = {
    "weak": "degenerate, open",
    "weakness": "degenerate, open",
    "doubt": "degeneracy, noise, uncertainty",
    "doubts": "uncertainties",
    "doubted": "a noun for what is looked at",
    "disagreement": "variance_factor, a standard deviation",
    "overstated": "variance_factor",
    "inflation": "variance_factor",
    "inflated": "with_variance_factors",
    "mounted": "extrinsic",
    "loose": "odometry_dependence, unconnected, uncertain",
    "vague": "uncertain",
    "untied": "unconfirmed",
    "doubtful": "insignificant, ambiguous",
    "crisp": "sharp",
    "crisper": "sharper",
    "excess": "variance_factor",
    "feigned": "noise_information",
    "mount": "extrinsic",
    "share": "block, cluster, fraction",
    "shares": "blocks, clusters, fractions",
    "stranded": "lease expired",
    "astray": "drifted",
}
"""Retired words in names of several words, and in keys of dictionaries."""
MODULES = {"doubt", "weak", "priors", "lifeline", "shown", "served", "finding", "places", "words"}
"""Retired names of modules."""
TEXT = {
    "Ended early": "Stopped",
    "Told by the run": "listed when the run starts",
    "be worth nothing": "be revoked",
    "with what the cameras know": "refined with the cameras",
    "images left out": "leave-one-out",
    "none any more": "removed",
    "who runs the server": "the server's administrator",
    "is none of a": "is not a",
    "not settled": "not converged",
    "feign": "look like, make up",
    "feigns": "looks like, makes up",
    "astray": "drifted",
    "overstates": "variance factor",
    "weak direction": "degenerate direction",
    "weak directions": "degenerate directions",
}
"""Retired wording that people would read, and the plain one; whatever the case."""
LABELS = {"Go on": "Continue", "DEED": "ACTION"}
"""The same of buttons and placeholders, as they are written."""
ALLOWED = {
    "lvba/simulate/truth.py": {
        "missed"
    },  # the offset at the end of a simulated loop: how far its ends miss each other
    "lvba/blocks/merge.py": {"missed"},  # the same, of a loop between parts
    "lvba/visual/result.py": {
        "between"
    },  # the covariance of images between keyframes, as interpolation gives it
    "lvba/io/timestamps.py": {"between"},  # files between two poses
    "service/system/repeat_filter.py": {"missed"},  # records of the log that were left out
}
"""Ordinary English, with the reason."""
WORDS_ALLOWED = {
    "lvba/retired_settings.py": {"excess"},
    "lvba/products/renamed_facts.py": {"disagreement", "inflation", "loose", "untied", "vague", "weak"},
}
"""What older files hold. `correlation_inflation` is the standard term."""
HISTORY = {"CHANGELOG.md"}
"""What was, in the words of then."""


def sources() -> list[Path]:
    return [
        path
        for name in PACKAGES
        for path in sorted((ROOT / name).rglob("*.py"))
        if "node_modules" not in path.parts
    ]


def texts() -> list[Path]:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    views = [
        path for path in (ROOT / "service/page_src/src").rglob("*.ts*") if "node_modules" not in path.parts
    ]
    return [path for path in [*pages, *views] if path.relative_to(ROOT).as_posix() not in HISTORY]


def names(tree: ast.AST) -> set[str]:
    """Of all that code defines or uses."""
    named: set[str] = set()
    for node in ast.walk(tree):
        for field in ("id", "attr", "arg", "name", "asname"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                named.add(value)
    return named


def words(tree: ast.AST) -> set[str]:
    """The single words of names, and of strings that could be names."""
    keys = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    named = names(tree) | {key for key in keys if key.isidentifier()}
    return {word.lower() for name in named for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_retired_word_is_part_of_a_name(package):
    retired = {}
    for path in sources():
        place = path.relative_to(ROOT).as_posix()
        if place.startswith(f"{package}/"):
            text = path.read_text().replace("correlation_inflation", "correlated")
            used = words(parsed(text)) & WORDS.keys() - WORDS_ALLOWED.get(place, set())
            retired |= {f"{place}: {word}": WORDS[word] for word in used}
    assert retired == {}, "retired: standard"


def test_no_module_has_a_retired_name():
    assert [path for path in sources() if path.stem in MODULES] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_no_retired_identifier_is_used(package):
    retired = {}
    for path in sources():
        place = path.relative_to(ROOT).as_posix()
        if place.startswith(f"{package}/"):
            used = names(parsed(path.read_text())) & IDENTIFIERS.keys() - ALLOWED.get(place, set())
            retired |= {f"{place}: {name}": IDENTIFIERS[name] for name in used}
    assert retired == {}, "retired: standard"


def test_no_retired_wording_is_in_a_text():
    retired = {}
    for path in [*sources(), *texts()]:
        text = path.read_text()
        for old, plain in (TEXT | LABELS).items():
            flags = re.NOFLAG if old in LABELS else re.IGNORECASE
            if re.search(rf"(?<!\w){re.escape(old)}(?!\w)", text, flags):
                retired[f"{path.relative_to(ROOT)}: {old}"] = plain
    assert retired == {}, "retired: plain"


def test_what_is_allowed_is_there():
    for place, allowed in ALLOWED.items():
        assert allowed <= names(parsed((ROOT / place).read_text())), place
    for place, allowed in WORDS_ALLOWED.items():
        assert allowed <= words(parsed((ROOT / place).read_text())), place


def test_a_retired_term_is_noticed():
    assert {"Mount", "found", "hold"} <= names(parsed("def hold(found: Mount): ..."))
    assert {"share", "weak", "doubted"} <= words(
        parsed("class CameraShare: ...\nx['weak_scans'] = MOST_DOUBTED")
    )
