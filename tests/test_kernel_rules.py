"""What keeps kernels such that one may change them: two decorators, one layout of poses, names instead of positions."""

import ast
import json
import re
from pathlib import Path

from parsed import parsed

LVBA = Path(__file__).resolve().parent.parent / "lvba"
KERNELS = sorted(path for path in (LVBA / "kernels").glob("*.py"))
MOST_PARAMETERS = 15


def tree(path):
    return parsed(path.read_text())


def functions(path):
    return [node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef)]


def parameters(function):
    arguments = function.args
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]


def decorator(node):
    node = node.func if isinstance(node, ast.Call) else node
    return node.attr if isinstance(node, ast.Attribute) else node.id


def constants(path):
    """Names that a module assigns at its top."""
    for node in tree(path).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            yield from (name.id for name in ast.walk(target or ast.Pass()) if isinstance(name, ast.Name))


def test_kernels_are_compiled_by_two_decorators():
    used = {
        decorator(node)
        for path in KERNELS
        if path.name != "compiled.py"
        for function in functions(path)
        for node in function.decorator_list
    }
    assert used == {"kernel", "parallel_kernel", "intrinsic"}, "an intrinsic is LLVM's own, and no kernel"
    compilers = [path.name for path in LVBA.rglob("*.py") if re.search(r"\bn?jit\b", path.read_text())]
    assert compilers == ["compiled.py"]


def test_the_homography_is_in_one_place():
    named = [
        f"{path.relative_to(LVBA)}:{function.name}"
        for path in sorted(LVBA.rglob("*.py"))
        for function in functions(path)
        if "homography" in function.name
    ]
    assert named == ["kernels/homography.py:plane_homography"]
    # what it is made of: the relative pose times a ray, plus the offset times the plane
    made = [
        path.name
        for path in KERNELS
        if any(
            isinstance(node, ast.Subscript) and getattr(node.value, "id", "") == "relative"
            for node in ast.walk(tree(path))
        )
    ]
    assert made == ["homography.py"]


def test_poses_have_one_layout():
    apart = {"rotation", "rotations", "translation", "translations", "turn", "camera_from_world"}
    split = [
        f"{path.name}:{function.name}"
        for path in KERNELS
        for function in functions(path)
        if {argument.arg for argument in parameters(function)} & apart
    ]
    assert split == ["point_cluster.py:rotate_scatter"], "which turns a matrix, and takes no pose"
    odd = re.compile(r"(pose|camera|scan)\w*: \((\w+, )?(3, 4|3, 3)\)")
    assert [path.name for path in KERNELS if odd.search(path.read_text())] == []
    assert [path.name for path in KERNELS if "A pose is" in path.read_text()] == ["scene.py"]


def test_kernels_take_names_instead_of_positions():
    packed = re.compile(r"\b(gates|limits|intrinsics|tolerance|slopes|usable|mix|style|fields|means)\[\d")
    assert [path.name for path in KERNELS if packed.search(path.read_text())] == []
    long = {
        f"{path.name}:{function.name}": len(parameters(function))
        for path in KERNELS
        for function in functions(path)
        if len(parameters(function)) > MOST_PARAMETERS
    }
    assert long == {}


def test_fields_of_kernel_arguments_are_described():
    missing = []
    for path in KERNELS:
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef):
                described = ast.get_docstring(node) or ""
                fields = [field.target.id for field in node.body if isinstance(field, ast.AnnAssign)]
                arrays = [
                    field.target.id
                    for field in node.body
                    if isinstance(field, ast.AnnAssign) and "ndarray" in ast.unparse(field.annotation)
                ]
                assert fields
                missing += [
                    f"{path.name}:{node.name}.{name}"
                    for name in arrays
                    if not re.search(rf"\b{name}\b", described)
                ]
    assert missing == []


def called_kernels(path):
    """The names, with their modules, of the functions of kernel modules that a file calls."""
    of_modules, by_themselves = {}, {}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lvba.kernels"):
            known = of_modules if node.module == "lvba.kernels" else by_themselves
            inside = node.module.removeprefix("lvba.kernels").removeprefix(".")
            known |= {
                alias.asname or alias.name: f"{inside}.{alias.name}".lstrip(".") for alias in node.names
            }
    if path in KERNELS:
        by_themselves |= {function.name: f"{path.stem}.{function.name}" for function in functions(path)}
    for node in ast.walk(tree(path)):
        match node:
            case ast.Call(func=ast.Name(id=name)) if name in by_themselves:
                yield by_themselves[name]
            case ast.Call(func=ast.Attribute(value=ast.Name(id=module), attr=name)) if module in of_modules:
                yield f"{of_modules[module]}.{name}"


def test_kernels_that_python_calls_are_called_by_no_other():
    """A kernel holds a copy of those that it calls. Where one of these was loaded before, as Python called it, that is
    taken instead, with other roundings: results would depend on the order of calls. Whole numbers have none."""
    kernels = {f"{path.stem}.{function.name}" for path in KERNELS for function in functions(path)}
    from_python = {
        name for path in LVBA.rglob("*.py") if path not in KERNELS for name in called_kernels(path)
    }
    from_kernels = {name for path in KERNELS for name in called_kernels(path)}
    assert len(from_python & kernels) > 60
    assert len(from_kernels & kernels) > 100
    both = from_python & from_kernels & kernels
    arguments = dict(json.loads((LVBA / "kernels" / "signatures.json").read_text()))
    rounding = {name for name in both if any("float" in str(each) for each in arguments[name])}
    assert rounding == set()


def test_there_is_one_tolerance_of_occlusion():
    named = [
        f"{path.relative_to(LVBA)}:{name}"
        for path in sorted(LVBA.rglob("*.py"))
        for name in constants(path)
        if re.search(r"(hidden|occlusion|tolerance|hiding)_m$", name, re.IGNORECASE)
    ]
    assert named == ["visual/scene_points.py:HIDDEN_M"]


def test_there_is_one_brightness_threshold():
    named = [
        f"{path.relative_to(LVBA)}:{name}"
        for path in sorted(LVBA.rglob("*.py"))
        for name in constants(path)
        if re.search(r"dark|least_intensity", name, re.IGNORECASE)
    ]
    assert named == ["visual/image.py:DARK"]
