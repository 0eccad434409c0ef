"""A plan on its way to workers: the arguments of its steps as an artifact, so that only keys go through the scheduler."""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from lvba import plan
from lvba.plan import Plan, Ref, Step
from workers import codec
from workers.store import ZarrStore

_INPUT = "input"


def send(work: Plan, store: ZarrStore) -> str:
    """The key of the artifact that holds the arguments of every step.

    Objects with a digest of their own (the recording) are artifacts by themselves, once each.
    """
    inputs: dict[int, Ref] = {}

    def outline(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return type(value)(outline(item) for item in value)
        if not getattr(value, "digest", ""):
            return value
        if id(value) not in inputs:
            inputs[id(value)] = Ref(_put(_INPUT, value, store, work.version))
        return inputs[id(value)]

    steps = {
        key: {
            "name": step.name,
            "args": outline(list(step.args)),
            "kwargs": {name: outline(value) for name, value in step.kwargs.items()},
        }
        for key, step in work.steps.items()
    }
    return _put("plan", {"version": work.version, "steps": steps}, store, work.version)


def is_input(key: str) -> bool:
    """Whether the artifact is one that `send` made of what goes into the plan."""
    return key.startswith(f"{_INPUT}-")


def receive(store: ZarrStore, sent: str, key: str, function: Callable[..., Any]) -> tuple[Step, str]:
    """One step of a plan that was sent, and the plan's version.

    Raises KeyError: the store does not hold the plan.
    """
    found = store[sent]
    step = found["steps"][key]
    return Step(step["name"], key, function, tuple(step["args"]), step["kwargs"]), found["version"]


def _put(kind: str, value: Any, store: ZarrStore, version: str) -> str:
    arrays: dict[str, np.ndarray] = {}
    data = codec.encode(value, arrays)
    digests = {
        name: hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest() for name, a in arrays.items()
    }
    key = f"{kind}-{plan.digest([data, digests])[:20]}"
    if key not in store:
        store.put(key, value, {"version": version})
    store.release(key)
    return key
