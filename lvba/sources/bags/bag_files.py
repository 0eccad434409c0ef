"""The files of a bag: which belong to it, and their messages as one sequence."""

import contextlib
import heapq
import os
import tempfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from lvba.errors import InputError
from lvba.io import bags, files, plain_yaml
from lvba.sources.bags import mcap_file, ros1, sqlite_file
from lvba.sources.bags.compression import zstd_module
from lvba.sources.bags.container import (
    MAX_MESSAGE,
    Container,
    Contents,
    Encoding,
    Losses,
    Message,
    Topic,
    type_name,
)

_RECORDING = {"all_pcd_body", "pcd", "Log"}
"""Folders of a recording, beside which its bag may lie."""
_MAX_METADATA = 1024**2
_PIECE = 4 * 1024**2
_MAGICS: tuple[tuple[bytes, Callable[[Path], Container]], ...] = (
    (b"#ROSBAG ", ros1.Ros1Bag),
    (mcap_file.MAGIC[:5], mcap_file.McapFile),
    (sqlite_file.MAGIC, sqlite_file.SqliteFile),
)
_MAKERS: dict[str, Callable[[Path], Container]] = {
    bags.ROS1: ros1.Ros1Bag,
    bags.MCAP: mcap_file.McapFile,
    bags.ROS2: sqlite_file.SqliteFile,
}


def container_at(path: Path) -> Container | None:
    """What reads the bag at a path: a file, or a folder with the files of one. None: it is no bag.

    Raises InputError: a file that belongs to it is missing, or is not a bag file.
    """
    if not os.path.isdir(path):
        return _file(path)
    names = files.names_in(path)
    there = [name for name in names if bags.kind_of_name(name)]
    if _RECORDING & set(names):
        return None
    about = _metadata(path) if bags.METADATA in names and (there or _is_of_bag(path)) else {}
    members = [Path(str(name)).name for name in _list(about.get("relative_file_paths"))] or there
    if not members:
        return None
    for name in members:
        if name not in names:
            raise InputError(path / name, f"is named in {bags.METADATA}, and missing", "put it there")
    containers = [_file(path / name) for name in members]
    several = [each for each in containers if each is not None]
    if not several:
        raise InputError(path / members[0], "is not a bag file", "copy it again")
    return BagFiles(path, several, _topics(about))


def needs_all(path: Path, start: bytes) -> bool:
    """Whether nothing can be said of a file by its begin and end: its tables, or what is compressed, lie all over it."""
    kind, packed = bags.kind_of_name(path.name), bags.is_packed(path.name)
    return packed or kind == bags.ROS2 or start.startswith(sqlite_file.MAGIC)


def topics_said(folder: Path) -> tuple[Topic, ...]:
    """Topics and counts by the metadata of a ROS 2 bag; none: it has no such file.

    Raises InputError: the file is damaged.
    """
    return _topics(_metadata(folder)) if bags.METADATA in files.names_in(folder) else ()


def _file(path: Path) -> Container | None:
    if bags.is_packed(path.name):
        return PackedFile(path)
    maker = _MAKERS.get(bags.kind_of_name(path.name))
    if maker is None and os.path.isfile(path):
        start = files.open_binary(path)
        with start, files.as_input_error(path):
            first = start.read(16)
        maker = next((make for magic, make in _MAGICS if first.startswith(magic)), None)
    return maker(path) if maker else None


def _metadata(folder: Path) -> dict[str, Any]:
    """What a ROS 2 bag says of itself; {} where the file is of something else."""
    path = folder / bags.METADATA
    whole = plain_yaml.load(files.read_text(path, _MAX_METADATA), path, "give one of its files instead")
    about = whole.get("rosbag2_bagfile_information") if isinstance(whole, dict) else None
    return about if isinstance(about, dict) else {}


def _is_of_bag(folder: Path) -> bool:
    """Whether the metadata of a folder are those of a bag, although none of its files is there."""
    try:
        return bool(_metadata(folder))
    except InputError:
        return False


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _topics(about: dict[str, Any]) -> tuple[Topic, ...]:
    """Topics with the counts that the bag says it has."""
    topics = []
    for each in _list(about.get("topics_with_message_count")):
        topic = each.get("topic_metadata") if isinstance(each, dict) else None
        count = each.get("message_count") if isinstance(each, dict) else None
        if isinstance(topic, dict) and isinstance(count, int):
            encoding = Encoding.CDR if topic.get("serialization_format") == "cdr" else Encoding.OTHER
            kind = type_name(str(topic.get("type")))
            topics.append(
                Topic(name=str(topic.get("name")), message_type=kind, encoding=encoding, count=count)
            )
    return tuple(topics)


