"""The report's two files."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lvba.io import files
from lvba.products.pictures import Pictures
from lvba.products.report import sections
from lvba.products.report.html import document

JSON, HTML = "report.json", "report.html"


def write(out: str | Path, facts: Mapping[str, Any], pictures: Pictures | None = None) -> None:
    """Writes report.json and report.html, which opens offline, into a folder.

    facts: the contents of report.json (docs/report.md); parts that are missing are left out of the page as well.
    Raises: InputError if a file cannot be written.
    """
    folder = files.make_folder(out)
    files.write_text(folder / JSON, to_json(facts), durable=True)
    files.write_text(folder / HTML, page(facts, pictures), durable=True)


def to_json(facts: Mapping[str, Any]) -> str:
    """Strict JSON: NaN and infinity become null; numpy numbers and arrays become numbers and lists."""
    return json.dumps(plain(facts), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def plain(value: Any) -> Any:
    """The value in the types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def page(facts: Mapping[str, Any], pictures: Pictures | None = None) -> str:
    """The whole of report.html."""
    shown = plain(facts)
    return document(sections.title(shown), sections.body(shown, pictures))
