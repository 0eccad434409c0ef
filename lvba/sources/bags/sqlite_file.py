"""SQLite files of ROS 2 bags. Source: the tables of rosbag2_storage_default_plugins (sqlite_storage.cpp)."""

import contextlib
import os
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from lvba.errors import InputError
from lvba.io import files, no_links
from lvba.sources.bags.compression import Damaged, Unpacker
from lvba.sources.bags.container import MAX_MESSAGE, Contents, Encoding, Losses, Message, Topic, type_name
from lvba.sources.bags.definitions import MAX_TEXT

MAGIC = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_COUNTED = 3_000_000
"""Messages; counting more would read the file for minutes."""
_MOST_TOPICS = 100_000
_PRAGMAS = ("trusted_schema=OFF", "cell_size_check=ON", "mmap_size=0", "query_only=ON", "writable_schema=ON")
"""The last one, in a file that nothing can be written to, has SQLite read files that are shorter than they say."""
_MEND = "copy it again, or save what is left by `sqlite3 FILE .recover`"


class SqliteFile:
    """One file with the tables topics and messages."""

    def __init__(self, path: Path) -> None:
        self.path = path
        files.size(path, 2**63)
        self._topics: dict[int, Topic] | None = None
        self._notes: tuple[str, ...] = ()

    def contents(self) -> Contents:
        """By its tables; messages are counted where they are not too many.

        Raises InputError: it is no such file, or damaged.
        """
        if self._topics is None:
            with self._opened() as database:
                self._topics, self._notes = self._read_topics(database)
        return Contents("ROS 2 bag (sqlite3)", tuple(self._topics.values()), self._notes)

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """Those of the topics of these names, in the order in which they were written."""
        self.contents()
        topics = self._topics or {}
        wanted = sorted(number for number, topic in topics.items() if topic.name in names)
        unpacker = Unpacker(self.path)
        with self._opened() as database:
            try:
                marks = ",".join("?" * len(wanted))
                rows = database.execute(
                    "SELECT topic_id, timestamp, data FROM messages NOT INDEXED"
                    f" WHERE topic_id IN ({marks}) ORDER BY rowid",
                    wanted,
                )
                for number, time, data in rows:
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        losses.add(f"{self.path.name}: a row has no time or no bytes")
                        continue
                    try:
                        yield Message(topics[number], time, _plain(data, unpacker))
                    except Damaged as error:
                        losses.add(f"{self.path.name}: a message cannot be unpacked: {error}")
            except (sqlite3.Error, OverflowError) as error:
                losses.add(f"{self.path.name}: the rest of the file is lost: {error}")

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """The file, which nothing can be written to, and whose schema runs nothing."""
        if no_links.are_refused(self.path):
            os.close(no_links.descriptor(self.path))
        try:
            where = quote(os.fsencode(self.path.absolute()))
            database = sqlite3.connect(f"file:{where}?mode=ro&immutable=1", uri=True)
        except sqlite3.Error as error:
            raise InputError(self.path, f"cannot be opened ({error})", _MEND) from error
        try:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE)
            database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            database.text_factory = lambda text: text[: MAX_TEXT + 1].decode("utf-8", "replace")
            for pragma in _PRAGMAS:
                database.execute(f"PRAGMA {pragma}")
            yield database
        except sqlite3.Error as error:
            raise InputError(self.path, f"is damaged or no SQLite file ({error})", _MEND) from error
        finally:
            database.close()

    def _read_topics(self, database: sqlite3.Connection) -> tuple[dict[int, Topic], tuple[str, ...]]:
        tables = dict(database.execute("SELECT name, type FROM sqlite_master LIMIT 1000").fetchall())
        if tables.get("topics") != "table" or tables.get("messages") != "table":
            mend = "; ".join(self._left_beside()) or "give the .db3 file of a ROS 2 bag"
            raise InputError(self.path, "has no tables of topics and messages", mend)
        computed = "SELECT COUNT(*) FROM pragma_table_xinfo(?) WHERE hidden"
        if any(database.execute(computed, (name,)).fetchone()[0] for name in ("topics", "messages")):
            raise InputError(self.path, "has columns that are computed", "give the .db3 file of a ROS 2 bag")
        rows = database.execute(
            f"SELECT id, name, type, serialization_format FROM topics LIMIT {_MOST_TOPICS}"
        ).fetchall()
        definitions = _definitions(database) if tables.get("message_definitions") == "table" else {}
        spans: dict[int, tuple[int, int, int]] = {}
        notes = self._left_beside()
        counted, more = self._counted(database)
        spans.update(counted)
        notes += more
        topics = {}
        for number, name, kind, encoding in rows:
            if not isinstance(number, int):
                continue
            message_type = type_name(str(kind))
            layout = Encoding.CDR if encoding == "cdr" else Encoding.OTHER
            count, first, last = spans.get(number, (0 if spans else None, None, None))
            text = definitions.get(message_type, "")
            topics[number] = Topic(
                name=str(name),
                message_type=message_type,
                encoding=layout,
                definition=text,
                count=count,
                first=first,
                last=last,
            )
        return topics, notes

    def _left_beside(self) -> tuple[str, ...]:
        """What a recorder that was killed had not moved into the file."""
        beside = Path(f"{self.path}-wal")
        if not beside.exists() or not files.size(beside, 2**63):
            return ()
        mend = f"run `sqlite3 {self.path.name} 'PRAGMA wal_checkpoint'` on a copy to have them"
        return (f"{beside.name} holds messages that are not read: {mend}",)

    def _counted(
        self, database: sqlite3.Connection
    ) -> tuple[dict[int, tuple[int, int, int]], tuple[str, ...]]:
        query = "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages NOT INDEXED GROUP BY topic_id"
        try:
            (most,) = database.execute("SELECT MAX(rowid) FROM messages").fetchone()
            rows = (
                database.execute(query).fetchall() if isinstance(most, int) and most <= _MOST_COUNTED else []
            )
        except sqlite3.DatabaseError as error:
            return {}, (f"{self.path.name} is damaged: messages cannot be counted ({error})",)
        return {
            number: (count, first, last)
            for number, count, first, last in rows
            if isinstance(first, int) and isinstance(last, int)
        }, ()


def _definitions(database: sqlite3.Connection) -> dict[str, str]:
    rows = database.execute(
        "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT 10000"
    )
    return {
        type_name(str(kind)): text
        for kind, encoding, text in rows
        if encoding == "ros2msg" and isinstance(text, str)
    }


def _plain(data: bytes, unpacker: Unpacker) -> bytes:
    """A message; those of a bag that compresses each by itself begin as zstd does, and never as CDR does."""
    return unpacker.unpack("zstd", data, MAX_MESSAGE) if data.startswith(_ZSTD) else data
