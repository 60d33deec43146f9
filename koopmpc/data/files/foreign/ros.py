# pyright: basic
"""ROS 2 bags (.db3) and MCAP files (.mcap): a field of a topic's messages is a channel, ``/topic.field``."""

import json
import sqlite3
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import DataError, KoopmpcError, LogError
from koopmpc.data.files.formats import Channel, LogFormat, Recording, Samples, register_format
from koopmpc.data.files.recording import split_recording

EXTRA = "ros"
_NS = 1e-9  # seconds of a nanosecond
_LATE = 2.0  # a message is recorded at most this long after its stamp, compared with the first one [s]
_LONGEST = 64  # elements of an array in a message that become channels; a longer one is an image or a cloud
_SCHEMAS = ("ros2msg", "jsonschema")  # of messages in an MCAP file that are understood

Message = tuple[str, int, Any]  # topic, time [ns], what it holds
Decoder = Callable[[bytes], Any]


@contextmanager
def _explain_damage(file: Path) -> Iterator[None]:
    try:
        yield
    except (KoopmpcError, ModuleNotFoundError):
        raise
    except Exception as error:  # mcap, rosbags and sqlite3 raise errors of their own, and struct.error, KeyError, …
        raise LogError(f"{file} cannot be read as messages: {error}; take another copy") from error


class MessageRecording(Recording):
    """Channels of messages: the numbers in them, by topic and field.

    The time of a sample is the stamp in the message's header if all messages of all topics have one, else the time at
    which the message was recorded. Times count from the first message of the file.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._channels: tuple[Channel, ...] = ()
        with _explain_damage(file):
            counts, self._span_ns = self._survey()
            found: list[Channel] = []
            self._stamped = bool(counts)
            for topic, count in counts.items():
                for _, _, content in islice(self._messages([topic], None, None), 1):
                    found += [Channel(f"{topic}{path}", "", count) for path in flatten(content)]
                    self._stamped = self._stamped and _read_stamp(content) is not None
            self._channels = tuple(found)
            self._zero = self._find_zero(list(counts))

    def channels(self) -> tuple[Channel, ...]:
        """Return the channels of numbers."""
        return self._channels

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s]."""
        return 0.0, (self._span_ns[1] - self._span_ns[0]) * _NS

    def read(
        self, names: Sequence[str], begin: float = -np.inf, end: float = np.inf, count: int | None = None
    ) -> list[Samples]:
        """Return times and values of channels between two times."""
        first, slack = self._span_ns[0], _LATE if self._stamped else 0.0
        low = None if np.isneginf(begin) else first + int((begin - slack) / _NS)
        high = None if np.isposinf(end) else first + int((end + slack) / _NS) + 1
        samples: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in names}
        wanted: dict[str, list[tuple[str, str]]] = {}
        for name in names:
            topic = self._find_topic(name)
            wanted.setdefault(topic, []).append((name, name[len(topic) :]))
        with _explain_damage(self.file):
            for topics in [list(wanted)] if count is None else [[topic] for topic in wanted]:
                for topic, recorded, content in islice(self._messages(topics, low, high), count):
                    stamp = _read_stamp(content) if self._stamped else None
                    time = ((recorded if stamp is None else stamp) - self._zero) * _NS
                    if begin <= time <= end:
                        numbers = flatten(content)
                        for name, path in wanted[topic]:
                            samples[name][0].append(time)
                            samples[name][1].append(numbers.get(path, np.nan))
        return [(np.array(times), np.array(values, dtype=np.float64)) for times, values in samples.values()]

    def _find_zero(self, topics: Sequence[str]) -> int:
        """Return the least first stamp of all topics [ns]; without stamps, the time of the first message."""
        first = [content for topic in topics for *_, content in islice(self._messages([topic], None, None), 1)]
        stamps = [stamp for stamp in map(_read_stamp, first) if stamp is not None]
        return min(stamps) if self._stamped else self._span_ns[0]

    def _find_topic(self, name: str) -> str:
        return max((topic for topic in self._topics() if name.startswith(topic)), key=len)

    @abstractmethod
    def _topics(self) -> Sequence[str]:
        """Return the topics of the file."""

    @abstractmethod
    def _survey(self) -> tuple[dict[str, int], tuple[int, int]]:
        """Return the number of messages of each topic, and the first and last time [ns]."""

    @abstractmethod
    def _messages(self, topics: Sequence[str], begin: int | None, end: int | None) -> Iterator[Message]:
        """Yield the messages of some topics in the order of time."""


class MCAPRecording(MessageRecording):
    """An MCAP file with messages of ROS 2 (CDR) or in JSON."""

    def _topics(self) -> Sequence[str]:
        return self._known

    def _survey(self) -> tuple[dict[str, int], tuple[int, int]]:
        from mcap.reader import make_reader

        self._decoders: dict[int, Decoder] = {}
        with self.file.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
        if summary is None or summary.statistics is None:
            raise LogError(f"{self.file} has no summary at its end: it was cut; `mcap recover` repairs such a file")
        counts: dict[str, int] = {}
        for number, channel in summary.channels.items():
            count = summary.statistics.channel_message_counts.get(number, 0)
            counts[channel.topic] = counts.get(channel.topic, 0) + count
        self._known = list(counts)
        statistics = summary.statistics
        return {t: n for t, n in counts.items() if n}, (statistics.message_start_time, statistics.message_end_time)

    def _messages(self, topics: Sequence[str], begin: int | None, end: int | None) -> Iterator[Message]:
        from mcap.reader import make_reader

        with self.file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(topics=topics, starting_at=begin, ending_before=end):
                if channel.id not in self._decoders:
                    self._decoders[channel.id] = self._find_decoder(schema, channel)
                yield channel.topic, message.log_time, self._decoders[channel.id](message.data)

    def _find_decoder(self, schema: Any, channel: Any) -> Decoder:
        if channel.message_encoding == "json":
            return json.loads
        encoding = "none" if schema is None else schema.encoding
        if schema is None or channel.message_encoding != "cdr" or encoding != "ros2msg":
            raise DataError(
                f"{self.file}: topic {channel.topic} holds {channel.message_encoding} messages with a schema of kind "
                f"{encoding}; koopmpc reads CDR with {_SCHEMAS[0]}, and JSON: record the topic again in one of these"
            )
        return _build_decoder(schema.name, schema.data.decode())


