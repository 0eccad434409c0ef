"""Figures of the structure of a checkout: `python benchmarks/structure_figures.py [CHECKOUT ...]`, one column each.

Read off the sources alone, so that it runs on any commit: `git worktree add --detach /tmp/before COMMIT`, then
`python benchmarks/structure_figures.py /tmp/before .`
"""

import ast
import itertools
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONG = 50
"""Lines of a function without its docstring."""
MANY = 10
"""Parameters of a function."""
FIELDS = 6
"""Fields of a dataclass from which on they are given by name."""
WINDOW = 60
"""Syntax tokens in a row, names of variables and values of constants apart, that make two places duplicates."""
DTYPE = re.compile(r"\b(u?int(8|16|32|64)|float(32|64)|bool|integers|dtype)\b")

ELSEWHERE = re.compile(r"\b(as (in|of|from)|see|of) `[\w.]+`")
"""What refers to another docstring, where the array is described."""


@dataclass(frozen=True)
class Function:
    """A function or method, where it is, and the docstring of the class that it is in."""

    node: ast.FunctionDef | ast.AsyncFunctionDef
    path: Path
    owner: ast.ClassDef | None

    @property
    def name(self) -> str:
        """Module, class and function."""
        module = ".".join(self.path.with_suffix("").parts)
        inner = f"{self.owner.name}.{self.node.name}" if self.owner else self.node.name
        return f"{module}:{inner}"

    @property
    def documentation(self) -> str:
        """Its docstring and, of a constructor, that of its class."""
        own = ast.get_docstring(self.node) or ""
        return own + "\n" + (ast.get_docstring(self.owner) or "" if self.owner else "")

    @property
    def parameters(self) -> list[ast.arg]:
        """Without `self` and `cls`."""
        arguments = self.node.args
        every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
        return [argument for argument in every if argument.arg not in ("self", "cls")]

    @property
    def lines(self) -> int:
        """Without the docstring."""
        body = self.node.body
        body = body[1:] if ast.get_docstring(self.node) and len(body) > 1 else body
        return (body[-1].end_lineno or 0) - body[0].lineno + 1


def sources(root: Path) -> dict[Path, ast.Module]:
    """The modules of lvba, by their paths below the checkout."""
    return {
        path.relative_to(root): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted((root / "lvba").rglob("*.py"))
    }


def functions(path: Path, module: ast.Module) -> Iterator[Function]:
    """All of a module: its own and those of its classes, not those inside others."""
    for node in module.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield Function(node, path, None)
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield Function(inner, path, node)


def is_public(function: Function) -> bool:
    """Whether others may call it by name."""
    hidden = function.node.name.startswith("_") or (function.owner and function.owner.name.startswith("_"))
    return not hidden


def is_array(annotation: ast.expr | None) -> bool:
    """Whether an annotation is an array, or an array or None."""
    return annotation is not None and bool(
        re.fullmatch(r"(np\.ndarray|NDArray\[.*\])( \| None)?", ast.unparse(annotation))
    )


def is_named_array(annotation: ast.expr | None, names: frozenset[str]) -> bool:
    """Whether an annotation is one of `lvba.arrays`, which say shape, dtype and unit, or that or None."""
    return annotation is not None and ast.unparse(annotation).removesuffix(" | None") in names


def array_names(root: Path) -> frozenset[str]:
    """The names in `lvba.arrays` that are described; none where there is no such module."""
    path = root / "lvba" / "arrays.py"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return frozenset(re.findall(r'^(\w+) = NDArray\[.*\]\n"""\(', text, re.MULTILINE))


def clauses(name: str, text: str) -> Iterator[str]:
    """What a docstring says of a name, from the name to the end of the clause, wherever `name: ...` stands."""
    for match in re.finditer(rf"(?<![\w.`]){re.escape(name)}(, \w+)*(: | \()", text):
        yield re.split(r";|\.\s|\n\n|\n\s*\w+(?:, \w+)*: ", text[match.start() :], maxsplit=1)[0]


def is_described(parameter: ast.arg, text: str) -> bool:
    """Whether shape and dtype of an array are in its annotation or in a docstring, or in one that this refers to."""
    annotated = DTYPE.search(ast.unparse(parameter.annotation or ast.Pass()))
    return any(
        ELSEWHERE.search(clause) or ("(" in clause and (annotated or DTYPE.search(clause)))
        for clause in clauses(parameter.arg, text)
    )


def lacking(function: Function) -> list[str]:
    """Array parameters whose shape and dtype are nowhere."""
    return [
        parameter.arg
        for parameter in function.parameters
        if is_array(parameter.annotation) and not is_described(parameter, function.documentation)
    ]


def records(modules: dict[Path, ast.Module]) -> dict[tuple[str, str], int]:
    """How many fields each dataclass and NamedTuple has, by module and name."""
    return {
        (_module(path), node.name): sum(isinstance(inner, ast.AnnAssign) for inner in node.body)
        for path, module in modules.items()
        for node in module.body
        if isinstance(node, ast.ClassDef) and _is_record(node)
    }


