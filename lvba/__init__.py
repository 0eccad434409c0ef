"""LiDAR-visual bundle adjustment: from rough odometry poses to a colored point map.

dataset = lvba.open_dataset("DATASET")
result = lvba.refine(dataset, lvba.Config())
result.write("OUT")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lvba.dataset import Dataset
    from lvba.errors import ArtifactError, DegenerateProblemError, InputError, LvbaError
    from lvba.io.dataset import open_dataset
    from lvba.io.reference import Reference, read_reference
    from lvba.pipeline import Config
    from lvba.result import Result, refine

__all__ = [
    "ArtifactError",
    "Config",
    "Dataset",
    "DegenerateProblemError",
    "InputError",
    "LvbaError",
    "Reference",
    "Result",
    "open_dataset",
    "read_reference",
    "refine",
]

_HOMES = {
    "ArtifactError": "lvba.errors",
    "Config": "lvba.pipeline",
    "Dataset": "lvba.dataset",
    "DegenerateProblemError": "lvba.errors",
    "InputError": "lvba.errors",
    "LvbaError": "lvba.errors",
    "Reference": "lvba.io.reference",
    "Result": "lvba.result",
    "open_dataset": "lvba.io.dataset",
    "read_reference": "lvba.io.reference",
    "refine": "lvba.result",
}


def __getattr__(name: str) -> Any:
    # on first use: whoever wants only one module (the command line's help, a worker) does not wait for all of them
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'lvba' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
