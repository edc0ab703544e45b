"""Bags are read without ROS, as far as they go, and say what is wrong with them."""

from __future__ import annotations

import io
import struct
import tracemalloc
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from mdf_core.bag import Bag, open_bag
from mdf_core.errors import BagFileError, BagTopicError, MdfError

Entry = tuple[str, int, bytes]  # topic, log time, serialized message

TYPES = {"/cell/part_id": "std_msgs/msg/String", "/points": "sensor_msgs/msg/PointCloud2"}
DEFINITIONS = {
    "std_msgs/msg/String": "string data\n",
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
        f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        f"{'=' * 80}\nMSG: sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
}
STORE = get_typestore(Stores.ROS2_JAZZY)


def string(text: str) -> bytes:
    """A serialized std_msgs/String."""
    return b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def entries(count: int, filler: int = 0) -> list[Entry]:
    return [("/cell/part_id", 1000 + 10 * i, string(f"part {i:03d}" + "." * filler)) for i in range(count)]


def mcap_bytes(messages: Iterable[Entry], topics: Sequence[str] = tuple(TYPES), **options: object) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, **{"compression": CompressionType.NONE} | options)
    writer.start(profile="ros2")
    channels = {}
    for topic in topics:
        type_name = TYPES[topic]
        schema = writer.register_schema(type_name, "ros2msg", DEFINITIONS[type_name].encode())
        channels[topic] = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": f"# {topic}"})
    for topic, log_time, raw in messages:
        writer.add_message(channels[topic], log_time, raw, log_time)
    writer.finish()
    return stream.getvalue()


def write_bag(folder: Path, *files: bytes, **metadata: object) -> Path:
    folder.mkdir()
    names = [f"bag_{number}.mcap" for number in range(len(files))]
    for name, content in zip(names, files, strict=True):
        (folder / name).write_bytes(content)
    information = {"version": 9, "storage_identifier": "mcap", "relative_file_paths": names} | metadata
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return folder


def contents(bag: Bag) -> list[Entry]:
    return [(message.topic, message.log_time_ns, message.raw) for message in bag.messages()]


LAYOUTS = [
    pytest.param({"use_chunking": False}, id="no chunks"),
    pytest.param({"chunk_size": 100}, id="chunks"),
    pytest.param({"chunk_size": 100, "compression": CompressionType.LZ4}, id="lz4"),
    pytest.param({"chunk_size": 100, "compression": CompressionType.ZSTD}, id="zstd"),
    pytest.param({"chunk_size": 100, "repeat_channels": False, "repeat_schemas": False}, id="bare summary"),
    pytest.param({"chunk_size": 100, "repeat_schemas": False}, id="summary without schemas"),
    pytest.param({"chunk_size": 100, "repeat_channels": False}, id="summary without channels"),
]


@pytest.mark.parametrize("options", LAYOUTS)
def test_every_layout_of_mcap_gives_the_same_messages(tmp_path: Path, options: dict[str, object]) -> None:
    written = entries(20)
    bag = open_bag(write_bag(tmp_path / "bag", mcap_bytes(written, **options)))
    assert contents(bag) == written
    assert not bag.truncated
    assert {topic.name: topic.type_name for topic in bag.topics.values()} == TYPES
    assert bag.topics["/points"].offered_qos_profiles == "# /points"


@pytest.mark.parametrize("options", LAYOUTS)
def test_messages_come_in_the_order_of_their_log_times(tmp_path: Path, options: dict[str, object]) -> None:
    written = entries(30)
    shuffled = [written[(7 * i) % 30] for i in range(30)]
    folder = write_bag(tmp_path / "bag", mcap_bytes(shuffled[:11], **options), mcap_bytes(shuffled[11:], **options))
    assert contents(open_bag(folder)) == written


def test_messages_of_equal_time_keep_their_order(tmp_path: Path) -> None:
    written = [("/cell/part_id", 5, string(f"{i}")) for i in range(40)]
    folder = write_bag(tmp_path / "bag", mcap_bytes(written[:20], chunk_size=64), mcap_bytes(written[20:]))
    assert contents(open_bag(folder)) == written


