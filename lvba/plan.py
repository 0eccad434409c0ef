"""A plan: which functions make which artifacts from which others, as plain data.

Whoever runs a plan (one process, a cluster) needs only `Plan.steps`, in order, and a store for the artifacts.
A step is named by what determines its result: the same key always means the same bytes.
"""

import dataclasses
import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, Protocol, runtime_checkable

import numpy as np

from lvba.progress import Progress, silent

_LONG = 32

Store = MutableMapping[str, Any]
"""Where artifacts live, by step key. A dict is one; `workers.store.ZarrStore` is another."""


@dataclass(frozen=True)
class Ref:
    """Stands for the artifact that the step of this key makes."""

    key: str


@dataclass(frozen=True)
class LazyRef(Ref):
    """The same, for a function that does not always look at it: it is given a function that reads the artifact."""


@dataclass(frozen=True)
class StreamedRef(LazyRef):
    """The same, for one of many that are looked at one after another: the store does not keep it in memory."""


def one_at_a_time(refs: Sequence[Ref]) -> list[Ref]:
    """The same artifacts, for a function that looks at one after another."""
    return [StreamedRef(each.key) for each in refs]


class MissingError(Exception):
    """An artifact is gone that a step asked for late."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key} is gone")
        self.key = key


@dataclass(frozen=True)
class Step:
    """One artifact to make: `function(*args, **kwargs)` with each Ref replaced by the artifact it stands for."""

    name: str
    key: str
    """`<name>-<digest>`: stage, stage version, constants and the keys of all inputs."""
    function: Callable[..., Any]
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]

    @property
    def needs(self) -> list[str]:
        """Keys of the artifacts this step is made from."""
        return [ref.key for ref in self._refs()]

    @property
    def needs_at_once(self) -> list[str]:
        """Keys of those that are read before the step begins."""
        return [ref.key for ref in self._refs() if not isinstance(ref, LazyRef)]

    def _refs(self) -> Iterator[Ref]:
        return _refs([*self.args, *self.kwargs.values()])


@dataclass
class Plan:
    """Steps in an order in which they can run.

    version: what else determines every result, such as the version of the code
    """

    version: str = ""
    steps: dict[str, Step] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set, repr=False)
    _long: dict[int, tuple[Any, str]] = field(default_factory=dict, repr=False)
    """By id: long tuples and the digests of their identities."""

    def add(
        self, name: str, function: Callable[..., Any], *args: Any, version: int = 1, **kwargs: Any
    ) -> Ref:
        """The artifact of a new step. Refs among the arguments, also inside lists, are its inputs.

        version: of this stage; raise it when the function gives other results for the same arguments
        Raises ValueError: two steps of one name, or an input that no earlier step makes.
        """
        if name in self._names:
            raise ValueError(f"two steps are named {name!r}")
        for ref in _refs([*args, *kwargs.values()]):
            if ref.key not in self.steps:
                raise ValueError(f"step {name!r} needs {ref.key!r}, which no earlier step makes")
        inputs = {name: self._identity(value) for name, value in kwargs.items()}
        material = [self.version, name, version, [self._identity(a) for a in args], inputs]
        key = f"{name}-{digest(material)[:20]}"
        self.steps[key] = Step(name, key, function, args, kwargs)
        self._names.add(name)
        return Ref(key)

    def _identity(self, value: Any) -> Any:
        """What a value counts as; a long tuple is looked at once, for every part's step may be given the same one."""
        if not isinstance(value, tuple) or len(value) < _LONG:
            return identity(value)
        if id(value) not in self._long:
            # held, so that no other one can get its id
            self._long[id(value)] = value, digest(identity(value))
        return {"tuple": self._long[id(value)][1]}


def run(plan: Plan, store: Store, progress: Progress = silent) -> Store:
    """The store with the artifact of every step, made in this process, one after another."""
    for step in plan.steps.values():
        if step.key not in store:
            store[step.key] = compute(step, store, progress)
    return store


def compute(step: Step, store: Store, progress: Progress = silent) -> Any:
    """The artifact of one step, from the artifacts in the store. A function with a parameter `progress` is given it."""
    kwargs = {name: resolve(value, store) for name, value in step.kwargs.items()}
    if "progress" in inspect.signature(step.function).parameters:
        kwargs["progress"] = progress
    return normal(step.function(*resolve(list(step.args), store), **kwargs))


def resolve(value: Any, store: Store) -> Any:
    """The value with each Ref, also inside lists, tuples and dicts, replaced by its artifact."""
    if isinstance(value, LazyRef):
        return functools.partial(_read_lazily, store, value.key, keep=not isinstance(value, StreamedRef))
    if isinstance(value, Ref):
        return store[value.key]
    if isinstance(value, list | tuple):
        return type(value)(resolve(item, store) for item in value)
    if isinstance(value, dict):
        return {name: resolve(item, store) for name, item in value.items()}
    return value


def _read_lazily(store: Store, key: str, *, keep: bool) -> Any:
    forgetful = store if isinstance(store, _Forgetful) and not keep else None
    held = forgetful is not None and key in forgetful.held()
    try:
        return store[key]
    except KeyError:
        raise MissingError(key) from None
    finally:
        if forgetful is not None and not held:
            forgetful.release(key)


@runtime_checkable
class _Forgetful(Protocol):
    """A store that keeps its artifacts elsewhere, and some in memory."""

    def held(self) -> list[str]: ...
    def release(self, key: str) -> None: ...


def normal(value: Any) -> Any:
    """The same artifact with every array C-contiguous and in native byte order.

    An artifact read back from a store is so; with the same memory layout the steps after it sum in the same order,
    and a resumed run gives the same bytes as one that was never interrupted.
    """
    if isinstance(value, np.ndarray):
        # ascontiguousarray would turn a 0-d array into a 1-d one
        return np.asarray(value, dtype=value.dtype.newbyteorder("="), order="C")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: normal(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
        return dataclasses.replace(value, **changed)
    if isinstance(value, list | tuple):
        return type(value)(normal(item) for item in value)
    if isinstance(value, dict):
        return {name: normal(item) for name, item in value.items()}
    return value


def digest(material: Any) -> str:
    """sha256, hexadecimal, of the canonical JSON of plain data: sorted names, no blanks, shortest exact floats."""
    text = json.dumps(material, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def identity(value: Any) -> Any:
    """Plain data that is equal for equal values: what goes into a step's key.

    Arrays count by content; an object with a `digest` of its own (a dataset) counts by that, wherever it lies.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value.item() if isinstance(value, np.generic) else value
    if isinstance(value, Ref):
        return {"ref": value.key}
    if isinstance(value, np.ndarray | np.generic):
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"array": content, "dtype": str(value.dtype), "shape": list(value.shape)}
    if isinstance(value, list | tuple):
        return [identity(item) for item in value]
    if isinstance(value, Mapping):
        return {str(name): identity(item) for name, item in value.items()}
    if isinstance(value, PurePath):
        return str(value)
    if dataclasses.is_dataclass(value):
        return _identity_of_object(value)
    raise TypeError(f"a step cannot be keyed by a {type(value).__qualname__}: {value!r}")


def _identity_of_object(value: Any) -> Any:
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    own = getattr(value, "digest", None)
    if isinstance(own, str) and own:
        return {"type": kind, "digest": own}
    return {"type": kind} | {f.name: identity(getattr(value, f.name)) for f in dataclasses.fields(value)}


def _refs(value: Any) -> Iterator[Ref]:
    if isinstance(value, Ref):
        yield value
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _refs(item)
    elif isinstance(value, dict):
        yield from _refs(list(value.values()))
