"""What every process of the cell shares: start, stop signals, exit status, environment of child processes."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import UnknownROSArgsError
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from mdf_core.errors import MdfError

DONE, FAULT, BAD_INPUT = 0, 1, 2
"""Exit statuses: done, a fault of ours, an input that the user can mend."""

_BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def child_environment(**changes: str) -> dict[str, str]:
    """The environment for a child Python process, with `changes`.

    The ROS wheels set library paths at the start of an interpreter, once; a child that inherits the note that this is
    done would go without them, or with another environment's.
    """
    environment = {name: value for name, value in os.environ.items() if name != _BOOTSTRAP_GUARD}
    return environment | changes


@contextmanager
def ros_context(args: Sequence[str] | None = None) -> Iterator[threading.Event]:
    """rclpy from init to shutdown; SIGINT and SIGTERM set the event that is handed out.

    rclpy's own handlers invalidate the context at once: goals and publications under way would end in tracebacks
    instead of results. A second signal ends the process the usual way.
    """
    stop = threading.Event()
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()
        for each, handler in usual.items():
            signal.signal(each, handler)

    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        for number in usual:
            signal.signal(number, on_signal)
        yield stop
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        rclpy.try_shutdown()


def spin_until(executor: SingleThreadedExecutor, condition: Callable[[], bool], stop: threading.Event) -> None:
    """Run callbacks until `condition` holds or `stop` is set."""
    while not condition() and not stop.is_set():
        executor.spin_once(timeout_sec=0.05)


def run_node(
    make_node: Callable[[], Node], args: Sequence[str] | None = None, done: Callable[[Any], bool] = lambda node: False
) -> int:
    """Run one node in one thread until it is `done` or a stop signal comes; the exit status."""

    def body() -> int:
        with ros_context(args) as stop:
            node = make_node()
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            try:
                spin_until(executor, lambda: done(node), stop)
            finally:
                executor.shutdown()
                node.destroy_node()
        return DONE

    return exit_status(body)


def exit_status(body: Callable[[], int]) -> int:
    """Run `body`: what a user can mend becomes one line on stderr and status 2, any other exception its trace and 1."""
    try:
        return body()
    except (MdfError, ParameterException, UnknownROSArgsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except Exception:
        traceback.print_exc()
        return FAULT
