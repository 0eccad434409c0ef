"""Named values as the bytes of messages: what `layout.decode` reads."""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from lvba.sources.bags.container import Encoding
from lvba.sources.bags.layout import Array, Layout, Run, Text, number_struct, structured, written


def encode(layout: Layout, values: Mapping[str, Any], encoding: Encoding) -> bytes:
    """The bytes of a message, little endian; what has no value is zero, or empty.

    values: as `layout.decode` gives them; of messages whose fields are all numbers, a structured array of `record_type`
    """
    writer = _Writer(aligned=encoding is Encoding.CDR)
    writer.message(layout, values)
    head = b"\0\1\0\0" if encoding is Encoding.CDR else b""
    return head + b"".join(writer.pieces)


def record_type(layout: Layout, name: str, encoding: Encoding) -> np.dtype[Any]:
    """The type of the array that a sequence of messages is written from: those that the field of this name holds."""
    inner = next(step.layout for step in layout.steps if getattr(step, "name", "") == name)  # type: ignore[union-attr]
    kind = structured(inner, "<", aligned=encoding is Encoding.CDR) if inner else None
    assert kind is not None, f"{name} is no sequence of messages of numbers"
    return kind


class _Writer:
    """Pieces of a message so far, and their length."""

    def __init__(self, *, aligned: bool) -> None:
        self.pieces: list[bytes] = []
        self._aligned, self._at = aligned, 0

    def message(self, layout: Layout, values: Mapping[str, Any]) -> None:
        """The values of one message."""
        for step in layout.steps:
            if isinstance(step, Run):
                self._run(step, values)
            elif isinstance(step, Text):
                self._text(values.get(step.name, ""))
            elif isinstance(step, Array):
                array = np.asarray(values.get(step.name, np.zeros(step.count or 0)), f"<{step.code}")
                self._count(step.count, array)
                if array.size:
                    self._align(int(step.code[1]))
                self._put(array.tobytes())
            else:
                self._many(step.layout, step.count, values.get(step.name, ()))

    def _put(self, piece: bytes) -> None:
        self.pieces.append(piece)
        self._at += len(piece)

    def _align(self, size: int) -> None:
        if self._aligned and self._at % size:
            self._put(bytes(-self._at % size))

    def _run(self, step: Run, values: Mapping[str, Any]) -> None:
        numbers: list[Any] = [0] * step.count
        for name, first, stop in step.parts:
            if name not in values:
                continue
            if stop is None:
                numbers[first] = values[name]
            else:
                numbers[first:stop] = list(values[name])
        self._align(int(step.code[1]))
        self._put(number_struct("<", step.count, step.code).pack(*numbers))

    def _count(self, fixed: int | None, items: Any) -> None:
        if fixed is None:
            self._align(4)
            self._put(struct.pack("<I", len(items)))

    def _text(self, text: str) -> None:
        piece = text.encode() + (b"\0" if self._aligned else b"")
        self._align(4)
        self._put(struct.pack("<I", len(piece)) + piece)

    def _many(self, layout: Layout | None, fixed: int | None, items: Any) -> None:
        self._count(fixed, items)
        if isinstance(items, np.ndarray):
            assert layout is not None
            assert isinstance(layout.steps[0], Run)
            if len(items):
                self._align(int(layout.steps[0].code[1]))
                self._put(items.tobytes()[: (len(items) - 1) * items.itemsize + written(items.dtype)])
            return
        for item in items:
            if layout is None:
                self._text(item)
            else:
                self.message(layout, item)
