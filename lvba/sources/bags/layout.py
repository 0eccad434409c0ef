"""Bytes of messages as named values, by their definitions: the packed layout of ROS 1, and the CDR of ROS 2.

Nested messages are flattened: `pose.pose.position.x`, all in lower case. Runs of numbers of one type are read at once;
sequences of messages whose fields are all numbers become one structured array, without a copy.
Sources: wiki.ros.org/msg; OMG DDSI-RTPS 2.2, section 10: CDR, aligned from behind the four bytes of encapsulation.
"""

import functools
import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.sources.bags import definitions
from lvba.sources.bags.container import Encoding
from lvba.sources.bags.definitions import Types, Undecodable

_NUMBERS = {"bool": "u1", "byte": "u1", "char": "u1"} | {
    f"{name}{8 * size}": f"{letter}{size}"
    for name, letter, sizes in (
        ("int", "i", (1, 2, 4, 8)),
        ("uint", "u", (1, 2, 4, 8)),
        ("float", "f", (4, 8)),
    )
    for size in sizes
}
_LETTERS = {
    "u1": "B",
    "i1": "b",
    "u2": "H",
    "i2": "h",
    "u4": "I",
    "i4": "i",
    "u8": "Q",
    "i8": "q",
    "f4": "f",
    "f8": "d",
}
_TIMES = {
    "time": "u4",
    "duration": "i4",
    "builtin_interfaces/Time": "i4",
    "builtin_interfaces/Duration": "i4",
}
_DEEPEST, _MOST_STEPS = 12, 2000
"""Of nested types: real messages have up to 5 and 100."""
_MOST_LISTED = 200_000
"""Messages in a message that are read one by one: each takes a kilobyte."""
_LONG = 64
"""Fixed arrays longer than this are read as an array of their own."""


@dataclass(frozen=True)
class Run:
    """Numbers of one type, one behind the other. parts: (name, first, behind the last; None: a single one)"""

    code: str
    parts: tuple[tuple[str, int, int | None], ...]
    count: int


@dataclass(frozen=True)
class Text:
    """A string."""

    name: str


@dataclass(frozen=True)
class Array:
    """Numbers. count: None: it is written before them"""

    name: str
    code: str
    count: int | None


@dataclass(frozen=True)
class Many:
    """Messages, or strings (layout None). count: None: it is written before them"""

    name: str
    layout: "Layout | None"
    count: int | None


Step = Run | Text | Array | Many


@dataclass(frozen=True)
class Layout:
    """How a message is read. least: bytes that it takes at least"""

    steps: tuple[Step, ...]
    least: int


@functools.lru_cache(maxsize=512)
def layout_of(definition: str, message_type: str, encoding: Encoding) -> Layout:
    """The layout of a message, by its definition, or by the known one where that is empty.

    Raises Undecodable: there is none, or it is none.
    """
    name = definitions.short(message_type)
    types = definitions.known(encoding)
    has_fields = any(line.strip() and not line.strip().startswith("#") for line in definition.splitlines())
    if has_fields:
        try:
            types = types | definitions.parse(definition, name)
        except Undecodable:
            if name not in types:
                raise
    if name not in types:
        raise Undecodable("the bag does not define its type")
    return _Compiler(types, encoding).layout(name)


class _Compiler:
    """Flattens types."""

    def __init__(self, types: Types, encoding: Encoding) -> None:
        self._types = types
        self._empty = [Run("u1", (), 1)] if encoding is Encoding.CDR else []
        """What a type without fields has: ROS 2 gives it one, for its languages allow none without."""
        self._left = _MOST_STEPS

    def layout(self, name: str, depth: int = 0) -> Layout:
        """Of the type of this name."""
        steps: list[Step] = []
        self._add(steps, name, "", depth)
        merged = _merged(steps)
        return Layout(merged, sum(map(_least, merged)))

    def _add(self, steps: list[Step], type_name: str, prefix: str, depth: int) -> None:
        if depth > _DEEPEST:
            raise Undecodable("its definition is nested too deep, or holds itself")
        if type_name not in self._types:
            raise Undecodable(f"the bag does not define {type_name[:80]}")
        if not self._types[type_name]:
            steps += self._empty
        for field in self._types[type_name]:
            self._left -= 1
            if self._left < 0:
                raise Undecodable("its definition has too many fields")
            self._add_field(steps, field, prefix + field.name, depth)

    def _add_field(self, steps: list[Step], field: definitions.Field, path: str, depth: int) -> None:
        count = None if field.count == -1 else field.count
        single = field.count is None
        code = _NUMBERS.get(field.type)
        if field.type in ("string", "wstring"):
            if field.type == "wstring":
                raise Undecodable("a field of wide characters")
            steps.append(Text(path) if single else Many(path, None, count))
        elif code and single:
            steps.append(Run(code, ((path, 0, None),), 1))
        elif code and count is not None and count <= _LONG:
            steps.append(Run(code, ((path, 0, count),), count))
        elif code:
            steps.append(Array(path, code, count))
        elif field.type in _TIMES and single:
            seconds = Run(_TIMES[field.type], ((f"{path}.sec", 0, None),), 1)
            steps += [seconds, Run("u4", ((f"{path}.nanosec", 0, None),), 1)]
        elif single:
            self._add(steps, field.type, f"{path}.", depth + 1)
        else:
            if field.type in _TIMES:
                raise Undecodable("a sequence of times")
            steps.append(Many(path, self.layout(field.type, depth + 1), count))