def test_a_single_file_and_a_folder_without_metadata_are_bags(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", mcap_bytes(entries(3)))
    (folder / "metadata.yaml").unlink()
    assert contents(open_bag(folder)) == contents(open_bag(folder / "bag_0.mcap")) == entries(3)


def test_topics_are_chosen_with_or_without_the_leading_slash(tmp_path: Path) -> None:
    both = [("/points", 1, b"\0\1\0\0"), *entries(2)]
    path = write_bag(tmp_path / "bag", mcap_bytes(both))
    for name in ("/cell/part_id", "cell/part_id"):
        assert [message.raw for message in open_bag(path).messages([name])] == [raw for _, _, raw in entries(2)]


def test_a_bag_written_by_another_library_decodes_to_what_was_written(tmp_path: Path) -> None:
    header = STORE.types["std_msgs/msg/Header"](
        stamp=STORE.types["builtin_interfaces/msg/Time"](sec=12, nanosec=34), frame_id="scanner"
    )
    field = STORE.types["sensor_msgs/msg/PointField"](name="x", offset=0, datatype=7, count=1)
    data = np.arange(240, dtype=np.uint8)
    cloud = STORE.types["sensor_msgs/msg/PointCloud2"](header, 1, 60, [field], False, 4, 240, data, True)
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=STORE)
        raw = bytes(STORE.serialize_cdr(cloud, "sensor_msgs/msg/PointCloud2"))
        writer.write(connection, 42, raw)
    (message,) = open_bag(tmp_path / "bag").messages(["points"])
    assert (message.raw, message.log_time_ns, message.type_name) == (raw, 42, "sensor_msgs/msg/PointCloud2")
    decoded = message.message
    assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec, decoded.header.frame_id) == (12, 34, "scanner")
    assert (decoded.fields[0].name, decoded.fields[0].datatype) == ("x", 7)
    assert decoded.data == data.tobytes()


@pytest.mark.parametrize("options", LAYOUTS[:4])
def test_a_file_cut_off_anywhere_gives_every_message_before_the_cut(tmp_path: Path, options: dict[str, object]) -> None:
    # Chunks of one message each, as recorders make them of scans: every message is recovered up to the last byte.
    written = entries(6, filler=100)
    whole = mcap_bytes(written, topics=["/cell/part_id"], **options)
    path = tmp_path / "cut.mcap"
    seen = set()
    for length in range(0, len(whole), 13):
        path.write_bytes(whole[:length])
        if length < 8:
            with pytest.raises(BagFileError):
                open_bag(path)
            continue
        bag = open_bag(path)
        read = contents(bag)
        assert bag.truncated
        assert read == written[: len(read)]
        if options.get("compression") is None:
            # A chunk ends 0 bytes after its last message.
            assert len(read) == sum(whole.index(raw) + len(raw) <= length for _, _, raw in written)
        seen.add(len(read))
    assert seen == set(range(7))


@pytest.mark.parametrize("options", LAYOUTS[1:4])
def test_zeros_that_a_power_cut_leaves_behind_end_the_bag(tmp_path: Path, options: dict[str, object]) -> None:
    written = entries(6, filler=100)
    whole = mcap_bytes(written, topics=["/cell/part_id"], **options)
    kept = len(whole) // 3
    path = tmp_path / "zeros.mcap"
    path.write_bytes(whole[:kept] + bytes(len(whole) - kept))
    bag = open_bag(path)
    read = contents(bag)
    assert bag.truncated
    assert 0 < len(read) < 6
    assert read == written[: len(read)]


def test_one_cut_file_among_whole_ones_marks_the_bag(tmp_path: Path) -> None:
    whole, written = mcap_bytes(entries(4)), entries(4)
    later = mcap_bytes([(topic, time + 1000, raw) for topic, time, raw in written], chunk_size=10)
    bag = open_bag(write_bag(tmp_path / "bag", whole, later[:-100]))
    assert bag.truncated
    assert contents(bag)[:4] == written


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_a_changed_byte_in_a_chunk_is_an_error_and_no_message(tmp_path: Path, compression: CompressionType) -> None:
    whole = mcap_bytes(entries(1, filler=500), topics=["/cell/part_id"], compression=compression)
    place = whole.index(b"std_msgs/msg/String") + 60 if compression is CompressionType.NONE else 120
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
    with pytest.raises(BagFileError, match=r"damaged\.mcap: damaged"):
        list(open_bag(path).messages())


