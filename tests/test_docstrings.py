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
