"""`lvba view`: a result in the browser."""

import argparse
import json
import os
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Mapping
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files
from lvba.products import lod
from service.cli.progress import Display

_MEND = "give the folder that `lvba run` wrote"


def view(arguments: argparse.Namespace, display: Display) -> None:
    """Serve the result until stopped. Nothing is written into its folder."""
    result = checked(arguments.result)
    if not 0 <= arguments.port <= 65535:
        raise InputError(f"--port {arguments.port}", "there is no such port", "give one of 0..65535")
    display.stage(f"open {result.name}", 0, 1)
    if lod.is_of(result / "map.ply", result / "cloud"):
        _serve(arguments, display, result, result)
        return
    with tempfile.TemporaryDirectory(prefix="lvba-view-") as made:
        _make_viewer(result, Path(made), display)
        _serve(arguments, display, result, Path(made))


def checked(folder: Path) -> Path:
    """The folder, without links, if it is a result.

    Raises InputError: it is none.
    """
    with files.as_input_error(folder):
        os.stat(folder)
    for name in ("report.json", "map.ply"):
        if not (folder / name).is_file():
            raise InputError(folder, f"is no result: it holds no {name}", _MEND)
    try:
        report = json.loads(files.read_text(folder / "report.json"))
    except ValueError:
        report = None
    if not isinstance(report, dict):
        raise InputError(folder / "report.json", "is not a report", "run again")
    return folder.resolve()


def _make_viewer(result: Path, folder: Path, display: Display) -> None:
    # knows the whole method, which a result that has its octree need not wait for
    from lvba.products.export import export

    display.stage(f"prepare the map in {folder} (`lvba export RESULT lod` keeps it for good)", 0, 1)
    export(result, "lod", folder, display.progress)
    display.clear()


def _serve(arguments: argparse.Namespace, display: Display, result: Path, viewer: Path) -> None:
    from service.api import result_viewer

    def ready(address: str) -> None:
        display.clear()
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()
        if not arguments.no_browser and has_display():
            threading.Thread(target=webbrowser.open, args=[address], daemon=True).start()
        if not arguments.quiet:
            sys.stderr.write(f"lvba: showing {result}; Ctrl-C ends it\n")

    result_viewer.view(result_viewer.ViewedResult(result, viewer.resolve()), arguments.port, ready)


def has_display(platform: str = sys.platform, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether a browser could show anything: one in the terminal would take it away."""
    if platform in ("darwin", "win32"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))