def _merged(steps: list[Step]) -> tuple[Step, ...]:
    """Runs of one type that follow each other become one."""
    merged: list[Step] = []
    for step in steps:
        last = merged[-1] if merged else None
        if isinstance(step, Run) and isinstance(last, Run) and step.code == last.code:
            moved = [
                (name, first + last.count, None if stop is None else stop + last.count)
                for name, first, stop in step.parts
            ]
            merged[-1] = Run(step.code, (*last.parts, *moved), last.count + step.count)
        else:
            merged.append(step)
    return tuple(merged)


def _least(step: Step) -> int:
    if isinstance(step, Run):
        return step.count * int(step.code[1])
    if isinstance(step, Text) or step.count is None:
        return 4
    if isinstance(step, Array):
        return step.count * int(step.code[1])
    return step.count * (step.layout.least if step.layout else 4)


def decode(
    layout: Layout, data: bytes | memoryview, encoding: Encoding, numbers_of: Collection[str] = ()
) -> dict[str, Any]:
    """Values by name: numbers, tuples of them, str, arrays (views of the data), structured arrays, lists.

    numbers_of: names of sequences of messages of which only numbers are wanted: where all texts in them have the same
        length, they are structured arrays, too
    Raises Undecodable: the bytes do not fit the layout.
    """
    if encoding is Encoding.ROS1:
        reader = _Reader(memoryview(data), "<", numbers_of, aligned=False)
    elif encoding is Encoding.CDR:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise Undecodable("its encapsulation is not plain CDR")
        reader = _Reader(memoryview(data)[4:], "<" if data[1] else ">", numbers_of, aligned=True)
    else:
        raise Undecodable("its encoding is neither of ROS 1 nor of ROS 2")
    try:
        return reader.message(layout)
    except struct.error:
        raise Undecodable("it is shorter than its type") from None


