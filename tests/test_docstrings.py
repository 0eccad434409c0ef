"""What public functions of lvba must say of themselves: arrays, what comes back, errors. By the sources, not by calls."""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "benchmarks"))

import structure_figures as structure  # noqa: E402

MODULES = structure.sources(ROOT)
PUBLIC = [
    function
    for path, module in MODULES.items()
    for function in structure.functions(path, module)
    if structure.is_public(function) and "overload" not in map(ast.unparse, function.node.decorator_list)
]
ERRORS = {node.name for node in MODULES[Path("lvba/errors.py")].body if isinstance(node, ast.ClassDef)}


def test_every_public_function_has_a_docstring():
    assert len(PUBLIC) > 800
    assert [function.name for function in PUBLIC if not ast.get_docstring(function.node)] == []


def test_every_array_parameter_has_shape_and_dtype():
    """In its annotation (`lvba.arrays`), as `name: (N, 3) float64, m` in the docstring, or by a reference."""
    assert {function.name: found for function in PUBLIC if (found := structure.lacking(function))} == {}


def test_names_of_arrays_say_shape_dtype_and_unit():
    source = (ROOT / "lvba" / "arrays.py").read_text()
    named = re.findall(r"^(\w+) = NDArray", source, re.MULTILINE)
    assert structure.array_names(ROOT) == set(named)
    for name, text in re.findall(r'^(\w+) = NDArray.*\n"""(.*?)"""', source, re.MULTILINE | re.DOTALL):
        assert structure.DTYPE.search(text), name
        assert re.match(r"\([^)]+\) \w+: ", text), name


def test_what_returns_an_array_says_its_shape():
    silent = [
        function.name
        for function in PUBLIC
        if function.node.returns is not None
        and structure.is_array(function.node.returns)
        and not re.search(r"\([^()]*[\w.][^()]*\)|as .*`|shape", function.documentation)
    ]
    assert silent == []


def test_public_errors_are_told():
    silent = []
    for function in PUBLIC:
        raised = {
            ast.unparse(node.exc.func if isinstance(node.exc, ast.Call) else node.exc).split(".")[-1]
            for node in ast.walk(function.node)
            if isinstance(node, ast.Raise) and node.exc is not None
        }
        if raised & ERRORS and not re.search(r"[Rr]aises", function.documentation):
            silent.append(f"{function.name} {sorted(raised & ERRORS)}")
    assert silent == []


def test_the_check_finds_what_is_missing():
    source = '''
def bad(points: np.ndarray, poses: np.ndarray, named: Poses, both: np.ndarray, none: np.ndarray):
    """Something.

    points: (N, 3) float32, m; poses: (S, 4, 4)
    both: as in `good`
    """
'''
    function = structure.Function(ast.parse(source).body[0], Path("lvba/x.py"), None)
    assert structure.lacking(function) == ["poses", "none"]


def test_records_of_many_fields_are_made_by_name():
    assert structure.positional(MODULES) == []


QUANTITIES = {
    *(
        "points",
        "point",
        "position",
        "positions",
        "center",
        "centers",
        "origin",
        "sensor",
        "length",
        "radius",
    ),
    *("reach", "voxel", "edge", "distance", "depth", "meters", "tolerance", "speed"),
    *("time", "times", "readout", "gap", "stamp", "duration"),
}
UNITS = r"m|mm|px|texels?|rad|s|deg|cells?|sigmas?|standard deviations?|m/s|parts? of|part"
IN_CLAUSE = re.compile(rf"(?<![\w.])({UNITS})(?!\w)|`")


def lacks_unit(function: structure.Function, parameter: ast.arg) -> bool:
    """Whether a length, time or set of points has no unit: in its name, its clause, or as `name` (unit) in a sentence."""
    annotation = ast.unparse(parameter.annotation) if parameter.annotation is not None else ""
    array = structure.is_array(parameter.annotation)
    if not (array or re.fullmatch(r"float( \| None)?", annotation)):
        return False
    if not set(parameter.arg.split("_")) & QUANTITIES or re.search(r"_(m|s|deg|px|rad)$", parameter.arg):
        return False
    text = function.documentation
    clause = " ".join(structure.clauses(parameter.arg, text))
    if array and re.search(r"\bu?int|bool|, 4\)|3, 3\)", clause + annotation):
        return False
    in_sentence = rf"`{parameter.arg}` (\(({UNITS})\)|({UNITS})\b)"
    return not (IN_CLAUSE.search(re.sub(r"\([^)]*\)", "", clause)) or re.search(in_sentence, text))


