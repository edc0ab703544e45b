"""``bag_player``: publishes a bag again, the same bytes with the recorded QoS and spacing."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from mdf_core.bag import Bag, BagTopic, open_bag
from mdf_core.errors import BagTopicError
from mdf_nodes.context import DONE, exit_status, positive_number, ros_context, without_ros_arguments
from mdf_nodes.message_types import message_class
from mdf_nodes.qos import from_rosbag2, replay_profile

_DEPTH = 1000
_LATCHED_DEPTH = 10  # kept for late subscribers, so it is memory
# Larger messages go out in fragments and are acknowledged within milliseconds, others with the heartbeat of 3 s.
_FRAGMENT_BYTES = 65_536
_POLL_SECONDS = 0.05
_PATIENCE_SECONDS = 3.0
# A publisher may know a subscription before the subscription knows it, and nothing repeats a best-effort message.
_DISCOVERY_MARGIN_SECONDS = 0.3


class BagPlayer(Node):
    """Publishers for the topics of a bag.

    Parameters
    ----------
    bag : Bag
    topics : sequence of BagTopic
        What to play.
    stop : threading.Event
        Ends every wait.
    """

    def __init__(self, bag: Bag, topics: Sequence[BagTopic], stop: threading.Event) -> None:
        super().__init__("bag_player", enable_rosout=False, start_parameter_services=False)
        self._bag = bag
        self._stop = stop
        self._publishers_by_topic = {topic.name: self._publisher(topic) for topic in topics}

    def _publisher(self, topic: BagTopic) -> Publisher:
        try:
            recorded = from_rosbag2(topic.offered_qos_profiles)
        except ValueError as error:
            raise BagTopicError(str(error), topic.name, "record the bag again") from None
        profile = replay_profile(recorded, _DEPTH)
        if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            profile.depth = _LATCHED_DEPTH
        return self.create_publisher(message_class(topic.type_name), topic.name, profile)

    def wait_for_subscribers(self, timeout: float) -> None:
        """Return when every topic has a subscription that matches, or on stop.

        Raises
        ------
        BagTopicError
            Not within `timeout` seconds; the message names the topics.
        """
        began, has_asked = time.monotonic(), False
        while not self._stop.is_set():
            lonely = [name for name, each in self._publishers_by_topic.items() if not each.get_subscription_count()]
            if not lonely:
                self._stop.wait(_DISCOVERY_MARGIN_SECONDS)
                return
            waited, remedy = time.monotonic() - began, "start one, choose with --topics, or play with --no-wait"
            if waited > timeout:
                raise BagTopicError(f"no subscriber within {timeout:g} s", ", ".join(lonely), remedy)
            if waited > _PATIENCE_SECONDS and not has_asked:
                print(f"waiting for subscribers of {', '.join(lonely)}; {remedy}", file=sys.stderr, flush=True)
                has_asked = True
            self._stop.wait(_POLL_SECONDS)

    def play(self, rate: float) -> int:
        """Publish all messages once, `rate` times as fast as recorded; returns how many before the end or stop."""
        started, first, played = time.monotonic(), None, 0
        for message in self._bag.messages(self._publishers_by_topic):
            first = message.log_time_ns if first is None else first
            due = started + (message.log_time_ns - first) * 1e-9 / rate
            if self._stop.wait(max(0.0, due - time.monotonic())):
                break
            publisher = self._publishers_by_topic[message.topic]
            publisher.publish(message.raw)
            played += 1
            # Reading may be faster than sending: large messages would pile up in memory.
            if len(message.raw) > _FRAGMENT_BYTES:
                self._wait_until_received(publisher)
        return played

    def finish(self) -> None:
        """Wait until reliable subscribers have everything."""
        for publisher in self._publishers_by_topic.values():
            self._wait_until_received(publisher)

    def _wait_until_received(self, publisher: Publisher) -> None:
        if publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE:
            while not self._stop.is_set() and not publisher.wait_for_all_acked(Duration(seconds=_POLL_SECONDS)):
                pass


def _known(bag: Bag) -> list[BagTopic]:
    """The topics whose type is installed; the others are told of, unless there is nothing else."""
    known: list[BagTopic] = []
    unknown: list[tuple[BagTopic, BagTopicError]] = []
    for topic in bag.topics.values():
        try:
            message_class(topic.type_name)
        except BagTopicError as error:
            unknown.append((topic, error))
        else:
            known.append(topic)
    if unknown and not known:
        raise unknown[0][1]
    for topic, reason in unknown:
        print(f"warning: {topic.name} is not played: {reason}", file=sys.stderr)
    return known


def _arguments(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "bag_player", description=__doc__, epilog="Remap with --ros-args -r FROM:=TO.", allow_abbrev=False
    )
    parser.add_argument("bag", type=Path, help="folder of the bag, or one MCAP file")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="topics to play; default: all of installed types")
    parser.add_argument(
        "--rate", type=positive_number, default=1.0, help="times as fast as recorded; default: %(default)g"
    )
    parser.add_argument("--loop", action="store_true", help="play again and again until interrupted")
    parser.add_argument(
        "--wait",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="begin when every topic has a subscriber",
    )
    parser.add_argument(
        "--timeout", type=positive_number, default=float("inf"), metavar="SECONDS", help="longest wait for subscribers"
    )
    return parser.parse_args(without_ros_arguments(argv))


def main(argv: Sequence[str] = sys.argv) -> int:
    """Play a bag; the exit status."""
    arguments = _arguments(argv)

    def play() -> int:
        bag = open_bag(arguments.bag)
        topics = _known(bag) if arguments.topics is None else [bag.find_topic(name) for name in arguments.topics]
        with ros_context(argv) as stop:
            player = BagPlayer(bag, topics, stop)
            if arguments.wait:
                player.wait_for_subscribers(arguments.timeout)
            played = player.play(arguments.rate)
            while arguments.loop and played and not stop.is_set():
                played += player.play(arguments.rate)
            player.finish()
            player.destroy_node()
        if bag.truncated:
            print(f"warning: {arguments.bag} is cut off; played what lies before the cut", file=sys.stderr)
        print(f"{played} messages played from {arguments.bag}")
        return DONE

    return exit_status(play)


if __name__ == "__main__":
    sys.exit(main())