class _Reader:
    """A place in the bytes of a message."""

    def __init__(self, data: memoryview, order: str, numbers_of: Collection[str], *, aligned: bool) -> None:
        self._data, self._order, self._aligned = data, order, aligned
        self._numbers_of = numbers_of
        self._at = 0

    def message(self, layout: Layout) -> dict[str, Any]:
        """The values of one message."""
        values: dict[str, Any] = {}
        for step in layout.steps:
            if isinstance(step, Run):
                self._run(step, values)
            elif isinstance(step, Text):
                values[step.name] = self._text()
            elif isinstance(step, Array):
                values[step.name] = self._array(step)
            else:
                values[step.name] = self._many(step)
        return values

    def _align(self, size: int) -> None:
        if self._aligned:
            self._at += -self._at % size

    def _run(self, step: Run, values: dict[str, Any]) -> None:
        form = number_struct(self._order, step.count, step.code)
        self._align(int(step.code[1]))
        numbers = form.unpack_from(self._data, self._at)
        self._at += form.size
        for name, first, stop in step.parts:
            values[name] = numbers[first] if stop is None else numbers[first:stop]

    def _length(self) -> int:
        self._align(4)
        (length,) = number_struct(self._order, 1, "u4").unpack_from(self._data, self._at)
        self._at += 4
        return int(length)

    def _text(self) -> str:
        piece = bytes(self._take(self._length()))
        return (piece[:-1] if self._aligned and piece.endswith(b"\0") else piece).decode("utf-8", "replace")

    def _take(self, length: int) -> memoryview:
        piece = self._data[self._at : self._at + length]
        if len(piece) != length:
            raise Undecodable("a length in it goes beyond its end")
        self._at += length
        return piece

    def _array(self, step: Array) -> np.ndarray:
        count = self._length() if step.count is None else step.count
        if count:
            self._align(int(step.code[1]))
        return np.frombuffer(self._take(count * int(step.code[1])), self._order + step.code)

    def _many(self, step: Many) -> Any:
        count = self._length() if step.count is None else step.count
        least = max(1, step.layout.least if step.layout else 4)
        if count * least > len(self._data) - self._at + 8:
            raise Undecodable("a count in it goes beyond its end")
        if step.layout is not None:
            dtype = structured(step.layout, self._order, aligned=self._aligned)
            if dtype is not None:
                return self._records(dtype, step.layout, count)
            if step.name in self._numbers_of and count > 2:
                table = self._uniform(step.layout, count)
                if table is not None:
                    return table
        if count > _MOST_LISTED:
            raise Undecodable(f"it holds {count} messages")
        return [self.message(step.layout) if step.layout else self._text() for _ in range(count)]

    def _uniform(self, layout: Layout, count: int) -> np.ndarray | None:
        """Messages whose texts are as long as those of the second one; None: they are not, and nothing was read."""
        start = self._at
        first = self.message(layout)
        second = self._at
        places, lengths = self._places(layout, second)
        stride = self._at - second
        self._at = start
        if not places or (self._aligned and (second % 8 or stride % 8)):
            return None
        if second + (count - 1) * stride > len(self._data):
            return None
        names, formats, offsets = zip(*places, strict=True)
        if len(set(names)) != len(names):
            return None
        kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": stride})
        rest = np.frombuffer(self._data, kind, count - 1, second)
        if any((rest[name] != length).any() for name, length in lengths.items()):
            return None
        table = np.zeros(count, kind)
        table[1:] = rest
        for name in names:
            if name not in lengths:
                table[name][0] = first[name]
        self._at = second + (count - 1) * stride
        return table

    def _places(self, layout: Layout, start: int) -> tuple[list[tuple[str, Any, int]], dict[str, int]]:
        """(name, type, offset) of numbers in the message at the place, and lengths of its texts, by further names."""
        places: list[tuple[str, Any, int]] = []
        lengths: dict[str, int] = {}
        for step in layout.steps:
            if isinstance(step, Run):
                size = int(step.code[1])
                self._align(size)
                for name, at, stop in step.parts:
                    kind = (self._order + step.code, () if stop is None else (stop - at,))
                    places.append((name, kind, self._at + at * size - start))
                self._at += step.count * size
            elif isinstance(step, Text):
                lengths[f"length of {step.name}"] = length = self._length()
                places.append((f"length of {step.name}", f"{self._order}u4", self._at - 4 - start))
                self._at += length
            else:
                return [], {}
        return places, lengths

    def _records(self, dtype: np.dtype[Any], layout: Layout, count: int) -> np.ndarray:
        if not count:
            return np.zeros(0, dtype)
        first = layout.steps[0]
        assert isinstance(first, Run)
        self._align(int(first.code[1]))
        length = (count - 1) * dtype.itemsize + written(dtype)
        piece = self._take(length)
        if length < count * dtype.itemsize:
            whole = np.zeros(count * dtype.itemsize, np.uint8)
            whole[:length] = piece
            return whole.view(dtype)
        return np.frombuffer(piece, dtype)


@functools.lru_cache(maxsize=1000)
def number_struct(order: str, count: int, code: str) -> struct.Struct:
    """What packs so many numbers of a type. order: "<" or ">" """
    return struct.Struct(f"{order}{count}{_LETTERS[code]}")


def written(dtype: np.dtype[Any]) -> int:
    """Bytes up to the end of the last field: nothing pads the last message of a sequence."""
    assert dtype.fields is not None
    return max(kind.itemsize + offset for kind, offset in (each[:2] for each in dtype.fields.values()))


@functools.lru_cache(maxsize=1000)
def structured(layout: Layout, order: str, *, aligned: bool) -> np.dtype[Any] | None:
    """The type of array elements that hold such messages; None: they have no fixed places in them.

    With alignment, places are fixed only where the first field is aligned as strictly as any other.
    """
    runs = [step for step in layout.steps if isinstance(step, Run)]
    if not runs or len(runs) != len(layout.steps):
        return None
    strictest = max(int(run.code[1]) for run in runs) if aligned else 1
    if aligned and int(runs[0].code[1]) != strictest:
        return None
    names, formats, offsets, at = [], [], [], 0
    for run in runs:
        size = int(run.code[1])
        at += -at % size if aligned else 0
        for name, first, stop in run.parts:
            names.append(name)
            formats.append((order + run.code, () if stop is None else (stop - first,)))
            offsets.append(at + first * size)
        at += run.count * size
    if not names or len(set(names)) != len(names):
        return None
    itemsize = at + -at % strictest
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})