def test_lengths_times_and_points_have_units():
    lacking = {
        f"{function.name} {parameter.arg}"
        for function in PUBLIC
        for parameter in function.parameters
        if lacks_unit(function, parameter)
    }
    assert lacking == set()


FRAME = r"as (in|of) `|world|frame|tangent|same order|rotation"
"""What says of a transform which it is, where its name does not."""


def test_transforms_say_between_which_frames():
    """A parameter that is one transform or several is named `a_from_b`, or its clause says which it is."""
    vague = []
    for function in PUBLIC:
        for parameter in function.parameters:
            clause = " ".join(structure.clauses(parameter.arg, function.documentation))
            is_transform = structure.is_array(parameter.annotation) and re.match(
                r"[\w, ]+: \([^)]*4, 4\)", clause
            )
            if is_transform and not re.search("_from_|" + FRAME, parameter.arg + " " + clause):
                vague.append(f"{function.name} {parameter.arg}: {clause}")
    assert vague == []


SOURCES = {
    "lvba/trajectory.py": r"Li et al\., eq\. \(1\)",
    "lvba/visual/scene_points.py": r"eq\. \(2\)",
    "lvba/visual/visibility.py": r"Li et al\., II-C2, II-C3 and eq\. \(3\)",
    "lvba/kernels/visibility.py": r"Li et al\., eq\. \(3\)",
    "lvba/kernels/photometric_moving.py": r"eq\. 5",
    "lvba/kernels/homography.py": r"eq\. 7",
    "lvba/visual/photometric.py": r"eq\. \(8\)",
    "lvba/products/colorize.py": r"eq\. \(10\)",
    "lvba/blocks/split.py": r"Li et al\., section III",
    "lvba/lidar/bundle_adjustment.py": r"Liu, Liu and Zhang 2023 \(BALM2\)",
    "lvba/kernels/lidar.py": r"Liu, Liu and Zhang 2023 \(BALM2\), section IV",
    "lvba/lidar/covariance.py": r"Huber 1967, White 1982",
    "lvba/geometry.py": r"Sola et al\. 2018",
    "lvba/optim/levenberg_marquardt.py": r"Nielsen 1999",
    "lvba/optim/banded_cholesky.py": r"Takahashi, Fagan and Chen 1973",
    "lvba/optim/pose_graph.py": r"Latif et al\. 2013",
    "lvba/visual/fixed_calibration.py": r"Wald 1943",
    "lvba/products/metrics.py": r"Wang et al\. 2004",
    "lvba/products/map_quality.py": r"Droeschel and Behnke 2014",
    "lvba/steps/acceptance.py": r"Newey and West 1987",
    "lvba/steps/pose_fusion.py": r"Barfoot and Furgale 2014",
}
"""Where published methods are, and the source that a docstring there must name, with the equation."""


def test_published_methods_name_their_source():
    silent = [
        path
        for path, source in SOURCES.items()
        if not any(
            re.search(source, ast.get_docstring(node, clean=False) or "")
            for node in ast.walk(MODULES[Path(path)])
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        )
    ]
    assert silent == []


def test_the_checks_of_units_and_frames_find_what_is_missing():
    source = '''
def bad(points: np.ndarray, length: float, reach_m: float, known: np.ndarray, tolerance: float):
    """Within `tolerance` (m).

    points: (N, 3) float32; known: (N, 3) float64
    """
'''
    function = structure.Function(ast.parse(source).body[0], Path("lvba/x.py"), None)
    assert [p.arg for p in function.parameters if lacks_unit(function, p)] == ["points", "length"]
