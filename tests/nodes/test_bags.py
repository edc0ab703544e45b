"""Bags are recorded from and played into a running graph without a byte changed."""

from __future__ import annotations

import array
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import CellProcess, Graph
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String

from mdf_core.bag import open_bag
from mdf_core.errors import BagTopicError, OutputFolderError
from mdf_nodes import bag_recorder
from mdf_nodes.bag_recorder import BagRecorder
from mdf_nodes.bag_writer import BagWriter
from mdf_nodes.message_types import message_class, message_definition
from mdf_nodes.qos import LATCHED, SENSOR, from_rosbag2

Start = Callable[..., CellProcess]
Recorded = tuple[Path, list[bytes], bytes]  # the bag, the serialized clouds and the serialized string

RELIABLE = QoSProfile(depth=50)
CLOUD_TYPE, STRING_TYPE = "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String"


def cloud(number: int, size: int = 1_200_000) -> PointCloud2:
    message = PointCloud2(height=1, width=size // 12, point_step=12, row_step=size, is_dense=True)
    message.header.frame_id = "scanner"
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000 + number, 123_456_789
    message.fields = [PointField(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyz")]
    message.data = array.array("B", bytes([number])) * size
    return message


def string_bag(folder: Path, count: int, spacing: float = 0.0, type_name: str = STRING_TYPE) -> Path:
    """A bag of strings on /text, `spacing` seconds apart."""
    writer = BagWriter(folder)
    writer.add_topic("/text", type_name, message_definition(STRING_TYPE), [RELIABLE])
    for number in range(count):
        log_time = 10**18 + round(number * spacing * 1e9)
        writer.write("/text", serialize_message(String(data=f"text {number}" + "." * 70_000)), log_time, log_time)
    writer.close()
    return folder


def texts(received: list[String]) -> list[str]:
    return [message.data.rstrip(".") for message in received]


@pytest.fixture(scope="module")
def recorded(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A bag of three clouds and an earlier latched string, recorded through DDS, and what was published."""
    folder = tmp_path_factory.mktemp("recorded") / "recorded"
    with closing(Graph()) as graph:
        node = graph.node("publisher")
        part = serialize_message(String(data="bracket 007"))  # 20 bytes: DDS fills up to a multiple of four
        node.create_publisher(String, "/cell/part_id", LATCHED).publish(part)
        points = node.create_publisher(PointCloud2, "points", RELIABLE)
        arguments = (str(folder), "--topics", "/points", "cell/part_id", "--count", "4")
        recorder = CellProcess("bag_recorder", arguments, tmp_path_factory.mktemp("bag_recorder"))
        graph.wait_until(points.get_subscription_count, what="the recorder subscribes")
        # Sent as bytes: a serializer leaves arbitrary bytes between fields.
        clouds = [serialize_message(cloud(number)) for number in range(3)]
        for raw in clouds:
            points.publish(raw)
        assert recorder.wait() == 0, recorder.output
    assert "4 messages" in recorder.stdout
    return folder, clouds, part


def test_a_recording_holds_the_published_bytes_and_the_offered_qos(
    recorded: Recorded,
) -> None:
    folder, clouds, part = recorded
    bag = open_bag(folder)
    assert not bag.truncated
    assert [message.raw for message in bag.messages(["/points"])] == clouds
    assert [message.raw for message in bag.messages(["/cell/part_id"])] == [part]
    (points_qos,) = from_rosbag2(bag.topics["/points"].offered_qos_profiles)
    (part_qos,) = from_rosbag2(bag.topics["/cell/part_id"].offered_qos_profiles)
    assert (points_qos.reliability, points_qos.durability) == (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
    assert (part_qos.reliability, part_qos.durability) == (LATCHED.reliability, LATCHED.durability)


def test_a_replay_sends_what_was_recorded_and_records_the_same_again(
    recorded: Recorded, start: Start, tmp_path: Path
) -> None:
    folder = recorded[0]
    recorder = start("bag_recorder", tmp_path / "again", "--topics", "/points", "/cell/part_id", "--count", "4")
    player = start("bag_player", folder)
    assert player.wait() == 0, player.output
    assert recorder.wait() == 0, recorder.output
    first, again = open_bag(folder), open_bag(tmp_path / "again")
    assert first.topics == again.topics
    for topic in first.topics:
        assert [message.raw for message in first.messages([topic])] == [m.raw for m in again.messages([topic])]


def test_other_libraries_read_the_recording(recorded: Recorded) -> None:
    folder = recorded[0]
    clouds = [cloud(number) for number in range(3)]
    with AnyReader([folder]) as reader:
        assert {(each.topic, each.msgtype, each.msgcount) for each in reader.connections} == {
            ("/points", CLOUD_TYPE, 3),
            ("/cell/part_id", STRING_TYPE, 1),
        }
        decoded = [(each.topic, reader.deserialize(raw, each.msgtype)) for each, _, raw in reader.messages()]
    read = [message for topic, message in decoded if topic == "/points"]
    assert [message.data.tobytes() for message in read] == [each.data.tobytes() for each in clouds]
    assert [message.header.stamp.nanosec for message in read] == [123_456_789] * 3
    assert [message.data for topic, message in decoded if topic == "/cell/part_id"] == ["bracket 007"]

    with (folder / "recorded_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        decoded = [message for _, channel, _, message in reader.iter_decoded_messages("/points")]
    assert [message.data for message in decoded] == [each.data.tobytes() for each in clouds]
    assert [message.fields[2].name for message in decoded] == ["z"] * 3


def test_the_metadata_are_those_of_rosbag2(recorded: Recorded) -> None:
    folder = recorded[0]
    text = (folder / "metadata.yaml").read_text()
    metadata = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert "&id" not in text  # anchors, which the YAML reader of rosbag2 need not know
    topics = metadata.pop("topics_with_message_count")
    times = [message.log_time_ns for message in open_bag(folder).messages()]
    extent = {
        "starting_time": {"nanoseconds_since_epoch": times[0]},
        "duration": {"nanoseconds": times[-1] - times[0]},
        "message_count": 4,
    }
    assert metadata == {
        "version": 9,
        "storage_identifier": "mcap",
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["recorded_0.mcap"],
        "files": [{"path": "recorded_0.mcap", **extent}],
        "custom_data": None,
        "ros_distro": "jazzy",
        **extent,
    }
    assert {each["topic_metadata"]["name"]: each["message_count"] for each in topics} == {
        "/points": 3,
        "/cell/part_id": 1,
    }
    for each in topics:
        topic = each["topic_metadata"]
        assert set(topic) == {
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        }
        assert topic["type_description_hash"].startswith("RIHS01_")
        assert topic["serialization_format"] == "cdr"
        assert topic["offered_qos_profiles"][0]["reliability"] == "reliable"
    assert {topic["durability"] for each in topics for topic in each["topic_metadata"]["offered_qos_profiles"]} == {
        "volatile",
        "transient_local",
    }


@pytest.mark.parametrize("stop_signal", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_recorder_leaves_a_complete_bag(
    graph: Graph, start: Start, tmp_path: Path, stop_signal: signal.Signals
) -> None:
    publisher = graph.node("publisher").create_publisher(String, "text", SENSOR)
    recorder = start("bag_recorder", tmp_path / "bag", "--all")
    graph.wait_until(publisher.get_subscription_count, what="the recorder subscribes")

    def first_message_is_recorded() -> bool:
        publisher.publish(String(data="x" * 100_000))
        return sum(file.stat().st_size for file in (tmp_path / "bag").glob("*.mcap")) > 100_000

    graph.wait_until(first_message_is_recorded)
    recorder.send(stop_signal)
    assert recorder.wait() == 0, recorder.output
    bag = open_bag(tmp_path / "bag")
    assert not bag.truncated
    assert {message.message.data for message in bag.messages(["/text"])} == {"x" * 100_000}
    (offered,) = from_rosbag2(bag.topics["/text"].offered_qos_profiles)
    assert offered.reliability == ReliabilityPolicy.BEST_EFFORT


def test_a_killed_recorder_leaves_every_cloud_it_had_received(graph: Graph, start: Start, tmp_path: Path) -> None:
    publisher = graph.node("publisher").create_publisher(PointCloud2, "points", RELIABLE)
    recorder = start("bag_recorder", tmp_path / "bag", "--topics", "points")
    graph.wait_until(publisher.get_subscription_count, what="the recorder subscribes")
    clouds = [serialize_message(cloud(number)) for number in range(3)]
    for raw in clouds:
        publisher.publish(raw)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    graph.wait_until(lambda: file.stat().st_size > 3 * 1_200_000, what="the clouds are on disk")
    recorder.send(signal.SIGKILL)
    recorder.wait()
    bag = open_bag(tmp_path / "bag")
    assert bag.truncated
    assert [message.raw for message in bag.messages()] == clouds


def test_an_output_that_cannot_be_written_is_one_line_and_status_2(start: Start, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    reasons = {tmp_path / "file" / "bag": "cannot write the bag", tmp_path: "exists already"}
    recorders = {folder: start("bag_recorder", folder, "--all") for folder in reasons}
    for folder, reason in reasons.items():
        recorder = recorders[folder]
        assert recorder.wait() == 2
        assert recorder.stderr.startswith(f"error: {folder}: {reason}")
        assert recorder.stderr.count("\n") == 1


def test_a_full_disk_ends_the_recording_with_an_error_and_keeps_what_is_written(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic("/text", STRING_TYPE, message_definition(STRING_TYPE), [RELIABLE])
    raw = serialize_message(String(data="x" * 100_000))
    resource.setrlimit(resource.RLIMIT_FSIZE, (350_000, limits[1]))
    try:
        with pytest.raises(OutputFolderError, match="cannot write the bag: File too large"):
            for number in range(10):
                writer.write("/text", raw, number, number)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for _ in ("before", "after"):
        bag = open_bag(tmp_path / "bag")
        assert bag.truncated
        assert [message.raw for message in bag.messages()] == [raw] * 3
        writer.close()  # though there is space again: what follows half a record cannot be read


def test_a_recorder_whose_disk_is_full_ends_with_one_line_and_keeps_what_it_has_written(
    graph: Graph, start: Start, tmp_path: Path
) -> None:
    publisher = graph.node("publisher").create_publisher(String, "text", RELIABLE)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (350_000, limits[1]))
    try:
        recorder = start("bag_recorder", tmp_path / "bag", "--topics", "text")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    graph.wait_until(publisher.get_subscription_count, what="the recorder subscribes")
    raw = serialize_message(String(data="x" * 100_000))
    for _ in range(10):
        publisher.publish(raw)
    assert recorder.wait() == 2
    assert recorder.stderr.startswith(f"error: {tmp_path / 'bag'}: cannot write the bag: File too large")
    assert recorder.stderr.count("\n") == 1
    bag = open_bag(tmp_path / "bag")
    assert bag.truncated
    assert [message.raw for message in bag.messages()] == [raw] * 3


def test_a_recorder_that_ends_with_an_error_completes_its_bag(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = graph.node("publisher").create_publisher(String, "text", kept)
    for number in range(3):
        publisher.publish(String(data=f"text {number}"))
    usual = BagWriter.write

    def write(writer: BagWriter, topic: str, *message: Any) -> None:
        if writer.message_count == 2:
            raise OutputFolderError("no place for this one", topic)
        usual(writer, topic, *message)

    def recorder(*arguments: Any) -> BagRecorder:
        graph.nodes.append(BagRecorder(*arguments))  # else the end of the process destroys it
        return graph.nodes[-1]

    monkeypatch.setattr(BagWriter, "write", write)
    monkeypatch.setattr(bag_recorder, "BagRecorder", recorder)
    monkeypatch.setattr(bag_recorder, "ros_context", lambda _: nullcontext(threading.Event()))
    arguments = ["bag_recorder", str(tmp_path / "bag"), "--topics", "text", "--duration", "20"]
    assert bag_recorder.main(arguments) == 2
    assert capsys.readouterr().err == "error: /text: no place for this one\n"
    bag = open_bag(tmp_path / "bag")
    assert not bag.truncated
    assert [message.message.data for message in bag.messages()] == ["text 0", "text 1"]
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["message_count"] == 2


def test_no_message_is_lost_when_the_subscriber_comes_late(graph: Graph, start: Start, tmp_path: Path) -> None:
    player = start("bag_player", string_bag(tmp_path / "bag", 50))
    node = graph.node("subscriber")
    graph.wait_until(lambda: node.count_publishers("/text"), what="the player is up")
    received = graph.collect(String, "text", RELIABLE)
    assert player.wait() == 0, player.output
    graph.wait_until(lambda: len(received) >= 50)
    assert texts(received) == [f"text {number}" for number in range(50)]


def test_topics_can_be_chosen_and_remapped(graph: Graph, start: Start, tmp_path: Path) -> None:
    received = graph.collect(String, "/cell_a/text", RELIABLE)
    player = start(
        "bag_player", string_bag(tmp_path / "bag", 3), "--topics", "text", "--ros-args", "-r", "/text:=/cell_a/text"
    )
    assert player.wait() == 0, player.output
    graph.wait_until(lambda: len(received) == 3)


def test_without_a_subscriber_the_player_gives_up_after_the_timeout(start: Start, tmp_path: Path) -> None:
    bag = string_bag(tmp_path / "bag", 3)
    waiting, hasty = start("bag_player", bag, "--timeout", "0.2"), start("bag_player", bag, "--no-wait")
    assert waiting.wait() == 2
    assert waiting.stderr.startswith("error: /text: no subscriber within 0.2 s")
    assert hasty.wait() == 0
    assert "3 messages played" in hasty.stdout


def test_the_spacing_of_the_messages_is_kept_and_divided_by_the_rate(
    graph: Graph, start: Start, tmp_path: Path
) -> None:
    bag = string_bag(tmp_path / "bag", 4, spacing=0.3)
    spans = {}
    arrivals: list[float] = []
    graph.node("subscriber").create_subscription(String, "/text", lambda _: arrivals.append(time.monotonic()), RELIABLE)
    for rate in ("1", "4"):
        arrivals.clear()
        player = start("bag_player", bag, "--rate", rate)
        graph.wait_until(lambda: len(arrivals) == 4)
        spans[rate] = arrivals[-1] - arrivals[0]
        assert player.wait() == 0, player.output
    assert spans["1"] == pytest.approx(0.9, abs=0.25)
    assert spans["4"] == pytest.approx(0.225, abs=0.2)


def test_topics_of_types_that_are_not_installed_are_left_out_with_a_warning(
    graph: Graph, start: Start, tmp_path: Path
) -> None:
    path = tmp_path / "day.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start(profile="ros2")
        for topic, type_name, definition in (
            ("/robot", "other_msgs/msg/Robot", "float64 angle\n"),
            ("/text", "std_msgs/msg/String", "string data\n"),
        ):
            schema = writer.register_schema(type_name, "ros2msg", definition.encode())
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 1, serialize_message(String(data="part 1")), 1)
        writer.finish()
    received = graph.collect(String, "/text", RELIABLE)
    player = start("bag_player", path)
    assert player.wait() == 0
    assert "warning: /robot is not played: message type other_msgs/msg/Robot is not installed" in player.stderr
    graph.wait_until(lambda: texts(received) == ["part 1"])
    chosen = start("bag_player", path, "--topics", "/robot")
    assert chosen.wait() == 2
    assert chosen.stderr.startswith("error: message type other_msgs/msg/Robot is not installed")


def test_a_player_that_waits_says_what_for(graph: Graph, start: Start, tmp_path: Path) -> None:
    player = start("bag_player", string_bag(tmp_path / "bag", 1))
    graph.node("bystander")
    graph.wait_until(lambda: "waiting for subscribers of /text; start one" in player.stderr)
    received = graph.collect(String, "/text", RELIABLE)
    graph.wait_until(lambda: received)
    assert player.wait() == 0


def test_a_loop_goes_on_until_interrupted(graph: Graph, start: Start, tmp_path: Path) -> None:
    received = graph.collect(String, "/text", RELIABLE)
    player = start("bag_player", string_bag(tmp_path / "bag", 3), "--loop")
    graph.wait_until(lambda: len(received) >= 8)
    assert texts(received)[:6] == ["text 0", "text 1", "text 2"] * 2
    assert player.stop() == 0


def test_a_cut_off_bag_is_played_up_to_the_cut_with_a_warning(graph: Graph, start: Start, tmp_path: Path) -> None:
    folder = string_bag(tmp_path / "bag", 40)
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    expected = [message.message.data.rstrip(".") for message in open_bag(folder).messages()]
    assert 0 < len(expected) < 40
    received = graph.collect(String, "/text", RELIABLE)
    player = start("bag_player", folder)
    assert player.wait() == 0
    assert f"warning: {folder} is cut off" in player.stderr
    graph.wait_until(lambda: len(received) >= len(expected))
    assert texts(received) == expected


def test_a_bag_that_cannot_be_played_is_one_line_and_status_2(start: Start, tmp_path: Path) -> None:
    bag = string_bag(tmp_path / "bag", 3)
    unknown = string_bag(tmp_path / "unknown", 3, type_name="acme_msgs/msg/Part")
    reasons = {
        (tmp_path / "missing",): "no such file or folder",
        (bag, "--topics", "/points"): "no topic '/points'; the bag has /text (std_msgs/msg/String)",
        (unknown,): "message type acme_msgs/msg/Part is not installed",
    }
    players = {arguments: start("bag_player", *arguments) for arguments in reasons}
    for arguments, reason in reasons.items():
        player = players[arguments]
        assert player.wait() == 2
        assert reason in player.stderr
        assert player.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["os/path/join", "this/msg/X", "/msg/X", "std_msgs/msg/../String", "String"])
def test_whatever_else_a_bag_names_is_no_message_type(name: str) -> None:
    with pytest.raises(BagTopicError, match="is not installed"):
        message_class(name)
    assert "this" not in sys.modules


@pytest.mark.parametrize("limit", [("--count", "-3"), ("--duration", "nan")])
def test_a_limit_that_makes_no_sense_is_refused(start: Start, tmp_path: Path, limit: tuple[str, str]) -> None:
    recorder = start("bag_recorder", tmp_path / "bag", "--all", *limit)
    assert recorder.wait() == 2
    assert f"{limit[1]} is no number above 0" in recorder.stderr and not (tmp_path / "bag").exists()


def test_the_definition_in_a_bag_includes_all_dependencies() -> None:
    definition = message_definition("mdf_interfaces/msg/Inspection")
    assert definition.type_hash.startswith("RIHS01_")
    for dependency in ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Transform"):
        assert f"\n{'=' * 80}\nMSG: {dependency}\n" in definition.text
