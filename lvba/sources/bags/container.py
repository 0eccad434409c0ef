"""What the three kinds of bags have in common: topics, and messages in the order in which they were recorded."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple, Protocol

MAX_MESSAGE = 1024**3
"""bytes; of one message, or one compressed piece of a file, as stored or unpacked."""


class Encoding(StrEnum):
    """How the bytes of a message are laid out."""

    ROS1 = "ros1"
    CDR = "cdr"
    OTHER = "other"


@dataclass(frozen=True)
class Topic:
    """A topic, or the messages of one type and definition in it.

    message_type: as in ROS 2, for both: sensor_msgs/msg/PointCloud2
    definition: text of the message's fields and of what they hold; "": the bag has none
    count: messages; None: unknown until all are read
    first, last: ns, when the recorder got the first and last message; None: unknown
    """

    name: str
    message_type: str
    encoding: Encoding
    definition: str = ""
    count: int | None = None
    first: int | None = None
    last: int | None = None


class Message(NamedTuple):
    """A message. time: ns, when the recorder got it"""

    topic: Topic
    time: int
    data: bytes | memoryview


@dataclass(frozen=True)
class Contents:
    """What a file holds. format: for people; notes: what is unusual or lost, one sentence each"""

    format: str
    topics: tuple[Topic, ...]
    notes: tuple[str, ...] = ()


@dataclass
class Losses:
    """What a pass could not read, counted by sentence."""

    counts: Counter[str] = field(default_factory=Counter)

    def add(self, sentence: str, count: int = 1) -> None:
        """One more of what the sentence says."""
        if (
            sentence in self.counts or len(self.counts) < 200
        ):  # reasons may quote what is in a file of strangers
            self.counts[sentence] += count

    def sentences(self) -> tuple[str, ...]:
        """Each with how often, where more than once."""
        return tuple(text if count == 1 else f"{text} ({count} times)" for text, count in self.counts.items())


class Container(Protocol):
    """An open file of a bag, or several of one."""

    path: Path

    def contents(self) -> Contents:
        """By its index, where it has one.

        Raises InputError: it is damaged past use.
        """

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """Those of the topics of these names, as they were recorded; what is damaged goes to `losses`."""


def type_name(name: str) -> str:
    """sensor_msgs/Image and sensor_msgs/msg/Image are sensor_msgs/msg/Image."""
    parts = [part for part in name.split("/") if part]
    return "/".join([parts[0], "msg", parts[-1]]) if len(parts) > 1 else name