class BagRecording(MessageRecording):
    """The .db3 file of a ROS 2 bag, an SQLite database; it is opened for reading only."""

    def _topics(self) -> Sequence[str]:
        return list(self._decoders)

    def _survey(self) -> tuple[dict[str, int], tuple[int, int]]:
        self._decoders: dict[str, Decoder] = {}
        with closing(self._connect()) as base:
            tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= tables:
                raise LogError(f"{self.file} is a database, but no ROS 2 bag: it has no tables topics and messages")
            texts: dict[str, str] = {}
            if "message_definitions" in tables:
                query = (
                    "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
                )
                texts = dict(base.execute(query))
            for name, kind, form in base.execute("SELECT name, type, serialization_format FROM topics"):
                if form != "cdr":
                    raise DataError(f"{self.file}: topic {name} holds {form} messages; koopmpc reads CDR")
                self._decoders[name] = _build_decoder(kind, texts.get(kind))
            query = (
                "SELECT topics.name, COUNT(*) FROM messages JOIN topics ON topics.id = topic_id GROUP BY topics.name"
            )
            counts = dict(base.execute(query))
            first, last = base.execute("SELECT MIN(timestamp), MAX(timestamp) FROM messages").fetchone()
        return counts, (first or 0, last or 0)

    def _messages(self, topics: Sequence[str], begin: int | None, end: int | None) -> Iterator[Message]:
        marks = ", ".join("?" * len(topics))
        low, high = 0 if begin is None else begin, 2**63 - 1 if end is None else end
        query = (
            "SELECT topics.name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id "
            f"WHERE topics.name IN ({marks}) AND timestamp >= ? AND timestamp < ? ORDER BY timestamp"
        )
        with closing(self._connect()) as base:
            for name, time, data in base.execute(query, (*topics, low, high)):
                yield name, time, self._decoders[name](data)

    def _connect(self) -> sqlite3.Connection:
        base = sqlite3.connect(f"{self.file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        base.execute("PRAGMA trusted_schema = OFF")
        return base


def _build_decoder(kind: str, definition: str | None) -> Decoder:
    """Return the decoder of CDR messages of a type, by its definition or as ROS 2 defines it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if definition is not None:
        known = get_types_from_msg(definition, kind)
        store.register({name: fields for name, fields in known.items() if name not in store.types})
    if kind not in store.types:
        raise DataError(
            f"messages of type {kind} are not among those of ROS 2, and the bag holds no definition of them; record it "
            "as .mcap, which does"
        )
    return partial(_deserialize, store, kind)


def _deserialize(store: Any, kind: str, data: bytes) -> Any:
    return store.deserialize_cdr(data, kind)


def flatten(content: Any, path: str = "") -> dict[str, float]:
    """Return the numbers in a message by their path: ``.field``, ``.field.part``, ``.field.3``."""
    if isinstance(content, bool | int | float | np.bool_ | np.number):
        return {path or ".": float(content)}
    found: dict[str, float] = {}
    if isinstance(content, str | bytes) or content is None:
        return found
    if isinstance(content, list | tuple | np.ndarray):
        if 0 < len(content) <= _LONGEST:
            for i, item in enumerate(content):
                found |= flatten(item, f"{path}.{i}")
        return found
    for name, value in _list_fields(content):
        if not (path == "" and name == "header"):
            found |= flatten(value, f"{path}.{name}")
    return found


def _list_fields(content: Any) -> list[tuple[str, Any]]:
    if isinstance(content, dict):
        return [(str(name), value) for name, value in content.items()]
    return [(name, value) for name, value in vars(content).items() if not name.startswith("__")]


def _read_stamp(content: Any) -> int | None:
    """Return the time in the header of a message [ns]; None where it has none, or it was not set."""
    header = content.get("header") if isinstance(content, dict) else getattr(content, "header", None)
    stamp = header.get("stamp") if isinstance(header, dict) else getattr(header, "stamp", None)
    if stamp is None:
        return None
    fields = dict(_list_fields(stamp)) if not isinstance(stamp, int | float) else {}
    seconds, rest = fields.get("sec"), fields.get("nanosec", fields.get("nsec", 0))
    if not isinstance(seconds, int | np.integer) or (seconds == 0 and rest == 0):
        return None
    return int(seconds) * 1_000_000_000 + int(rest)


register_format(LogFormat((".mcap",), MCAPRecording, parts=partial(split_recording, MCAPRecording), extra=EXTRA))
register_format(LogFormat((".db3",), BagRecording, parts=partial(split_recording, BagRecording), extra=EXTRA))
