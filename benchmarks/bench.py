"""`make bench`: every bench_*.py beside this file, into docs/benchmarks.json and a table in docs/benchmarks.md.

python benchmarks/bench.py              all of them
python benchmarks/bench.py run lidar    some; the others keep the figures they have
"""

import importlib
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

from service.system.threads import limit_threads

limit_threads(None)  # before numpy is imported

HERE = Path(__file__).resolve().parent
JSON = HERE.parent / "docs" / "benchmarks.json"
MARKDOWN = HERE.parent / "docs" / "benchmarks.md"


def main(wanted: list[str]) -> int:
    """Exit code: 0, or 2 where there is no such benchmark."""
    known = sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))
    unknown = sorted(set(wanted) - set(known))
    if unknown:
        sys.stderr.write(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}\n")
        return 2
    sys.path[:0] = [str(HERE), str(HERE.parent)]
    results = json.loads(JSON.read_text()) if JSON.exists() else {}
    for name in wanted or known:
        sys.stderr.write(f"{name} ...\n")
        module = importlib.import_module(f"bench_{name}")
        results[name] = {"about": (module.__doc__ or "").strip(), **module.run()}
        results["machine"] = machine()
        JSON.write_text(json.dumps(results, indent=1) + "\n")
        MARKDOWN.write_text(markdown(results))
    sys.stdout.write(markdown(results))
    return 0


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else model
    return {"processor": model, "cores": os.cpu_count(), "python": platform.python_version()}


def markdown(results: dict[str, Any]) -> str:
    """docs/benchmarks.md."""
    machine = results.get("machine", {})
    lines = ["# Benchmarks", "", "*Reference.* Speed and memory of the method and the service.", ""]
    lines += ["Made by `make bench`; the best of several runs, without compilation.", ""]
    lines += [
        f"{machine.get('processor')}, {machine.get('cores')} cores, Python {machine.get('python')}.",
        "",
    ]
    for name, result in sorted(results.items()):
        if name != "machine":
            about = result.get("about", "").splitlines()
            lines += [
                f"## {name}",
                "",
                *about,
                "",
                *_summary(result),
                "",
                *_table(result.get("rows", [])),
                "",
            ]
    return "\n".join(lines)


def _summary(result: dict[str, Any]) -> list[str]:
    return [
        f"* {key.replace('_', ' ')}: {_text(value)}"
        for key, value in result.items()
        if key not in ("name", "about", "rows")
    ]


def _table(rows: list[dict[str, Any]]) -> list[str]:
    if not rows:
        return []
    names = list(rows[0])
    head = "| " + " | ".join(name.replace("_", " ") for name in names) + " |"
    body = ["| " + " | ".join(_text(row.get(name)) for name in names) + " |" for row in rows]
    return [head, "|" + "---|" * len(names), *body]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
