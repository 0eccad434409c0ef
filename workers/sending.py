"""A plan on its way to workers: what its steps are made from goes into the store, each thing once.

A step by itself is then little: names, numbers, and keys of artifacts. What a task reads does not grow with the plan.
"""

import hashlib
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from lvba import plan
from lvba.plan import Plan, Ref, Step
from workers import codec
from workers.store import ZarrStore

_INPUT, _RECORDING = "input", "recording"
_SMALL_CHARACTERS = 300
"""Arguments that are longer than this as JSON are artifacts of their own."""


class Sender:
    """Sends steps of one plan over one store."""

    def __init__(self, work: Plan, store: ZarrStore) -> None:
        self._store, self._version = store, work.version
        self._sent: dict[int, Ref] = {}
        self.plan = self._put("plan", {"version": work.version, "steps": plan.digest(list(work.steps))})
        """Key of an artifact by which workers know that they see the same store."""

    def outline(self, step: Step) -> str:
        """All that a worker must know of a step, as JSON; what is long is in the store."""
        arguments = {
            "name": step.name,
            "args": [self._outlined(value) for value in step.args],
            "kwargs": {name: self._outlined(value) for name, value in step.kwargs.items()},
        }
        return json.dumps(codec.encode(arguments, {}))

    def forget(self, key: str) -> None:
        """What was sent under the key is gone: it is sent again with the next step that needs it."""
        self._sent = {number: ref for number, ref in self._sent.items() if ref.key != key}

    def _outlined(self, value: Any) -> Any:
        if isinstance(value, Ref):
            return value
        if id(value) in self._sent:
            return self._sent[id(value)]
        if _holds_refs(value):
            if isinstance(value, dict):
                return {name: self._outlined(item) for name, item in value.items()}
            return type(value)(self._outlined(item) for item in value)
        if _is_small(value):
            return value
        kind = _RECORDING if getattr(value, "digest", "") else _INPUT
        # the plan holds the value, so that no other one can get its id
        self._sent[id(value)] = Ref(self._put(kind, value))
        return self._sent[id(value)]

    def _put(self, kind: str, value: Any) -> str:
        arrays: dict[str, np.ndarray] = {}
        data = codec.encode(value, arrays)
        digests = {
            name: hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest() for name, a in arrays.items()
        }
        key = f"{kind}-{plan.digest([data, digests])[:20]}"
        if key not in self._store:
            self._store.put(key, value, {"version": self._version})
        self._store.release(key)
        return key


def is_input(key: str) -> bool:
    """Whether the artifact is one that a sender made of a step's arguments."""
    return key.startswith(f"{_INPUT}-") or is_recording(key)


def is_recording(key: str) -> bool:
    """Whether the artifact is a recording, or a part of one."""
    return key.startswith(f"{_RECORDING}-")


def receive(outline: str, key: str, function: Callable[..., Any]) -> Step:
    """The step that was sent."""
    fields = codec.decode(json.loads(outline), {})
    return Step(fields["name"], key, function, tuple(fields["args"]), fields["kwargs"])


def _holds_refs(value: Any) -> bool:
    if isinstance(value, dict):
        return _holds_refs(list(value.values()))
    if isinstance(value, list | tuple):
        return any(isinstance(item, Ref) or _holds_refs(item) for item in value)
    return False


def _is_small(value: Any) -> bool:
    if getattr(value, "digest", ""):
        return False
    arrays: dict[str, np.ndarray] = {}
    return len(json.dumps(codec.encode(value, arrays))) <= _SMALL_CHARACTERS and not arrays
