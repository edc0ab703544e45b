"""What every process of the cell shares: start, stop signals, exit status, environment of child processes."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
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
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_CLEAN_STOP_SECONDS = 5.0


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
    instead of results. A signal seldom comes alone (the terminal and the supervisor both send one), so repeats are
    ignored until the process has ended; 5 s after the first one a further signal kills it.
    """
    stop = threading.Event()
    usual = {number: signal.getsignal(number) for number in _STOP_SIGNALS}
    asked: list[float] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        asked.append(time.monotonic())
        if asked[-1] - asked[0] > _CLEAN_STOP_SECONDS:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        stop.set()

    try:
        for number in _STOP_SIGNALS:
            signal.signal(number, on_signal)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        yield stop
    finally:
        rclpy.try_shutdown()
        if asked:
            # The end of the interpreter takes our handlers away while libraries still tidy up.
            atexit.register(_ignore_signals)
        else:
            for number, handler in usual.items():
                signal.signal(number, handler)


def _ignore_signals() -> None:
    for number in _STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


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