def test_what_is_no_bag_is_told_apart(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("not a bag at all")
    (tmp_path / "folder").mkdir()
    whole = mcap_bytes(entries(2))
    (tmp_path / "joined.mcap").write_bytes(whole[:60] + whole[90:])
    lost = write_bag(tmp_path / "lost", whole, whole)
    (lost / "bag_1.mcap").unlink()
    nonsense = write_bag(tmp_path / "nonsense", whole)
    (nonsense / "metadata.yaml").write_text("- 1\n")
    sqlite = write_bag(tmp_path / "sqlite", whole, storage_identifier="sqlite3")
    packed = write_bag(tmp_path / "packed", whole, compression_mode="FILE")
    for path, reason in {
        tmp_path / "missing": "no such file or folder",
        tmp_path / "empty.mcap": "empty file",
        tmp_path / "text.mcap": "not an MCAP file",
        tmp_path / "folder": "no MCAP file in the folder",
        tmp_path / "joined.mcap": "damaged",
        lost: "bag_1.mcap is missing",
        nonsense: "not the metadata of a bag",
        sqlite: "sqlite3",
        packed: "compressed by file",
    }.items():
        with pytest.raises(BagFileError, match=reason) as caught:
            open_bag(path)
        assert str(path) in str(caught.value)


def test_a_channel_without_its_schema_is_damage(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    channel = writer.register_channel("/points", "cdr", schema_id=77)
    writer.add_message(channel, 1, b"\0\1\0\0", 1)
    writer.finish()
    path = tmp_path / "scans.mcap"
    path.write_bytes(stream.getvalue())
    with pytest.raises(BagFileError, match=r"scans\.mcap: damaged: /points has no schema"):
        open_bag(path)


@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_damaged_is_told(tmp_path: Path, seed: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path / "damaged.mcap"
    for _ in range(300):
        layout = LAYOUTS[rng.integers(len(LAYOUTS))].values[0]
        content = np.frombuffer(mcap_bytes(entries(8), **layout), np.uint8).copy()
        places = rng.integers(8, len(content), rng.integers(1, 6))
        content[places] = rng.integers(0, 256, len(places))
        path.write_bytes(content)
        with suppress(MdfError):  # nothing else, whatever the bytes
            for message in open_bag(path).messages():
                message.message  # noqa: B018


def test_an_absent_topic_is_named_together_with_those_present(tmp_path: Path) -> None:
    bag = open_bag(write_bag(tmp_path / "bag", mcap_bytes(entries(1))))
    with pytest.raises(BagTopicError, match=r"no topic 'cloud'.*/cell/part_id \(std_msgs/msg/String\), /points"):
        bag.messages(["cloud"])
    empty = open_bag(write_bag(tmp_path / "empty", mcap_bytes([], topics=[])))
    with pytest.raises(BagTopicError, match="the bag has no topics"):
        empty.find_topic("cloud")


def test_the_cloud_topic_is_found_by_name_or_because_it_is_the_only_one(tmp_path: Path) -> None:
    bag = open_bag(write_bag(tmp_path / "bag", mcap_bytes(entries(1))))
    assert bag.find_cloud_topic().name == bag.find_cloud_topic("points").name == "/points"
    with pytest.raises(BagTopicError, match="/cell/part_id is std_msgs/msg/String"):
        bag.find_cloud_topic("/cell/part_id")
    none = open_bag(write_bag(tmp_path / "none", mcap_bytes(entries(1), topics=["/cell/part_id"])))
    with pytest.raises(BagTopicError, match="no point cloud topic"):
        none.find_cloud_topic()


def test_a_message_that_does_not_fit_its_definition_is_an_error(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", mcap_bytes([("/points", 1, b"\0\1\0\0\1")]))
    (message,) = open_bag(path).messages()
    with pytest.raises(BagFileError, match="damaged"):
        message.message  # noqa: B018


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"chunk_size": 1}])
def test_only_the_message_at_hand_is_in_memory(tmp_path: Path, options: dict[str, object]) -> None:
    size = 1_000_000
    written = [("/cell/part_id", time, string("." * size)) for time in range(12)]
    path = write_bag(tmp_path / "bag", mcap_bytes(written, **options))
    del written
    tracemalloc.start()
    try:
        assert sum(len(message.raw) for message in open_bag(path).messages()) > 12 * size
        assert tracemalloc.get_traced_memory()[1] < 5 * size
    finally:
        tracemalloc.stop()
