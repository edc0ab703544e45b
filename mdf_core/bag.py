"""Recorded bags (MCAP files as rosbag2 writes them), read without ROS."""

from __future__ import annotations

import heapq
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory

from mdf_core.errors import BagFileError, BagTopicError

METADATA_FILE = "metadata.yaml"
"""Beside the MCAP files of a bag folder."""

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"

_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of the content
_MESSAGE_HEAD = struct.Struct("<HIQ")  # channel, sequence, log time
_CHUNK_HEAD = struct.Struct("<Q")  # log time of the first message
_UNREADABLE = (
    McapError,
    ValueError,
    KeyError,
    IndexError,
    RuntimeError,
    struct.error,
    zstandard.ZstdError,
    MemoryError,
    OverflowError,
)


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Attributes
    ----------
    name : str
        Full name, with the leading slash.
    type_name : str
        ``package/msg/Type``.
    offered_qos_profiles : str
        QoS of the recorded publishers as rosbag2 writes it (YAML), empty if the bag does not say.
    """

    name: str
    type_name: str
    offered_qos_profiles: str


@dataclass(frozen=True, eq=False)
class BagMessage:
    """One recorded message, decoded when `message` is asked for.

    Attributes
    ----------
    topic, type_name : str
    raw : bytes
        The serialized message (CDR).
    log_time_ns : int
        When it was recorded, ns since 1970.
    """

    topic: str
    type_name: str
    raw: bytes
    log_time_ns: int
    _decode: Callable[[bytes], Any]

    @cached_property
    def message(self) -> Any:
        """The decoded message: fields as attributes, ``uint8[]`` as bytes.

        Raises
        ------
        BagFileError
            The bytes do not fit the definition in the bag.
        """
        return self._decode(self.raw)


@dataclass(frozen=True)
class _Entry:
    """Where a message or a chunk of messages starts."""

    log_time_ns: int
    offset: int


@dataclass(frozen=True)
class _File:
    """The layout of one MCAP file."""

    path: Path
    entries: tuple[_Entry, ...]
    channels: Mapping[int, Channel]
    schemas: Mapping[int, Schema]
    truncated: bool


@dataclass(frozen=True)
class Bag:
    """An opened bag; the messages stay on disk until they are read.

    Attributes
    ----------
    path : Path
        The bag's folder or single file.
    topics : dict of str to BagTopic
        By full name.
    truncated : bool
        A file ends before its end mark, as after a power cut or a full disk; everything before the cut is read.
    """

    path: Path
    topics: Mapping[str, BagTopic]
    truncated: bool
    _files: tuple[_File, ...]

    def find_topic(self, name: str) -> BagTopic:
        """The topic called `name`, with or without the leading slash.

        Raises
        ------
        BagTopicError
            The bag has no such topic; the message lists those it has.
        """
        topic = self.topics.get("/" + name.lstrip("/"))
        if topic is None:
            raise BagTopicError(f"no topic {name!r}", str(self.path), self._what_it_has)
        return topic

    def find_cloud_topic(self, name: str = "") -> BagTopic:
        """The point cloud topic called `name`; without a name the only one of the bag.

        Raises
        ------
        BagTopicError
            No such topic, another type, or several clouds to choose from.
        """
        clouds = [topic for topic in self.topics.values() if topic.type_name == CLOUD_TYPE]
        if name:
            topic = self.find_topic(name)
            if topic not in clouds:
                raise BagTopicError(
                    f"topic {topic.name} is {topic.type_name}, not {CLOUD_TYPE}",
                    str(self.path),
                    f"choose one of {_listing(clouds)}" if clouds else self._what_it_has,
                )
            return topic
        if not clouds:
            raise BagTopicError("no point cloud topic", str(self.path), self._what_it_has)
        if len(clouds) > 1:
            raise BagTopicError(
                f"{len(clouds)} point cloud topics", str(self.path), f"choose one of {_listing(clouds)}"
            )
        return clouds[0]

    @property
    def _what_it_has(self) -> str:
        return f"the bag has {_listing(self.topics.values()) or 'no topics'}"

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """The messages of `topics` (default: all), ordered by log time, then by place in the bag.

        Raises
        ------
        BagTopicError
            A topic that the bag does not have.
        BagFileError
            Damaged content.

        Notes
        -----
        Cost: one message or chunk in memory at a time; chunks that overlap in time are held together.
        """
        wanted = set(self.topics) if topics is None else {self.find_topic(name).name for name in topics}
        return self._messages(wanted)

    def _messages(self, wanted: set[str]) -> Iterator[BagMessage]:
        # A chunk waits in the queue under its first log time; opened, its messages take its place.
        queue: list[tuple[int, int, int, int, Message | None]] = [
            (entry.log_time_ns, number, entry.offset, -1, None)
            for number, file in enumerate(self._files)
            for entry in file.entries
        ]
        heapq.heapify(queue)
        decoders = [_decoders(file) for file in self._files]
        with ExitStack() as stack:
            streams = [stack.enter_context(file.path.open("rb")) for file in self._files]
            while queue:
                _, number, offset, _, message = heapq.heappop(queue)
                file = self._files[number]
                if message is None:
                    with _unreadable_as_bag_error(file.path):
                        for place, found in enumerate(_messages_at(streams[number], offset)):
                            if file.channels[found.channel_id].topic in wanted:
                                heapq.heappush(queue, (found.log_time, number, offset, place, found))
                    continue
                channel = file.channels[message.channel_id]
                yield BagMessage(
                    channel.topic,
                    file.schemas[channel.schema_id].name if channel.schema_id else "",
                    message.data,
                    message.log_time,
                    decoders[number][channel.id],
                )


def _listing(topics: Iterable[BagTopic]) -> str:
    return ", ".join(f"{topic.name} ({topic.type_name})" for topic in topics)


def open_bag(path: str | Path) -> Bag:
    """The bag in the folder or the single MCAP file `path`.

    Raises
    ------
    BagFileError
        Missing, empty, damaged, or not MCAP.

    Notes
    -----
    Cost: reads the record heads only, except in truncated files with chunks, which are read once.
    """
    path = Path(path)
    files = tuple(_read_layout(file) for file in _find_files(path))
    topics: dict[str, BagTopic] = {}
    for file in files:
        for channel in file.channels.values():
            type_name = file.schemas[channel.schema_id].name if channel.schema_id else ""
            topic = BagTopic(channel.topic, type_name, channel.metadata.get("offered_qos_profiles", ""))
            topics.setdefault(channel.topic, topic)
    return Bag(path, dict(sorted(topics.items())), any(file.truncated for file in files), files)


def _find_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagFileError("no such file or folder", str(path), "check the path")
    metadata = path / METADATA_FILE
    # A recorder that was killed leaves no metadata; its files are read all the same.
    names = _listed_files(metadata) if metadata.is_file() else sorted(file.name for file in path.glob("*.mcap"))
    if not names:
        raise BagFileError("no MCAP file in the folder", str(path), "give the folder of a bag")
    for name in names:
        if not (path / name).is_file():
            raise BagFileError(f"{name} is missing, {METADATA_FILE} lists it", str(path), "copy the whole bag folder")
    return [path / name for name in names]


def _listed_files(metadata: Path) -> list[str]:
    """File names out of metadata.yaml."""
    try:
        information = yaml.safe_load(metadata.read_bytes())["rosbag2_bagfile_information"]
        storage = str(information["storage_identifier"])
        compression = str(information.get("compression_mode") or "")
        names = [str(name) for name in information["relative_file_paths"]]
    except OSError as error:
        raise BagFileError(f"cannot be read: {error.strerror}", str(metadata)) from error
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
        raise BagFileError(
            "not the metadata of a bag", str(metadata), "remove it to read the MCAP files alone"
        ) from None
    if storage != "mcap":
        raise BagFileError(f"storage {storage!r}, not mcap", str(metadata), "convert the bag with `ros2 bag convert`")
    if compression:
        raise BagFileError(
            f"compressed by {compression.lower()} outside MCAP",
            str(metadata),
            "convert the bag with `ros2 bag convert`",
        )
    return names


@contextmanager
def _unreadable_as_bag_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BagFileError(
            f"cannot be read: {error.strerror}", str(path), "check the disk and the permissions"
        ) from error
    except _UNREADABLE as error:
        raise BagFileError(
            f"damaged: {str(error) or type(error).__name__}", str(path), "restore the file from a copy"
        ) from error


def _read_layout(path: Path) -> _File:
    with _unreadable_as_bag_error(path), path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if stream.read(MAGIC_SIZE) != MCAP0_MAGIC:
            raise BagFileError("not an MCAP file" if size else "empty file", str(path), "give a bag recorded as MCAP")
        walk = _walk(stream, size)
        stream.seek(-MAGIC_SIZE, os.SEEK_END)
        closed = size > MAGIC_SIZE and stream.read() == MCAP0_MAGIC
        if closed and not walk.complete:
            raise BagFileError("damaged: its records do not join up", str(path), "restore the file from a copy")
        stream.seek(0)
        summary = SeekingReader(stream).get_summary() if closed else None
        # Recorders may be told to repeat the channels there and not the schemas.
        if summary is not None and summary.channels and not _without_schema(summary.channels, summary.schemas):
            walk.channels.update(summary.channels)
            walk.schemas.update(summary.schemas)
        else:
            _look_into_chunks(stream, walk, closed)
    for topic in _without_schema(walk.channels, walk.schemas):
        raise BagFileError(f"damaged: {topic} has no schema", str(path), "restore the file from a copy")
    return _File(path, tuple(walk.entries), walk.channels, walk.schemas, not closed)


def _without_schema(channels: dict[int, Channel], schemas: dict[int, Schema]) -> list[str]:
    """Topics whose channels name a schema that is not among the `schemas`."""
    return [channel.topic for channel in channels.values() if channel.schema_id not in {0, *schemas}]


@dataclass
class _Walk:
    """What lies in a file up to the end of its data or up to a cut."""

    entries: list[_Entry] = field(default_factory=list)
    chunks: list[_Entry] = field(default_factory=list)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    complete: bool = False


def _walk(stream: IO[bytes], size: int) -> _Walk:
    """Go from record head to record head."""
    walk = _Walk()
    offset = MAGIC_SIZE
    while offset + _RECORD_HEAD.size <= size:
        stream.seek(offset)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        end = offset + _RECORD_HEAD.size + length
        # No record has opcode 0: zeros are what a power cut leaves of a file's tail.
        if opcode == 0 or end > size:
            break
        if opcode == Opcode.DATA_END:
            walk.complete = True
            break
        if opcode == Opcode.MESSAGE:
            _, _, log_time = _MESSAGE_HEAD.unpack(stream.read(_MESSAGE_HEAD.size))
            walk.entries.append(_Entry(log_time, offset))
        elif opcode == Opcode.CHUNK:
            (log_time,) = _CHUNK_HEAD.unpack(stream.read(_CHUNK_HEAD.size))
            walk.entries.append(_Entry(log_time, offset))
            walk.chunks.append(walk.entries[-1])
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(stream))
            walk.channels[channel.id] = channel
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(stream))
            walk.schemas[schema.id] = schema
        offset = end
    return walk


def _look_into_chunks(stream: IO[bytes], walk: _Walk, closed: bool) -> None:
    """Collect the channels and schemas that only the chunks hold."""
    for entry in walk.chunks:
        try:
            records = _records_at(stream, entry.offset)
        except _UNREADABLE:
            if closed:
                raise
            # The file system kept the chunk's place but not its content: the cut is here.
            walk.entries = [kept for kept in walk.entries if kept.offset < entry.offset]
            return
        walk.channels.update({record.id: record for record in records if isinstance(record, Channel)})
        walk.schemas.update({record.id: record for record in records if isinstance(record, Schema)})


def _records_at(stream: IO[bytes], offset: int) -> list[Any]:
    """The record at `offset`, or the records of the chunk there."""
    stream.seek(offset)
    record = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]


def _messages_at(stream: IO[bytes], offset: int) -> list[Message]:
    return [record for record in _records_at(stream, offset) if isinstance(record, Message)]


def _decoders(file: _File) -> dict[int, Callable[[bytes], Any]]:
    """Per channel, a function from serialized to decoded messages."""
    factory = DecoderFactory()

    def decoder(channel: Channel) -> Callable[[bytes], Any]:
        def decode(raw: bytes) -> Any:
            try:
                decode_fields = factory.decoder_for(channel.message_encoding, file.schemas.get(channel.schema_id))
            except Exception as error:  # whatever the parser of definitions comes across
                raise BagFileError(
                    f"damaged: the definition of {channel.topic}: {error}", str(file.path), "restore it from a copy"
                ) from error
            if decode_fields is None:
                raise BagFileError(
                    f"topic {channel.topic} is not CDR with a ros2msg definition",
                    str(file.path),
                    "record it with ROS 2",
                )
            with _unreadable_as_bag_error(file.path):
                return decode_fields(raw)

        return decode

    return {channel.id: decoder(channel) for channel in file.channels.values()}
