"""Bags as ``ros2 bag record --storage mcap`` writes them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer
from rclpy.qos import QoSProfile

from mdf_core.bag import METADATA_FILE
from mdf_core.errors import OutputFolderError
from mdf_core.files import write_atomically
from mdf_nodes.message_types import MessageDefinition
from mdf_nodes.qos import to_rosbag2

COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}

_METADATA_VERSION = 9
_ROS_DISTRO = "jazzy"
# A scan is a chunk of its own and on disk at once; small messages share one.
_CHUNK_BYTES = 64 * 1024


@dataclass
class _Channel:
    identifier: int
    topic_metadata: dict[str, Any]
    message_count: int = 0


class BagWriter:
    """Writes one bag; ``close`` completes it.

    Once something could not be written nothing more is: the bag can be read up to there.

    Parameters
    ----------
    folder : Path
        The bag; made here.
    compression : str
        One of `COMPRESSIONS`. Noisy coordinates hardly compress.

    Raises
    ------
    OutputFolderError
        The folder exists or cannot be made; also from every other method when the disk is full.
    """

    def __init__(self, folder: Path, compression: str = "none") -> None:
        self._folder = folder
        self._channels: dict[str, _Channel] = {}
        self._extent: tuple[int, int] | None = None  # first and last log time, ns
        if folder.exists():
            raise OutputFolderError("exists already", str(folder), "choose a new folder for the bag")
        with self._output_errors():
            folder.mkdir(parents=True)
            self._path = folder / f"{folder.resolve().name}_0.mcap"
            self._stream = self._path.open("wb")
            self._writer = Writer(
                self._stream, chunk_size=_CHUNK_BYTES, compression=COMPRESSIONS[compression], enable_data_crcs=True
            )
            self._writer.start(profile=Profile.ROS2)
            self._stream.flush()

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(channel.message_count for channel in self._channels.values())

    def add_topic(
        self, name: str, type_name: str, definition: MessageDefinition, offered: Sequence[QoSProfile]
    ) -> None:
        """Announce a topic before its first message; `offered` are the QoS of its publishers."""
        profiles = to_rosbag2(offered)
        with self._writing():
            schema = self._writer.register_schema(type_name, SchemaEncoding.ROS2, definition.text.encode())
            identifier = self._writer.register_channel(
                topic=name,
                message_encoding=MessageEncoding.CDR,
                schema_id=schema,
                metadata={
                    "offered_qos_profiles": yaml.safe_dump(profiles, sort_keys=False),
                    "topic_type_hash": definition.type_hash,
                },
            )
        self._channels[name] = _Channel(
            identifier,
            {
                "name": name,
                "type": type_name,
                "serialization_format": MessageEncoding.CDR,
                "offered_qos_profiles": profiles,
                "type_description_hash": definition.type_hash,
            },
        )

    def write(self, topic: str, raw: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Append one serialized message; of those the death of this process costs the last 64 KiB at most."""
        channel = self._channels[topic]
        with self._writing():
            self._writer.add_message(channel.identifier, log_time_ns, raw, publish_time_ns, channel.message_count)
            self._stream.flush()
        channel.message_count += 1
        first, last = self._extent or (log_time_ns, log_time_ns)
        self._extent = min(first, log_time_ns), max(last, log_time_ns)

    def close(self) -> None:
        """Complete the MCAP file and write the metadata, unless something could not be written."""
        if self._stream.closed:
            return
        with self._writing():
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
        content = yaml.safe_dump(self._metadata(), sort_keys=False)
        write_atomically(self._folder / METADATA_FILE, content.encode())

    def _metadata(self) -> dict[str, Any]:
        return {
            "rosbag2_bagfile_information": {
                "version": _METADATA_VERSION,
                "storage_identifier": "mcap",
                **self._time_and_count(),
                "topics_with_message_count": [
                    {"topic_metadata": channel.topic_metadata, "message_count": channel.message_count}
                    for channel in self._channels.values()
                ],
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [self._path.name],
                "files": [{"path": self._path.name, **self._time_and_count()}],
                "custom_data": None,
                "ros_distro": _ROS_DISTRO,
            }
        }

    def _time_and_count(self) -> dict[str, Any]:
        start, end = self._extent or (0, 0)
        return {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": end - start},
            "message_count": self.message_count,
        }

    @contextmanager
    def _writing(self) -> Iterator[None]:
        with self._output_errors():
            try:
                yield
            except OSError:
                # Nothing may follow half a record, not even what is buffered: no reader would find its way.
                self._stream.raw.close()
                raise

    @contextmanager
    def _output_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputFolderError(
                f"cannot write the bag: {error.strerror}", str(self._folder), "choose a writable folder with free space"
            ) from error
