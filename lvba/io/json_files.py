"""JSON files of other programs."""

import json
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.io import files


def read_mapping(path: str | Path, mend: str, limit: int = files.MAX_TEXT_BYTES) -> dict[str, Any]:
    """The names and values of a JSON file of at most `limit` bytes. mend: for the error

    Raises: InputError: it is no JSON, or holds something else.
    """
    try:
        document = json.loads(files.read_text(path, limit))
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"not JSON ({str(error)[:80]})", mend) from error
    if not isinstance(document, dict):
        raise InputError(path, "holds no names with values", mend)
    return document
