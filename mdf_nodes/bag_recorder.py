"""``bag_recorder``: records topics as they are, bytes and QoS, into a bag that rosbag2 can play."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from mdf_core.errors import BagTopicError
from mdf_nodes.bag_writer import COMPRESSIONS, BagWriter
from mdf_nodes.context import DONE, exit_status, positive_number, ros_context, spin_until, without_ros_arguments
from mdf_nodes.message_types import message_class, message_definition
from mdf_nodes.qos import subscription_profile

_DEPTH = 100
_LOOK_AROUND_SECONDS = 0.1


class BagRecorder(Node):
    """Subscribes to topics as publishers for them appear and writes what arrives.

    A subscription is as reliable and as durable as every publisher known when it is made.

    Parameters
    ----------
    writer : BagWriter
    topics : sequence of str, or None
        Names, relative ones in the node's namespace; None: all topics.
    """

    def __init__(self, writer: BagWriter, topics: Sequence[str] | None) -> None:
        super().__init__("bag_recorder", enable_rosout=False, start_parameter_services=False)
        self._writer = writer
        self._wanted = None if topics is None else {self.resolve_topic_name(topic) for topic in topics}
        self._seen: set[str] = set()
        self._timer = self.create_timer(_LOOK_AROUND_SECONDS, self._look_around)

    def stop(self, executor: SingleThreadedExecutor) -> None:
        """Look for no more topics and write the messages that have already arrived."""
        self.destroy_timer(self._timer)
        for _ in range(_DEPTH * len(self._seen)):
            executor.spin_once(timeout_sec=0)

    def _look_around(self) -> None:
        for topic, type_names in self.get_topic_names_and_types():
            if topic in self._seen or (self._wanted is not None and topic not in self._wanted):
                continue
            offered = [publisher.qos_profile for publisher in self.get_publishers_info_by_topic(topic)]
            if offered:
                self._seen.add(topic)
                self._record(topic, type_names[0], offered)

    def _record(self, topic: str, type_name: str, offered: list[Any]) -> None:
        try:
            definition, class_ = message_definition(type_name), message_class(type_name)
        except BagTopicError as error:
            if self._wanted is not None:
                raise
            print(f"warning: {topic} is not recorded: {error}", file=sys.stderr)
            return
        self._writer.add_topic(topic, type_name, definition, offered)

        def on_message(raw: bytes, information: dict[str, int]) -> None:
            self._writer.write(topic, raw, information["received_timestamp"], information["source_timestamp"])

        self.create_subscription(class_, topic, on_message, subscription_profile(offered, _DEPTH), raw=True)
        print(f"recording {topic}", flush=True)


def _arguments(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("bag_recorder", description=__doc__, allow_abbrev=False)
    parser.add_argument("folder", type=Path, help="the bag to make; must not exist yet")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--topics", nargs="+", metavar="TOPIC", help="topics to record")
    what.add_argument("--all", action="store_true", help="record every topic")
    parser.add_argument("--compression", choices=COMPRESSIONS, default="none", help="of the chunks in the MCAP file")
    parser.add_argument(
        "--duration", type=positive_number, default=float("inf"), metavar="SECONDS", help="stop after this time"
    )
    parser.add_argument("--count", type=positive_number, default=float("inf"), help="stop after this many messages")
    return parser.parse_args(without_ros_arguments(argv))


def main(argv: Sequence[str] = sys.argv) -> int:
    """Record until interrupted, or for --duration seconds, or --count messages; the exit status."""
    arguments = _arguments(argv)

    def record() -> int:
        with closing(BagWriter(arguments.folder, arguments.compression)) as writer, ros_context(argv) as stop:
            recorder = BagRecorder(writer, arguments.topics)
            executor = SingleThreadedExecutor()
            executor.add_node(recorder)
            deadline = time.monotonic() + arguments.duration
            spin_until(
                executor,
                lambda: writer.message_count >= arguments.count or time.monotonic() >= deadline,
                stop,
            )
            if writer.message_count < arguments.count:
                recorder.stop(executor)
            executor.shutdown()
            recorder.destroy_node()
        print(f"{writer.message_count} messages in {arguments.folder}")
        return DONE

    return exit_status(record)


if __name__ == "__main__":
    sys.exit(main())
