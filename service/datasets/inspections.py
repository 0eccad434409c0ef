"""What the check of a dataset found in a bag, as it was kept."""

import json
from typing import Any

from service.system.paths import Paths


def read(paths: Paths, dataset_id: str) -> dict[str, Any] | None:
    """What `source_check.look` found; None: the dataset is a recording, or not checked yet."""
    try:
        kept: dict[str, Any] = json.loads(paths.inspection(dataset_id).read_text())
    except FileNotFoundError:
        return None
    return kept
