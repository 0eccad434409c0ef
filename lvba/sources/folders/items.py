"""A folder as a source: records that are loaded one at a time, in time order."""

import os
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.source import Kind, KnownGeometry, Record, SourceDescription, Stream

_ORDER = (Kind.POSES, Kind.IMU, Kind.GNSS, Kind.SCANS, Kind.IMAGES)
"""Of records of one time."""


@dataclass(frozen=True)
class Item:
    """A record that is not loaded yet. stamp: ns; path: its file, "" where it is at hand"""

    stamp: int
    stream: str
    load: Callable[[], Record]
    path: str = ""


@dataclass(frozen=True)
class StreamKind:
    """What a folder has of one sensor: name of the stream, kind, what its files are, "name type" of fields of points."""

    name: str
    kind: Kind
    message_type: str
    fields: tuple[str, ...] = ()


XYZ = ("x float32", "y float32", "z float32")


class FolderSource:
    """A folder of another program.

    All names of files, poses and times are read when it is opened; scans and images one at a time.
    """

    def __init__(
        self,
        path: Path,
        form: str,
        streams: Iterable[StreamKind],
        items: Iterable[Item],
        known: KnownGeometry,
        notes: Iterable[str] = (),
    ) -> None:
        """form: for people, "TUM RGB-D folder"; the other arguments are as of the classes they are of."""
        streams = tuple(streams)
        kinds = {stream.name: stream.kind for stream in streams}
        self._items = sorted(items, key=lambda item: (item.stamp, _ORDER.index(kinds[item.stream])))
        self._known = known
        self._losses: tuple[str, ...] = ()
        self._description = SourceDescription(
            path=str(path),
            format=form,
            size=_total(self._items),
            streams=tuple(self._stream(stream) for stream in streams),
            notes=tuple(notes),
        )

    def describe(self) -> SourceDescription:
        """What the folder holds."""
        return self._description

    def geometry(self) -> KnownGeometry:
        """What the folder's files say of the rig, by the convention of its format."""
        return self._known

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """Those of the streams of these names, in time order; a file that cannot be decoded is counted in `losses`.

        Raises: the first InputError, when more than half of a stream cannot be decoded.
        """
        counts = {stream.name: stream.count or 0 for stream in self._description.streams}
        failed: dict[str, list[InputError]] = {}
        self._losses = ()
        for item in self._items:
            if item.stream not in streams:
                continue
            try:
                record = item.load()
            except InputError as error:
                errors = failed.setdefault(item.stream, [])
                errors.append(error)
                if 2 * len(errors) > counts[item.stream]:
                    raise errors[0] from error
                continue
            yield item.stream, record
        self._losses = tuple(
            f"{len(errors)} of {counts[name]} records of {name} could not be decoded; the first: {errors[0]}"
            for name, errors in failed.items()
        )

    def losses(self) -> tuple[str, ...]:
        """What the last pass could not decode."""
        return self._losses

    def _stream(self, stream: StreamKind) -> Stream:
        stamps = [item.stamp for item in self._items if item.stream == stream.name]
        return Stream(
            name=stream.name,
            kind=stream.kind,
            message_type=stream.message_type,
            count=len(stamps),
            first=stamps[0] if stamps else None,
            last=stamps[-1] if stamps else None,
            fields=stream.fields,
        )


def _total(items: Iterable[Item]) -> int:
    total = 0
    for path in {item.path for item in items if item.path}:
        try:
            total += os.stat(path).st_size
        except OSError:
            continue  # reading it will tell
    return total


def at_hand(stamp: int, stream: str, record: Record) -> Item:
    """An item of a record that is loaded already. stamp: ns"""
    return Item(stamp, stream, lambda: record)


def need_folder(path: Path, mend: str) -> None:
    """Passes if there is such a folder. Raises: InputError if not."""
    if not os.path.isdir(path):
        raise InputError(path, "there is no such folder", mend)


def numbered(folder: Path, suffixes: tuple[str, ...], prefix: str = "", part: str = "") -> dict[int, Path]:
    """Files whose names begin so and have that part, by the last number in them, in the order of the numbers.

    Of files that differ by their suffix alone, the first is taken.
    Raises: InputError if the folder cannot be read, or two files have the same number.
    """
    paths: dict[int, Path] = {}
    for name in files.names_in(folder):
        stem, suffix = os.path.splitext(name)
        digits = _last_digits(stem)
        wanted = name.startswith(prefix) and part in name and not name.startswith(".")
        if digits and wanted and suffix.lower() in suffixes:
            first = paths.setdefault(int(digits), folder / name)
            if first.stem != stem:
                problem = (
                    f"both {first.name} and {name} have the number {int(digits)}, the last in their names"
                )
                raise InputError(folder, problem, "give each file a number of its own")
    return dict(sorted(paths.items()))


def _last_digits(stem: str) -> str:
    end = len(stem)
    while end and not ("0" <= stem[end - 1] <= "9"):
        end -= 1
    start = end
    while start and "0" <= stem[start - 1] <= "9":
        start -= 1
    return stem[start:end][:18]


def files_of_times(folder: Path, suffixes: tuple[str, ...], count: int, times: Path) -> dict[int, Path]:
    """`numbered` files, each of which has one of the times.

    count: of the times in the file `times`
    Raises: InputError if there are none, or one has no time.
    """
    paths = numbered(folder, suffixes)
    if not paths:
        raise InputError(folder, f"holds no files ({', '.join(suffixes)})", "unpack the data there")
    if max(paths) >= count:
        raise InputError(times, f"has {count} times, but there is file {max(paths)}", "copy it again")
    return paths