class BagFiles:
    """Several files, read as one; said: topics by metadata.yaml, for what the files themselves do not tell."""

    def __init__(self, path: Path, containers: list[Container], said: tuple[Topic, ...] = ()) -> None:
        self.path = path
        self._containers = containers
        self._said = said

    def contents(self) -> Contents:
        """Of all files together."""
        packed = all(isinstance(each, PackedFile) for each in self._containers)
        if packed and self._said:
            return Contents(f"ROS 2 bag ({len(self._containers)} files compressed by zstd)", self._said)
        all_contents = [each.contents() for each in self._containers]
        topics = [topic for each in all_contents for topic in each.topics]
        notes = tuple(note for each in all_contents for note in each.notes)
        form = all_contents[0].format
        if len(all_contents) > 1:
            form += f", {len(all_contents)} files"
        counts = {topic.name: topic.count for topic in self._said}
        known = tuple(
            replace(topic, count=counts.get(topic.name)) if topic.count is None else topic for topic in topics
        )
        return Contents(form, known if len(all_contents) == 1 else tuple(topics), notes)

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """By the time of recording: a file is opened when its first message is due."""
        starts = [self._start(each) for each in self._containers]
        if len(starts) == 1 or any(start is None for start in starts):
            for container in self._containers:
                yield from container.messages(names, losses)
            return
        order = sorted(range(len(starts)), key=lambda index: (starts[index] or 0, index))
        pending = [(starts[index] or 0, index) for index in order][::-1]
        heap: list[tuple[int, int, Message, Iterator[Message]]] = []
        while pending or heap:
            if pending and (not heap or pending[-1][0] <= heap[0][0]):
                index = pending.pop()[1]
                _advance(heap, index, self._containers[index].messages(names, losses))
                continue
            _, index, message, rest = heapq.heappop(heap)
            yield message
            _advance(heap, index, rest)

    def _start(self, container: Container) -> int | None:
        """When the first message of a file came, ns."""
        if isinstance(container, PackedFile):
            return None
        firsts = [topic.first for topic in container.contents().topics if topic.first is not None]
        return min(firsts, default=None)


def _advance(
    heap: list[tuple[int, int, Message, Iterator[Message]]], index: int, rest: Iterator[Message]
) -> None:
    message = next(rest, None)
    if message is not None:
        heapq.heappush(heap, (message.time, index, message, rest))


class PackedFile:
    """A file that is compressed as a whole: it is unpacked to a temporary file when it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        files.size(path, 2**63)

    def contents(self) -> Contents:
        """Of the file in it."""
        with self._unpacked() as file, self._named(file):
            contents = self._inner(file).contents()
        notes = tuple(self._renamed(note, file) for note in contents.notes)
        return replace(contents, notes=notes)

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """Of the file in it."""
        inner = Losses()
        with self._unpacked() as file, self._named(file):
            yield from self._inner(file).messages(names, inner)
        for sentence, count in inner.counts.items():
            losses.add(self._renamed(sentence, file), count)

    @contextlib.contextmanager
    def _named(self, file: Any) -> Iterator[None]:
        """Errors name this file, not the temporary one."""
        try:
            yield
        except InputError as error:
            raise InputError(self.path, self._renamed(error.problem, file), error.mend) from error

    def _renamed(self, text: str, file: Any) -> str:
        return text.replace(Path(file.name).name, self.path.name)

    def _inner(self, file: Any) -> Container:
        inner = _file(Path(file.name))
        if inner is None:
            raise InputError(self.path, "holds no bag", "copy it again")
        return inner

    def _unpacked(self) -> Any:
        """The temporary file."""
        zstd = zstd_module(self.path)
        suffix = self.path.name.partition(".zst")[0][-30:]
        file = tempfile.NamedTemporaryFile(suffix=suffix)  # noqa: SIM115 (the caller closes it)
        try:
            with files.open_binary(self.path) as packed, files.as_input_error(self.path):
                self._copy(packed, file, zstd)
                file.flush()
        except BaseException:
            file.close()
            raise
        return file

    def _copy(self, packed: IO[bytes], file: IO[bytes], zstd: Any) -> None:
        allowed = MAX_MESSAGE + 1000 * files.size(self.path, 2**63)
        unpacker = zstd.ZstdDecompressor()
        while piece := packed.read(_PIECE):
            while piece or not unpacker.needs_input:
                try:
                    unpacked = unpacker.decompress(piece, max_length=_PIECE)
                except (zstd.ZstdError, EOFError) as error:
                    raise InputError(self.path, "cannot be unpacked", "copy it again") from error
                allowed -= file.write(unpacked)
                if allowed < 0:
                    raise InputError(
                        self.path, "unpacks to more than a thousand times its size", "check what it is"
                    )
                piece = b""
                if unpacker.eof:
                    piece = unpacker.unused_data
                    unpacker = zstd.ZstdDecompressor()
                    if not piece:
                        break