def _module(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def _is_record(node: ast.ClassDef) -> bool:
    marks = [ast.unparse(mark) for mark in (*node.decorator_list, *node.bases)]
    return any(mark.startswith(("dataclass", "NamedTuple")) for mark in marks)


def _imported(module: ast.Module) -> dict[str, tuple[str, str]]:
    """Module and name that each name imported from lvba stands for."""
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.walk(module)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lvba")
        for alias in node.names
        if node.module
    }


def positional(modules: dict[Path, ast.Module]) -> list[str]:
    """Where a record of many fields is made of values without names. Kernels are left out."""
    fields, calls = records(modules), []
    for path, module in modules.items():
        if path.parent.name == "kernels":
            continue
        imported = _imported(module)
        for node in (node for node in ast.walk(module) if isinstance(node, ast.Call)):
            if isinstance(node.func, ast.Name):
                key = imported.get(node.func.id, (_module(path), node.func.id))
            elif isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
                key = (".".join(imported.get(node.func.value.id, ("", ""))), node.func.attr)
            else:
                continue
            starred = any(isinstance(argument, ast.Starred) for argument in node.args)
            if fields.get(key, 0) >= FIELDS and (len(node.args) > 1 or starred):
                calls.append(f"{path}:{node.lineno} {key[1]}")
    return calls


def tokens(module: ast.Module) -> list[tuple[str, int]]:
    """Kinds of syntax nodes with their lines, in the order of the source; names called stay, docstrings do not count."""
    kinds: list[tuple[str, int]] = []

    def walk(node: ast.AST, line: int) -> None:
        line = getattr(node, "lineno", line)
        if isinstance(node, ast.Import | ast.ImportFrom | ast.arguments) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        ):
            return
        kind = type(node).__name__
        if isinstance(node, ast.Attribute):
            kind += f".{node.attr}"
        if not isinstance(node, ast.expr_context):
            kinds.append((kind, line))
        for child in ast.iter_child_nodes(node):
            walk(child, line)

    walk(module, 0)
    return kinds


def duplicated_lines(modules: dict[Path, ast.Module]) -> int:
    """Lines that are part of a window of tokens which occurs elsewhere, too."""
    places: dict[int, list[tuple[Path, int, int]]] = defaultdict(list)
    for path, module in modules.items():
        row = tokens(module)
        for start in range(len(row) - WINDOW + 1):
            window = row[start : start + WINDOW]
            key = hash(tuple(kind for kind, _ in window))
            places[key].append((path, window[0][1], window[-1][1]))
    lines = set()
    for where in places.values():
        apart = [b for a, b in itertools.pairwise(where) if a[0] != b[0] or b[1] > a[2]]
        if apart:
            lines |= {(path, line) for path, first, last in where for line in range(first, last + 1)}
    return len(lines)


def layers(root: Path) -> int:
    """Rows of the contract that orders the modules of lvba; 0: there is none."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = [
        contract for contract in settings["tool"]["importlinter"]["contracts"] if "layers" in contract
    ]
    inner = [
        contract["layers"]
        for contract in contracts
        if contract.get("containers") == ["lvba"] or contract["layers"][-1].startswith("lvba.")
    ]
    return max(map(len, inner), default=0)


def figures(root: Path) -> dict[str, int]:
    """The table of one checkout."""
    modules = sources(root)
    every = [function for path, module in modules.items() for function in functions(path, module)]
    public = [function for function in every if is_public(function)]
    top = [
        path for path in (root / "lvba").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    ]
    names = array_names(root)
    arrays = [
        parameter
        for function in public
        for parameter in function.parameters
        if is_array(parameter.annotation) or is_named_array(parameter.annotation, names)
    ]
    return {
        "files and folders at the top of lvba": len(top),
        "import layers": layers(root),
        "functions": len(every),
        f"functions over {LONG} lines": sum(function.lines > LONG for function in every),
        f"functions with over {MANY} parameters": sum(len(function.parameters) > MANY for function in every),
        "array parameters of public functions": len(arrays),
        "of them without shape and dtype": sum(len(lacking(function)) for function in public),
        f"records of {FIELDS} or more fields made by position": len(positional(modules)),
        f"duplicated lines (windows of {WINDOW} syntax tokens)": duplicated_lines(modules),
        "lines": sum(len((root / path).read_text(encoding="utf-8").splitlines()) for path in modules),
    }


def main(roots: list[str]) -> None:
    """Prints the table."""
    columns = [figures(Path(root)) for root in roots]
    print("| | " + " | ".join(roots) + " |")
    print("|---|" + "---:|" * len(roots))
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(str(column[name]) for column in columns) + " |")


if __name__ == "__main__":
    main(sys.argv[1:] or ["."])
